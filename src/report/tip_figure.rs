//! The figure of the tool's motion: path of the burr's centre, which the plan's target is for, with the
//! manipulator's shape, and forces over time.

use figures::{
    Axis, COLOURS, Figure, FigureError, HEAD, INK, Key, Panel, Point, RGBColor, Rect, Stroke, WIDTH, bounds,
};
use ipc_types::messages::State;

use super::course::{Plane, distance_m};
use super::run_lane::{Curves, RunLane, links};
use super::timeline::{Extremes, Timeline};

const HEIGHT: f64 = 720.0;
const PATH_WIDTH: f64 = 400.0;
const BURR: RGBColor = RGBColor(178, 178, 178);
const START: RGBColor = RGBColor(222, 222, 222);

/// Draws the figure; without states it says so.
pub fn draw(run: &RunLane) -> Result<Figure, FigureError> {
    let scene = run.header.as_ref().map_or("run", |header| header.scene_name.as_str());
    let title =
        format!("{scene}: tool motion over {:.2} s (bands: minimum to maximum)", run.end_ns as f64 * 1e-9);
    let mut figure = Figure::titled(HEIGHT, &title)?;
    let height = HEIGHT - HEAD;
    draw_path(&mut figure, Rect { x: 0.0, y: HEAD, width: PATH_WIDTH, height }, run);
    let rows = height / 3.0;
    let cell =
        |row: f64| Rect { x: PATH_WIDTH, y: HEAD + row * rows, width: WIDTH - PATH_WIDTH, height: rows };
    let end_s = run.end_ns as f64 * 1e-9;
    let (tensions, bend, force) = match &run.curves {
        Some(curves) => {
            let used = run.course.last.as_ref().map_or(0, |state| state.tendon_count as usize);
            let tendons = curves.tension_n.iter().take(used).enumerate();
            let tensions = tendons.map(|(i, line)| (line, format!("tendon {i}"))).collect();
            let bend = vec![(&curves.bend_deg, String::new())];
            (tensions, bend, vec![(&curves.burr_force_n, String::new())])
        }
        None => (Vec::new(), Vec::new(), Vec::new()),
    };
    draw_over_time(&mut figure, cell(0.0), "Tendon tension", "tension (N)", end_s, &tensions);
    draw_over_time(
        &mut figure,
        cell(1.0),
        "Bend of the tip relative to the base",
        "bend (deg)",
        end_s,
        &bend,
    );
    draw_over_time(&mut figure, cell(2.0), "Normal force on the burr", "force (N)", end_s, &force);
    Ok(figure)
}

/// Contents of the left panel, mm along the bend and insertion axes.
struct PathPanel {
    path: Vec<Point>,
    start: Vec<Point>,
    end: Vec<Point>,
    burr: Option<(Point, f64)>,
    target: Option<Point>,
}

impl PathPanel {
    fn of(run: &RunLane, curves: &Curves, first: &State, last: &State, deepest: &State) -> PathPanel {
        let plane = &curves.plane;
        let project = |point_m: [f64; 3]| {
            let [x, y] = plane.project_mm(point_m);
            (x, y)
        };
        let centre = deepest.t_world_burr.position_m;
        let radius_mm = distance_m(centre, deepest.t_world_tip.position_m) * 1e3;
        let middle = curves.burr_mm.iter().filter_map(|(_, burr)| *burr).map(|[x, y]| (x, y));
        let ends = [first, last].map(|state| project(state.t_world_burr.position_m));
        PathPanel {
            path: std::iter::once(ends[0]).chain(middle).chain([ends[1]]).collect(),
            start: shape(plane, first),
            end: shape(plane, deepest),
            burr: Some((project(centre), radius_mm)),
            target: run.course.target_m.map(project),
        }
    }

    /// Returns the points that the panel must contain; the shaft can extend beyond it.
    fn corners(&self) -> Vec<Point> {
        let links = |shape: &[Point]| shape.iter().skip(1).copied().collect::<Vec<_>>();
        let mut points = [self.path.clone(), links(&self.start), links(&self.end)].concat();
        points.extend(self.target);
        if let Some(((x, y), radius)) = self.burr {
            points.extend([(x - radius, y - radius), (x + radius, y + radius)]);
        }
        points
    }
}

/// Projects base, links and burr centre onto the plane.
fn shape(plane: &Plane, state: &State) -> Vec<Point> {
    let links = links(state).iter().map(|pose| pose.position_m);
    let points = std::iter::once(state.t_world_base.position_m).chain(links);
    let points = points.chain([state.t_world_burr.position_m]).map(|point| plane.project_mm(point));
    points.map(|[x, y]| (x, y)).collect()
}

