//! Draws a scene before its run.

use figures::{
    Anchor, Axis, BLACK, COLOURS, Figure, FigureError, INK, Panel, Point, RGBColor, Rect, Shape, Stroke,
    TextSize, WHITE, WIDTH, bounds, clip, text_width,
};
use ipc_types::scene::Scene;
use nalgebra::Vector3;
use voxel_grid::Volume;
use voxel_grid::slice::ANATOMICAL;

use super::facts::{Facts, Sample};
use super::scale::Scale;
use super::shape::{Shapes, length};
use super::slice::{END, HOLE, PREDICTED, Plane, START};

const MARGIN: f64 = 10.0;
const GAP: f64 = 8.0;
const TEXT: TextSize = TextSize::Label;
const LINE: f64 = 18.0;
/// Height of the title above a slice.
const STRIP: f64 = 24.0;
/// Height of the title and of the legend.
const HEAD: f64 = 68.0;
/// Pixels of a slice per figure unit, as in the file.
const PIXELS: f64 = 2.0;
/// Height of a slice.
const SLICE_HEIGHT: f64 = 210.0;
/// Maximum half height of a slice, mm.
const MOST_HALF_MM: f64 = 150.0;
/// Points closer than this share their letters.
const TOGETHER: f64 = 18.0;
/// Width of a letter at the frame of the profile.
const TAG: f64 = 13.0;
/// Height of the lower row, and width of its left picture.
const ALONG_HEIGHT: f64 = 240.0;
const ALONG_WIDTH: f64 = 500.0;
const PATH: RGBColor = RGBColor(204, 121, 167);
const START_NAME: &str = "Burr start";

/// Contents of a picture.
pub struct PictureInput<'a> {
    pub scene: &'a Scene,
    pub volume: &'a Volume,
    pub shapes: &'a Shapes,
    pub facts: &'a Facts,
}

/// Draws the picture: anatomical slices through the entry and the target, the plane of feed and bend, the
/// Hounsfield units along the path, and the measurements.
pub fn draw(of: &PictureInput<'_>) -> Result<Figure, FigureError> {
    let (lines, places) = (words(of), places(of.facts));
    let in_rows: Vec<&(&str, Sample)> = places.iter().filter(|(name, _)| *name != START_NAME).collect();
    let width = (WIDTH - 2.0 * MARGIN - 2.0 * GAP) / 3.0;
    let rows = in_rows.len() as f64 * (STRIP + SLICE_HEIGHT);
    let mut figure = Figure::new(HEAD + rows + STRIP + ALONG_HEIGHT + LINE * (lines.len() as f64 + 1.0))?;
    let title = format!("{}: the plan in its CT", of.scene.name);
    figure.text((MARGIN, 22.0), &title, TextSize::Title, INK, Anchor::Left);
    draw_legend(&mut figure, 48.0, of.shapes);
    let half_mm = half_mm(of) * width / SLICE_HEIGHT;
    let mut top = HEAD;
    for (name, sample) in in_rows {
        for (column, view) in ANATOMICAL.iter().enumerate() {
            let x = MARGIN + column as f64 * (width + GAP);
            let title = format!("{name}, {}", view.name);
            figure.text((x, top + 0.5 * STRIP), &title, TEXT, INK, Anchor::Left);
            let plane = Plane {
                centre_mm: sample.place_mm,
                right: Vector3::from(view.right),
                down: Vector3::from(view.down),
                half_mm: [half_mm; 2],
            };
            let area = Rect { x, y: top + STRIP, width, height: SLICE_HEIGHT - 4.0 };
            Slice { of, plane, area }.draw(&mut figure, &places, Some(&view.letters));
        }
        top += STRIP + SLICE_HEIGHT;
    }
    let title = "along the path: feed to the right, bend upward";
    figure.text((MARGIN, top + 0.5 * STRIP), title, TEXT, INK, Anchor::Left);
    let area = Rect { x: MARGIN, y: top + STRIP, width: ALONG_WIDTH, height: ALONG_HEIGHT - 8.0 };
    Slice { of, plane: along_plane(of, &area), area }.draw(&mut figure, &places, None);
    let (x, height) = (MARGIN + ALONG_WIDTH + GAP, STRIP + ALONG_HEIGHT);
    draw_profile(&mut figure, Rect { x, y: top, width: WIDTH - x, height }, of, &places);
    top += STRIP + ALONG_HEIGHT;
    for (row, line) in lines.iter().enumerate() {
        figure.text((MARGIN, top + LINE * (row as f64 + 0.5)), line, TEXT, INK, Anchor::Left);
    }
    Ok(figure)
}

