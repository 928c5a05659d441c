//! `trabecula-lab chart physics`: error against cost for every rung, integrator and baseline, one panel per
//! problem.

mod candidates;
mod contact;
mod drilled;
mod elastica;
mod peers;
mod problems;
pub mod promise;
mod standard;
mod voxel_wall;

use crate::effort::Effort;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::time::Instant;

use figures::{
    Anchor, Axis, Figure, FigureError, INK, Key, Panel, RGBColor, Rect, Stroke, TextSize, WIDTH, bounds,
    duration_label,
};
use ipc_types::scene::ContactVoxels;
use output_file::SavedFile;

use crate::charts::method::Method;
use candidates::Settled;
use peers::Peer;
use problems::{Point, Problem, measure};
use trabecula::failure::Failure;
use trabecula::output::{refuse_existing, within};
use trabecula::plan::Row;
use trabecula::report::ReportError;

const HEIGHT: f64 = 1375.0;
/// Height of the legend.
const FOOT: f64 = 295.0;
/// Errors below this are rounding and are drawn at this value, in each problem's unit.
const ROUNDING: f64 = 1e-4;
/// Okabe and Ito 2008, and greys for the baselines, in the order of [`Method::ALL`].
const COLOURS: [RGBColor; 11] = [
    RGBColor(230, 159, 0),
    RGBColor(240, 228, 66),
    RGBColor(180, 160, 20),
    RGBColor(86, 180, 233),
    RGBColor(0, 114, 178),
    RGBColor(150, 210, 190),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(150, 150, 150),
    RGBColor(90, 90, 90),
    RGBColor(213, 94, 0),
];

const PEER_COLOURS: [RGBColor; 5] = [
    RGBColor(200, 0, 0),
    RGBColor(120, 60, 0),
    RGBColor(90, 0, 140),
    RGBColor(0, 110, 60),
    RGBColor(0, 0, 0),
];

/// Measurements and output of the chart.
#[derive(Debug, Clone)]
pub struct Plan {
    /// Output folder.
    pub out: PathBuf,
    /// Effort.
    pub effort: Effort,
    /// Folder of the peers' scripts.
    pub peers: Option<PathBuf>,
    /// Whether to measure only the settings of plans and the drilled path.
    pub settings_only: bool,
    /// Whether to measure only the peers' contact problem.
    pub contact_only: bool,
}

/// The output files.
const FILES: [&str; 4] =
    ["physics-plan.csv", "accuracy-physics.csv", "accuracy-physics.png", "accuracy-physics.svg"];

/// The output file of the peers' contact problem.
const CONTACT_FILE: &str = "peers-contact.csv";

/// First line of a CSV.
const COLUMNS: &str = "problem,method,links,dt_ms,us_per_ms,figure,value\n";

/// Measures, and writes `accuracy-physics.svg`, `.png` and `.csv`, and `physics-plan.csv`, to the folder; for
/// the settings alone, only the last one.
///
/// # Errors
/// A file that cannot be written.
pub fn run(plan: &Plan) -> Result<(), Failure> {
    let folder = &plan.out;
    if let (Some(scripts), true) = (&plan.peers, plan.contact_only) {
        return contact_alone(scripts, folder, plan.effort);
    }
    refuse_existing(&within(folder, if plan.settings_only { &FILES[..1] } else { &FILES }))?;
    output_file::create_folder(folder).map_err(Failure::folder(folder))?;
    let (all, mut measured) = (Instant::now(), Vec::new());
    for problem in if plan.settings_only { &[][..] } else { &Problem::BEAM[..] } {
        let began = Instant::now();
        measured.push((*problem, measure_all(*problem, plan.effort)?));
        took(problem.key(), began);
    }
    let (mut peers, mut contact) = (Vec::new(), Vec::new());
    if let Some(scripts) = &plan.peers {
        let began = Instant::now();
        peers = peers::measure(scripts, folder, plan.effort)?;
        contact = contact::measure(scripts, folder, plan.effort)?;
        took("peers", began);
    }
    // Saves the settings as they are measured, so that an interrupted run keeps its results.
    let mut settings = SavedFile::create(&folder.join(FILES[0]))?;
    let save = |rows: &[Row]| Ok(settings.save(trabecula::plan::write(rows))?);
    let began = Instant::now();
    let Settled { mut rows, beside, coarse_mm } = candidates::measure(plan.effort, save)?;
    took("settings and drilled path", began);
    if plan.settings_only {
        return Ok(());
    }
    rows.push(beside);
    measured.push((Problem::Drilled, drilled_points(&rows)));
    let mut text = csv(&measured);
    // Writing to a String cannot fail.
    let name = format!("path error at voxel {} mm (µm)", candidates::COARSE_MM);
    let _ = writeln!(text, "drilled,planar hybrid,27,1,,{name},{:.6e}", coarse_mm * 1e3);
    for peer in &peers {
        let (problem, name) = (peer.problem, &peer.name);
        let head = format!("{},{name},{},{}", problem.key(), peer.links, peer.dt_ms);
        let _ = writeln!(text, "{head},{:.3},{},{:.6e}", peer.us_per_ms, problem.axis(), peer.error);
        if let Some(ratio) = peer.cost_ratio {
            let _ =
                writeln!(text, "{head},{:.3},cost over ours at no larger error,{ratio:.3}", peer.us_per_ms);
        }
    }
    text += &contact::csv(&contact);
    let [png, svg] = draw(&measured, &peers)
        .and_then(|figure| figure.files(folder, "accuracy-physics"))
        .map_err(ReportError::from)?;
    output_file::write_all(&[(folder.join(FILES[1]), text.into_bytes()), png, svg])?;
    took("all", all);
    Ok(())
}

