//! Draws a scene before its run.

use figures::{
    Anchor, Axis, BLACK, COLOURS, Figure, FigureError, INK, Panel, Point, RGBColor, Rect, Shape, Stroke,
    TextSize, WHITE, WIDTH, clip, text_width,
};
use ipc_types::scene::Scene;
use nalgebra::Vector3;
use voxel_grid::Volume;
use voxel_grid::slice::ANATOMICAL;

use super::facts::{Facts, Sample};
use super::shape::{Shapes, length};
use super::slice::{END, HOLE, Plane, START};

const MARGIN: f64 = 10.0;
const GAP: f64 = 8.0;
const TEXT: TextSize = TextSize::Label;
const LINE: f64 = 20.0;
/// Height of the title above a slice.
const STRIP: f64 = 24.0;
/// Pixels of a slice per figure unit, as in the file.
const PIXELS: f64 = 2.0;
/// Minimum and maximum half width of the slices, mm.
const HALF_MM: [f64; 2] = [25.0, 70.0];
/// Margin around the path, mm.
const AROUND_MM: f64 = 14.0;
/// Parts of the path within this distance of a plane are drawn solid, the rest dashed, mm.
const NEAR_MM: f64 = 1.5;
const ALONG_HEIGHT: f64 = 300.0;
const PROFILE_HEIGHT: f64 = 230.0;
const PATH: RGBColor = RGBColor(204, 121, 167);

/// Contents of a picture.
pub struct PictureInput<'a> {
    pub scene: &'a Scene,
    pub volume: &'a Volume,
    pub shapes: &'a Shapes,
    pub facts: &'a Facts,
}

/// Draws the picture.
pub fn draw(of: &PictureInput<'_>) -> Result<Figure, FigureError> {
    let lines = words(of);
    let places = places(of.facts);
    let side = (WIDTH - 2.0 * MARGIN - 2.0 * GAP) / 3.0;
    let head = 44.0;
    let legend = LINE + 8.0;
    let rows = (side + STRIP) * places.len() as f64;
    let height =
        head + legend + rows + STRIP + ALONG_HEIGHT + PROFILE_HEIGHT + LINE * (lines.len() as f64 + 1.0);
    let mut figure = Figure::new(height)?;
    figure.text(
        (MARGIN, 22.0),
        &format!("{}: the plan in its CT", of.scene.name),
        TextSize::Title,
        INK,
        Anchor::Left,
    );
    draw_legend(&mut figure, head + 4.0, of.shapes.is_planned);
    let half_mm = half_mm(of.shapes);
    let mut top = head + legend;
    for (name, sample) in &places {
        for (column, view) in ANATOMICAL.iter().enumerate() {
            let x = MARGIN + column as f64 * (side + GAP);
            let title = format!("{name}, {}", view.name);
            figure.text((x, top + 0.5 * STRIP), &title, TEXT, INK, Anchor::Left);
            let plane = Plane {
                centre_mm: sample.place_mm,
                right: Vector3::from(view.right),
                down: Vector3::from(view.down),
                half_mm: [half_mm; 2],
            };
            let area = Rect { x, y: top + STRIP, width: side, height: side - 4.0 };
            let slice = Slice { of, plane, area };
            slice.draw(&mut figure, &places, Some(&view.letters));
        }
        top += side + STRIP;
    }
    let title = "along the path: feed to the right, bend upward";
    figure.text((MARGIN, top + 0.5 * STRIP), title, TEXT, INK, Anchor::Left);
    let area = Rect { x: MARGIN, y: top + STRIP, width: WIDTH - 2.0 * MARGIN, height: ALONG_HEIGHT - 8.0 };
    Slice { of, plane: along_plane(of.shapes, &area), area }.draw(&mut figure, &places, None);
    top += STRIP + ALONG_HEIGHT;
    draw_profile(&mut figure, Rect { x: 0.0, y: top, width: WIDTH, height: PROFILE_HEIGHT }, of, &places);
    top += PROFILE_HEIGHT;
    for (row, line) in lines.iter().enumerate() {
        figure.text((MARGIN, top + LINE * (row as f64 + 0.5)), line, TEXT, INK, Anchor::Left);
    }
    Ok(figure)
}