/// Returns the named points; the burr's start is marked, but has no slices of its own.
fn places(facts: &Facts) -> Vec<(&'static str, Sample)> {
    let entry = facts.entry.map(|entry| ("Entry", entry));
    entry.into_iter().chain([(START_NAME, facts.start), ("Target", facts.target)]).collect()
}

/// Returns the points of the path to show: those in the volume, or all if none is.
fn shown_mm(of: &PictureInput<'_>) -> Vec<Vector3<f64>> {
    let inside = of.facts.profile.iter().filter(|sample| sample.hu.is_some());
    let points: Vec<Vector3<f64>> = inside.map(|sample| sample.place_mm).collect();
    if points.is_empty() { of.shapes.path_mm.clone() } else { points }
}

/// Returns the half height that contains the path, within the bounds.
fn half_mm(of: &PictureInput<'_>) -> f64 {
    let (points, scale) = (shown_mm(of), &of.facts.scale);
    let extent = |axis: usize| bounds(points.iter().map(|point| point[axis])).map_or(0.0, |(a, b)| b - a);
    let most_mm = 0.5 * (0..3).map(extent).fold(0.0, f64::max);
    (most_mm + scale.margin_mm).clamp(scale.least_half_mm, MOST_HALF_MM)
}

/// Returns the plane of feed and bend around the path and the bending part of the tool.
fn along_plane(of: &PictureInput<'_>, area: &Rect) -> Plane {
    let (shapes, scale) = (of.shapes, &of.facts.scale);
    let side = shapes.along.cross(&shapes.toward);
    let from_start = |point: &Vector3<f64>| {
        let away = point - shapes.start_mm;
        [away.dot(&shapes.along), away.dot(&shapes.toward)]
    };
    let mut points: Vec<[f64; 2]> = shown_mm(of).iter().map(from_start).collect();
    points.push([-scale.margin_mm, 0.0]);
    let range = |axis: usize| {
        let (low, high) = bounds(points.iter().map(|point| point[axis])).unwrap_or_default();
        [low - scale.margin_mm, high + scale.margin_mm]
    };
    let (ahead, beside) = (range(0), range(1));
    let half = |[low, high]: [f64; 2]| 0.5 * (high - low);
    let middle = |[low, high]: [f64; 2]| 0.5 * (low + high);
    // The same scale in both directions.
    let ratio = area.width / area.height;
    let wide = half(ahead).max(half(beside) * ratio);
    // Shift the plane half-way towards a target outside it.
    let off = 0.5 * (shapes.target_mm() - shapes.start_mm).dot(&side);
    Plane {
        centre_mm: shapes.start_mm
            + shapes.along * middle(ahead)
            + shapes.toward * middle(beside)
            + side * off,
        right: shapes.along,
        down: -shapes.toward,
        half_mm: [wide, wide / ratio],
    }
}

/// A slice and its position in the figure.
struct Slice<'a> {
    of: &'a PictureInput<'a>,
    plane: Plane,
    area: Rect,
}