fn draw_path(figure: &mut Figure, outer: Rect, run: &RunLane) {
    let title = "Burr path and tool in the bending plane";
    let path_panel = match (&run.curves, &run.course.first, &run.course.last, &run.course.deepest) {
        (Some(curves), Some(first), Some(last), Some(deepest)) => {
            PathPanel::of(run, curves, first, last, deepest)
        }
        _ => {
            let axis = || Axis::linear("", 0.0, 1.0, 4);
            let mut panel = Panel::new(figure, outer, title, axis(), axis());
            panel.remark("no state in the log");
            return panel.finish();
        }
    };
    let (x, y) = equal_axes(&path_panel.corners(), outer.plot_area());
    let mut panel = Panel::new(figure, outer, title, x, y);
    panel.line(&path_panel.start, Stroke::full(START, 7.0), "tool at the start");
    if let Some((centre, radius_mm)) = path_panel.burr {
        panel.disc(centre, radius_mm * panel.scale(), BURR);
        panel.key(Key::Disc(BURR), "burr at the deepest insertion");
    }
    panel.line(&path_panel.end, Stroke::full(INK, 2.2), "tool at the deepest insertion");
    let links = path_panel.end.len().saturating_sub(2);
    for &link in path_panel.end.iter().skip(1).take(links) {
        panel.disc(link, 2.4, INK);
    }
    panel.line(
        &path_panel.path,
        Stroke { dash: &[9.0, 3.0], ..Stroke::full(COLOURS[0], 2.0) },
        "path of the burr's centre",
    );
    if let Some(target) = path_panel.target {
        let stroke = Stroke::full(COLOURS[1], 2.2);
        panel.mark(target, Key::Cross(stroke));
        panel.key(Key::Cross(stroke), "target of the burr's centre");
    }
    panel.finish();
}

/// Returns axes with equal scale that contain all points and fill the area.
fn equal_axes(points: &[Point], area: Rect) -> (Axis, Axis) {
    let range = |values: Vec<f64>| bounds(values.into_iter()).unwrap_or((-1.0, 1.0));
    let x = range(points.iter().map(|p| p.0).collect());
    let y = range(points.iter().map(|p| p.1).collect());
    let per_unit = ((x.1 - x.0) / area.width).max((y.1 - y.0) / area.height).max(1e-3) * 1.1;
    let around = |(low, high): (f64, f64), length: f64| {
        let (middle, half) = (0.5 * (low + high), 0.5 * per_unit * length);
        (middle - half, middle + half)
    };
    let (x, y) = (around(x, area.width), around(y, area.height));
    let x = Axis::linear("bend direction, from the burr's start (mm)", x.0, x.1, 6);
    (x, Axis::linear("insertion, from the burr's start (mm)", y.0, y.1, 10))
}

fn draw_over_time(
    figure: &mut Figure,
    outer: Rect,
    title: &str,
    unit: &str,
    end_s: f64,
    lines: &[(&Timeline<Extremes>, String)],
) {
    let values = lines.iter().flat_map(|(line, _)| line.iter()).filter_map(|(_, bin)| bin.range()).flatten();
    let y = Axis::around(unit, values, 5);
    let x = Axis::linear("simulated time (s)", 0.0, end_s, 8);
    let mut panel = Panel::new(figure, outer, title, x, y);
    if lines.is_empty() {
        panel.remark("no data in the log");
    }
    for (i, (line, label)) in lines.iter().enumerate() {
        let bins: Vec<_> = line.iter().filter_map(|(t, bin)| Some((t.min(end_s), bin.range()?))).collect();
        let bands: Vec<_> = bins.iter().map(|&(t, [low, _, high])| (t, low, high)).collect();
        let means: Vec<_> = bins.iter().map(|&(t, [_, mean, _])| (t, mean)).collect();
        let stroke = Stroke::of_palette(i, 1.8);
        panel.band(&bands, lighter(stroke.colour));
        panel.line(&means, stroke, label);
    }
    panel.finish_with_row();
}

/// Returns the colour at 25 % on white.
pub fn lighter(RGBColor(r, g, b): RGBColor) -> RGBColor {
    let mix = |channel: u8| 255 - (255 - channel) / 4;
    RGBColor(mix(r), mix(g), mix(b))
}