/// Returns the named points through which slices are taken.
fn places(facts: &Facts) -> Vec<(&'static str, Sample)> {
    let entry = facts.entry.map(|entry| ("Entry", entry));
    let end = ("Target", facts.target);
    entry.into_iter().chain([("Burr start", facts.start), end]).collect()
}

/// Returns the half width that contains the path, within the bounds.
fn half_mm(shapes: &Shapes) -> f64 {
    let middle = 0.5 * (shapes.path_mm.first().copied().unwrap_or(shapes.start_mm) + shapes.target_mm());
    let far = |point: &Vector3<f64>| (point - middle).amax();
    let most = shapes.path_mm.iter().map(far).fold(0.0, f64::max);
    (most + AROUND_MM).clamp(HALF_MM[0], HALF_MM[1])
}

/// Returns the plane of feed and bend around the path and the bending part of the tool.
fn along_plane(shapes: &Shapes, area: &Rect) -> Plane {
    let side = shapes.along.cross(&shapes.toward);
    let from_start = |point: &Vector3<f64>| {
        let away = point - shapes.start_mm;
        [away.dot(&shapes.along), away.dot(&shapes.toward)]
    };
    let mut points: Vec<[f64; 2]> = shapes.path_mm.iter().map(from_start).collect();
    points.push([-AROUND_MM, 0.0]);
    let range = |axis: usize| {
        let values = points.iter().map(|point| point[axis]);
        let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)));
        [low - AROUND_MM, high + AROUND_MM]
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
        self.draw_path(figure);
        for (name, sample) in places {
            self.draw_mark(figure, name, &sample.place_mm);
        }
        if let Some([left, right, upper, lower]) = letters {
            let (middle_x, middle_y) = (x + 0.5 * width, y + 0.5 * height);
            chip(figure, (x + 10.0, middle_y), left);
            chip(figure, (x + width - 10.0, middle_y), right);
            chip(figure, (middle_x, y + 11.0), upper);
            chip(figure, (middle_x, y + height - 11.0), lower);
        }
        self.draw_scale_bar(figure);
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

    /// Draws the path, solid within the slice, dashed in front of or behind it.
    fn draw_path(&self, figure: &mut Figure) {
        let placed: Vec<(Point, f64)> =
            self.of.shapes.path_mm.iter().map(|point| self.place(point)).collect();
        let mut from = 0;
        while from + 1 < placed.len() {
            let is_near = |index: usize| placed[index].1.abs() <= NEAR_MM;
            let kind = is_near(from + 1);
            let mut to = from + 1;
            while to + 1 < placed.len() && is_near(to + 1) == kind {
                to += 1;
            }
            let points: Vec<Point> = placed[from..=to].iter().map(|(point, _)| *point).collect();
            let dash: &[f64] = if kind { &[] } else { &[5.0, 4.0] };
            for run in clip(&points, self.area) {
                figure.line(run.clone(), Stroke::full(BLACK, if kind { 4.0 } else { 0.1 }));
                figure.line(run, Stroke { colour: PATH, width: 2.2, dash });
            }
            from = to;
        }
    }

    /// Draws a cross with a letter if the point is in the picture.
    fn draw_mark(&self, figure: &mut Figure, name: &str, place_mm: &Vector3<f64>) {
        let ((x, y), before) = self.place(place_mm);
        let Rect { x: left, y: top, width, height } = self.area;
        if before.abs() > NEAR_MM
            || x < left + 8.0
            || x > left + width - 22.0
            || y < top + 22.0
            || y > top + height - 8.0
        {
            return;
        }
        for (colour, size) in [(BLACK, 4.0), (WHITE, 2.0)] {
            let stroke = Stroke::full(colour, size);
            figure.line([(x - 6.0, y), (x + 6.0, y)], stroke);
            figure.line([(x, y - 6.0), (x, y + 6.0)], stroke);
        }
        chip(figure, (x + 13.0, y - 13.0), letter(name));
    }

    fn draw_scale_bar(&self, figure: &mut Figure) {
        let length = 10.0 * self.scale();
        let Rect { x, y, width, height } = self.area;
        let (right, foot) = (x + width - 8.0, y + height - 8.0);
        for (colour, size) in [(BLACK, 5.0), (WHITE, 3.0)] {
            figure.line([(right - length, foot), (right, foot)], Stroke::full(colour, size));
        }
        chip(figure, (right - 0.5 * length, foot - 14.0), "10 mm");
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

fn draw_legend(figure: &mut Figure, y: f64, is_planned: bool) {
    let colour = |[r, g, b]: [u8; 3]| RGBColor(r, g, b);
    let path = if is_planned { "path of the burr's centre" } else { "30 mm ahead (no plan)" };
    let mut entries = vec![
        (colour(HOLE), &[][..], "pilot hole"),
        (colour(START), &[][..], "tool at the start"),
        (PATH, &[][..], path),
        (PATH, &[5.0, 4.0][..], "outside the slice"),
    ];
    if is_planned {
        entries.insert(2, (colour(END), &[], "tool at the end"));
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
    let x = Axis::linear("distance along the path (mm)", low, high, 8);
    let y = Axis::around("HU", values.iter().map(|value| value.1), 5);
    let mut panel = Panel::new(figure, outer, "Hounsfield units of the CT along the path", x, y);
    let threshold_hu = of.scene.volume.as_ref().map_or(0, |volume| volume.bone_threshold_hu);
    for (name, sample) in places {
        let stroke = Stroke { colour: INK, width: 1.2, dash: &[2.0, 3.0] };
        panel.upright(sample.along_mm, stroke);
        panel.tag(sample.along_mm, letter(name));
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
    let place = |sample: &Sample| {
        let [x, y, z] = [sample.place_mm.x, sample.place_mm.y, sample.place_mm.z];
        let hu = sample.hu.map_or("outside the CT".to_owned(), |hu| format!("{hu:.0} HU"));
        format!("({x:.1}, {y:.1}, {z:.1}) mm, {hu}")
    };
    let mut lines = vec!["Points are in the patient frame (LPS: +x left, +y posterior, +z head).".to_owned()];
    match &facts.entry {
        Some(entry) => lines.push(format!("E  entry: {}", place(entry))),
        None => lines.push("The path meets no bone.".to_owned()),
    }
    lines.push(format!("S  burr at the start: {}", place(&facts.start)));
    lines.push(format!(
        "T  {}: {}",
        if shapes.is_planned { "target" } else { "30 mm ahead" },
        place(&facts.target)
    ));
    lines.push(format!(
        "Path {:.1} mm, of which {:.1} mm drilled by the tool; {:.1} mm in bone.",
        length(&shapes.path_mm),
        shapes.insertion_mm,
        facts.in_bone_mm
    ));
    if let Some([least, mean, most]) = facts.hu_range() {
        lines.push(format!("From entry to target: {least:.0} to {most:.0} HU, mean {mean:.0} HU."));
    }
    lines.push(format!(
        "Bone around the target: {:.1} mm to the nearest surface, {:.1} mm straight ahead.",
        facts.depth_mm, facts.ahead_mm
    ));
    let wanted = if facts.feed_mm >= shapes.insertion_mm { "enough" } else { "TOO SHORT" };
    lines.push(format!(
        "The arm can feed at least {:.0} mm from the start; the path needs {:.1} mm: {wanted}.",
        facts.feed_mm, shapes.insertion_mm
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