impl Slice<'_> {
    fn draw(&self, figure: &mut Figure, places: &[(&str, Sample)], letters: Option<&[&str; 4]>) {
        let Rect { x, y, width, height } = self.area;
        let (columns, rows) = ((PIXELS * width) as usize, (PIXELS * height) as usize);
        let plane = Plane {
            half_mm: [self.plane.half_mm[0], self.plane.half_mm[0] * height / width],
            ..self.plane.clone()
        };
        let rgb = plane.pixels(self.of.volume, self.of.shapes, columns, rows);
        figure.add(Shape::Picture { corner: (x, y), width, height, columns, rows, rgb });
        self.draw_path(figure, &self.of.shapes.path_mm, PATH);
        if let Some((path_mm, _)) = &self.of.shapes.predicted {
            let [r, g, b] = PREDICTED;
            self.draw_path(figure, path_mm, RGBColor(r, g, b));
        }
        self.draw_marks(figure, places);
        if let Some([left, right, upper, lower]) = letters {
            let (middle_x, middle_y) = (x + 0.5 * width, y + 0.5 * height);
            chip(figure, (x + 10.0, middle_y), left);
            chip(figure, (x + width - 10.0, middle_y), right);
            chip(figure, (middle_x, y + 11.0), upper);
            chip(figure, (middle_x, y + height - 11.0), lower);
        }
        self.draw_scale_bar(figure);
    }

    /// Returns the distance from the plane within which points are in the picture, mm.
    fn near_mm(&self) -> f64 {
        Scale::near_mm(self.plane.half_mm[0].min(self.plane.half_mm[1]))
    }

    /// Returns figure units per millimetre.
    fn scale(&self) -> f64 {
        0.5 * self.area.width / self.plane.half_mm[0]
    }

    fn place(&self, point_mm: &Vector3<f64>) -> (Point, f64) {
        let [right, down, before] = self.plane.place_mm(point_mm);
        let Rect { x, y, width, height } = self.area;
        ((x + 0.5 * width + right * self.scale(), y + 0.5 * height + down * self.scale()), before)
    }

    /// Draws a path, solid within the slice, dashed in front of or behind it.
    fn draw_path(&self, figure: &mut Figure, path_mm: &[Vector3<f64>], colour: RGBColor) {
        let placed: Vec<(Point, f64)> = path_mm.iter().map(|point| self.place(point)).collect();
        let mut from = 0;
        while from + 1 < placed.len() {
            let is_near = |index: usize| placed[index].1.abs() <= self.near_mm();
            let kind = is_near(from + 1);
            let mut to = from + 1;
            while to + 1 < placed.len() && is_near(to + 1) == kind {
                to += 1;
            }
            let points: Vec<Point> = placed[from..=to].iter().map(|(point, _)| *point).collect();
            let dash: &[f64] = if kind { &[] } else { &[5.0, 4.0] };
            for run in clip(&points, self.area) {
                figure.line(run.clone(), Stroke::full(BLACK, if kind { 4.0 } else { 0.1 }));
                figure.line(run, Stroke { colour, width: 2.2, dash });
            }
            from = to;
        }
    }

    /// Returns where a point is in the picture, if it is.
    fn visible(&self, place_mm: &Vector3<f64>) -> Option<Point> {
        let ((x, y), before) = self.place(place_mm);
        let Rect { x: left, y: top, width, height } = self.area;
        let is_across = x >= left + 8.0 && x <= left + width - 22.0;
        let is_down = y >= top + 22.0 && y <= top + height - 8.0;
        (before.abs() <= self.near_mm() && is_across && is_down).then_some((x, y))
    }

    /// Draws a cross for each point in the picture; points that lie together share their letters.
    fn draw_marks(&self, figure: &mut Figure, places: &[(&str, Sample)]) {
        let mut letters: Vec<(Point, String)> = Vec::new();
        for (name, sample) in places {
            let Some((x, y)) = self.visible(&sample.place_mm) else { continue };
            for (colour, size) in [(BLACK, 4.0), (WHITE, 2.0)] {
                let stroke = Stroke::full(colour, size);
                figure.line([(x - 6.0, y), (x + 6.0, y)], stroke);
                figure.line([(x, y - 6.0), (x, y + 6.0)], stroke);
            }
            let is_near = |((a, b), _): &&mut (Point, String)| (x - *a).hypot(y - *b) < TOGETHER;
            match letters.iter_mut().find(is_near) {
                Some((_, text)) => *text = format!("{text} {}", letter(name)),
                None => letters.push(((x, y), letter(name).to_owned())),
            }
        }
        for ((x, y), text) in letters {
            chip(figure, (x + 10.0 + 0.5 * text_width(&text, TEXT), y - 13.0), &text);
        }
    }

    fn draw_scale_bar(&self, figure: &mut Figure) {
        let bar_mm = Scale::bar_mm(self.plane.half_mm[0]);
        let length = bar_mm * self.scale();
        let Rect { x, y, width, height } = self.area;
        let (right, foot) = (x + width - 8.0, y + height - 8.0);
        for (colour, size) in [(BLACK, 5.0), (WHITE, 3.0)] {
            figure.line([(right - length, foot), (right, foot)], Stroke::full(colour, size));
        }
        let text = format!("{bar_mm} mm");
        let half = 0.5 * length.max(text_width(&text, TEXT) + 6.0);
        chip(figure, (right - half, foot - 14.0), &text);
    }
}