/// Measures the peers' contact problem, and writes `peers-contact.csv`.
fn contact_alone(scripts: &Path, folder: &Path, effort: Effort) -> Result<(), Failure> {
    refuse_existing(&within(folder, &[CONTACT_FILE]))?;
    output_file::create_folder(folder).map_err(Failure::folder(folder))?;
    let all = contact::measure(scripts, folder, effort)?;
    output_file::write(&folder.join(CONTACT_FILE), COLUMNS.to_owned() + &contact::csv(&all))?;
    Ok(())
}

fn took(what: &str, began: Instant) {
    say!("({what}: {:.0} s)", began.elapsed().as_secs_f64());
}

fn measure_all(problem: Problem, effort: Effort) -> Result<Vec<Point>, Failure> {
    let mut points = Vec::new();
    for method in Method::ALL {
        let own = measure(problem, method, effort).map_err(|cause| Failure::failed(cause.to_string()))?;
        for point in &own {
            say!("{}", line(problem, point));
        }
        points.extend(own);
    }
    Ok(points)
}

/// Returns the drilled paths with the tool's own flexures, and the arc unchanged; with voxels as planes,
/// because no line joins planes and balls.
fn drilled_points(rows: &[Row]) -> Vec<Point> {
    let most = rows.iter().map(|row| row.settings.links).max().unwrap_or(0);
    let is_drawn = |row: &&Row| {
        row.settings.links == most
            && row.settings.contact == ContactVoxels::Planes
            && row.drilling_us_per_ms.is_finite()
    };
    rows.iter()
        .filter(is_drawn)
        .map(|row| Point {
            method: candidates::method(&row.settings),
            links: row.settings.links,
            dt_ms: row.settings.dt_ms,
            us_per_ms: row.drilling_us_per_ms,
            error: row.drilled_path_mm * 1e3,
            more: Vec::new(),
        })
        .collect()
}

fn line(problem: Problem, point: &Point) -> String {
    let more: String = point.more.iter().map(|(name, value)| format!(", {name} {value:.4}")).collect();
    format!(
        "{:<11} {:<19} {:>2} links, dt {:>7} ms: {:>9.2} us/ms, error {:.4}{more}",
        problem.key(),
        point.method.name(),
        point.links,
        point.dt_ms,
        point.us_per_ms,
        point.error
    )
}

fn csv(measured: &[(Problem, Vec<Point>)]) -> String {
    let mut text = String::from(COLUMNS);
    for (problem, points) in measured {
        for point in points {
            let error = [(problem.axis(), point.error)];
            for (figure, value) in error.iter().chain(&point.more) {
                // Writing to a String cannot fail.
                let _ = writeln!(
                    text,
                    "{},{},{},{},{:.3},{figure},{value:.6e}",
                    problem.key(),
                    point.method.name(),
                    point.links,
                    point.dt_ms,
                    point.us_per_ms
                );
            }
        }
    }
    text
}

fn draw(measured: &[(Problem, Vec<Point>)], peers: &[Peer]) -> Result<Figure, FigureError> {
    let title = "Physics: error against the cost of a simulated millisecond (lower left is better)";
    let mut figure = Figure::titled(HEIGHT, title)?;
    for (cell, (problem, points)) in figure.cells(2, 3, FOOT).into_iter().zip(measured) {
        let peers: Vec<&Peer> = peers.iter().filter(|peer| peer.problem == *problem).collect();
        draw_panel(&mut figure, cell, *problem, points, &peers);
    }
    let top = HEIGHT - FOOT + 24.0;
    draw_peer_legend(&mut figure, 0.5 * WIDTH + 70.0, top, peers);
    draw_legend(&mut figure, 70.0, top);
    Ok(figure)
}