/// Returns the letter of a point.
fn letter(name: &str) -> &'static str {
    match name {
        "Entry" => "E",
        "Target" => "T",
        _ => "S",
    }
}

/// Draws text centred on a white background.
fn chip(figure: &mut Figure, (x, y): Point, text: &str) {
    let (half, tall) = (0.5 * text_width(text, TEXT) + 3.0, 9.0);
    figure.rectangle(Rect { x: x - half, y: y - tall, width: 2.0 * half, height: 2.0 * tall }, WHITE);
    figure.text((x, y), text, TEXT, INK, Anchor::Centre);
}

fn draw_legend(figure: &mut Figure, y: f64, shapes: &Shapes) {
    let is_planned = shapes.is_planned;
    let colour = |[r, g, b]: [u8; 3]| RGBColor(r, g, b);
    let path = if is_planned { "path of the burr's centre" } else { "30 mm ahead (no plan)" };
    let mut entries = vec![
        (colour(HOLE), &[][..], "pilot hole"),
        (colour(START), &[][..], "tool at the start"),
        (PATH, &[][..], path),
        (PATH, &[5.0, 4.0][..], "outside the slice"),
    ];
    if is_planned {
        entries.insert(2, (colour(END), &[], "at the end"));
    }
    if shapes.predicted.is_some() {
        entries.push((colour(PREDICTED), &[], "predicted"));
    }
    let mut x = MARGIN;
    for (colour, dash, text) in entries {
        let points = [(x, y), (x + 26.0, y)];
        figure.line(points, Stroke::full(RGBColor(120, 120, 120), 7.0));
        figure.line(points, Stroke { colour, width: 4.0, dash });
        figure.text((x + 32.0, y), text, TEXT, INK, Anchor::Left);
        x += 46.0 + text_width(text, TEXT);
    }
}

fn draw_profile(figure: &mut Figure, outer: Rect, of: &PictureInput<'_>, places: &[(&str, Sample)]) {
    let profile = &of.facts.profile;
    let values: Vec<Point> =
        profile.iter().filter_map(|sample| Some((sample.along_mm, sample.hu?))).collect();
    let low = values.first().map_or(0.0, |first| first.0);
    let high = values.last().map_or(1.0, |last| last.0);
    // Room for the letter of the target.
    let x = Axis::linear("distance along the path (mm)", low, high + 0.06 * (high - low), 5);
    // Room for the letters above the curve.
    let top = bounds(values.iter().map(|value| value.1)).map(|(low, high)| high + 0.12 * (high - low));
    let y = Axis::around("HU", values.iter().map(|value| value.1).chain(top), 5);
    let mut panel = Panel::new(figure, outer, "HU along the path", x, y);
    let threshold_hu = of.scene.volume.as_ref().map_or(0, |volume| volume.bone_threshold_hu);
    let mut marks: Vec<(f64, &str)> =
        places.iter().map(|(name, sample)| (sample.along_mm, letter(name))).collect();
    marks.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut free_mm = f64::NEG_INFINITY;
    for (along_mm, letter) in marks {
        let stroke = Stroke { colour: INK, width: 1.2, dash: &[2.0, 3.0] };
        panel.upright(along_mm, stroke);
        let tag_mm = along_mm.max(free_mm);
        panel.tag(tag_mm, letter);
        free_mm = tag_mm + TAG / panel.scale();
    }
    let limit = f64::from(threshold_hu);
    let stroke = Stroke { colour: COLOURS[1], width: 1.6, dash: &[7.0, 3.0] };
    panel.line(&[(low, limit), (high, limit)], stroke, &format!("bone from {threshold_hu} HU"));
    panel.line(&values, Stroke::full(COLOURS[0], 2.0), "");
    panel.finish_with_row();
}

/// Formats the measurements in lines that fit the picture.
fn words(of: &PictureInput<'_>) -> Vec<String> {
    let (shapes, facts) = (of.shapes, of.facts);
    let decimals = facts.scale.decimals();
    let place = |sample: &Sample| {
        let [x, y, z] = [sample.place_mm.x, sample.place_mm.y, sample.place_mm.z];
        let hu = sample.hu.map_or("outside the CT".to_owned(), |hu| format!("{hu:.0} HU"));
        format!("({x:.decimals$}, {y:.decimals$}, {z:.decimals$}) mm, {hu}")
    };
    let mut lines = vec!["Points are in the patient frame (LPS: +x left, +y posterior, +z head).".to_owned()];
    match &facts.entry {
        Some(entry) => {
            let note = facts.entry_note().map_or(String::new(), |note| format!("; {note}"));
            lines.push(format!("E  entry into bone: {}{note}", place(entry)));
        }
        None => lines.push("The path meets no bone.".to_owned()),
    }
    lines.push(format!("S  burr at the start: {}", place(&facts.start)));
    lines.push(format!(
        "T  {}: {}",
        if shapes.is_planned { "target" } else { "30 mm ahead" },
        place(&facts.target)
    ));
    lines.push(format!(
        "Path {:.decimals$} mm, of which {:.decimals$} mm drilled by the tool; {:.decimals$} mm in bone.",
        length(&shapes.path_mm),
        shapes.insertion_mm,
        facts.in_bone_mm
    ));
    if let Some([least, mean, most]) = facts.hu_range() {
        lines.push(format!("From entry to target: {least:.0} to {most:.0} HU, mean {mean:.0} HU."));
    }
    lines.push(format!(
        "Bone around the target: {:.decimals$} mm to the nearest surface, {:.decimals$} mm straight ahead.",
        facts.depth_mm, facts.ahead_mm
    ));
    let needed = shapes.insertion_mm;
    let wanted = if facts.feed_mm >= shapes.insertion_mm { "enough" } else { "TOO SHORT" };
    lines.push(format!(
        "The arm can feed at least {:.0} mm from the start; the path needs {needed:.decimals$} mm: {wanted}.",
        facts.feed_mm
    ));
    match facts.findings.is_empty() {
        true => lines.push("`scene check`: no warnings.".to_owned()),
        false => lines.extend(facts.findings.iter().cloned()),
    }
    lines.iter().flat_map(|line| wrapped(line)).collect()
}

/// Wraps text to the width of the picture.
fn wrapped(text: &str) -> Vec<String> {
    let most = WIDTH - 2.0 * MARGIN;
    let mut lines = vec![String::new()];
    for word in text.split(' ') {
        let Some(last) = lines.last_mut() else { break };
        let longer = if last.is_empty() { word.to_owned() } else { format!("{last} {word}") };
        if text_width(&longer, TEXT) <= most || last.is_empty() {
            *last = longer;
        } else {
            lines.push(format!("    {word}"));
        }
    }
    lines
}