fn shown(point: &Point) -> (f64, f64) {
    (point.us_per_ms, point.error.max(ROUNDING))
}

fn draw_panel(figure: &mut Figure, cell: Rect, problem: Problem, points: &[Point], peers: &[&Peer]) {
    let peer = |peer: &&Peer| (peer.us_per_ms, peer.error.max(ROUNDING));
    let of_peers = || peers.iter().filter(|peer| peer.error.is_finite()).map(peer);
    let sound = || points.iter().filter(|point| point.error.is_finite()).map(shown).chain(of_peers());
    let high = bounds(sound().map(|(_, error)| error)).map_or(1.0, |(_, high)| high);
    let label = |value: f64| {
        if (0.01..1e5).contains(&value) { format!("{value}") } else { format!("{value:.0e}") }
    };
    let x = Axis::logarithmic("time of a simulated millisecond", sound().map(|(us, _)| us), duration_label);
    // Errors above 100 mm or equivalent are drawn at the same height.
    let y = Axis::logarithmic(problem.axis(), sound().map(|(_, error)| error).chain([high]), label);
    let mut panel = Panel::new(figure, cell, problem.title(), x, y);
    for (method, colour) in Method::ALL.into_iter().zip(COLOURS) {
        let line: Vec<(f64, f64)> =
            points.iter().filter(|p| p.method == method && p.error.is_finite()).map(shown).collect();
        panel.line(&line, stroke(method, colour), "");
        for value in line {
            panel.mark(value, Key::Disc(colour));
        }
    }
    for (name, colour) in peers::NAMES.into_iter().zip(PEER_COLOURS) {
        let of_name = peers.iter().filter(|peer| peer.name == name && peer.error.is_finite());
        for value in of_name.map(peer) {
            panel.mark(value, Key::Cross(Stroke::full(colour, 2.0)));
        }
    }
    panel.finish();
}

fn stroke(method: Method, colour: RGBColor) -> Stroke {
    let dash: &[f64] = if method.is_ours() { &[] } else { &[5.0, 3.0] };
    Stroke { colour, width: 2.0, dash }
}

/// Draws the legend of the peers, which are crosses.
fn draw_peer_legend(figure: &mut Figure, left: f64, top: f64, peers: &[Peer]) {
    let measured = |name: &str| peers.iter().any(|peer| peer.name == name);
    let shown = peers::NAMES.into_iter().zip(PEER_COLOURS).filter(|(name, _)| measured(name));
    for (i, (name, colour)) in shown.enumerate() {
        let y = top + 22.0 * i as f64;
        Key::Cross(Stroke::full(colour, 2.0)).draw(figure, (left + 15.0, y));
        figure.text((left + 40.0, y), name, TextSize::Label, INK, Anchor::Left);
    }
}

fn draw_legend(figure: &mut Figure, left: f64, top: f64) {
    for (i, (method, colour)) in Method::ALL.into_iter().zip(COLOURS).enumerate() {
        let y = top + 22.0 * i as f64;
        for key in [Key::Line(stroke(method, colour)), Key::Disc(colour)] {
            key.draw(figure, (left + 15.0, y));
        }
        figure.text((left + 40.0, y), &method.name(), TextSize::Label, INK, Anchor::Left);
    }
    let note = "Errors below 0.0001 are shown there; a method that lost the tool has no point.";
    figure.text((left, top + 22.0 * 11.5), note, TextSize::Label, INK, Anchor::Left);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_lies_over_anything() {
        let point = |index: usize, method: Method| Point {
            method,
            links: 27,
            dt_ms: 1.0,
            us_per_ms: 3.0 * 1.7_f64.powi(index as i32),
            error: 1e3 * 0.1_f64.powi(index as i32),
            more: Vec::new(),
        };
        let problems = [
            Problem::EndMoment,
            Problem::TipForce,
            Problem::Capstan,
            Problem::Vibration,
            Problem::Wall,
            Problem::Drilled,
        ];
        let points = || Method::ALL.into_iter().enumerate().map(|(index, method)| point(index, method));
        let measured: Vec<_> = problems.map(|problem| (problem, points().collect())).into();
        assert_eq!(draw(&measured, &[]).unwrap().collisions(), []);
    }
}
