//! A panel of a figure: a frame with two axes, lines and a legend.

use plotters::style::{RGBColor, WHITE};

use super::axis::Axis;
use super::shapes::{Anchor, Figure, Point, Shape, Stroke, TextSize, text_width};

/// Colour of text and frame.
pub const INK: RGBColor = RGBColor(40, 40, 40);
/// Blue, vermilion, green, purple: distinguishable with any colour vision (Okabe and Ito 2008).
pub const COLOURS: [RGBColor; 4] =
    [RGBColor(0, 114, 178), RGBColor(213, 94, 0), RGBColor(0, 158, 115), RGBColor(204, 121, 167)];
/// Dashes that distinguish lines without colour, in the order of [`COLOURS`].
pub const DASHES: [&[f64]; 4] = [&[], &[7.0, 3.0], &[2.0, 2.0], &[8.0, 2.5, 2.0, 2.5]];
const GRID: RGBColor = RGBColor(225, 225, 225);
const FAINT_GRID: RGBColor = RGBColor(243, 243, 243);

/// Height of a legend line, and width of its key.
const LEGEND_LINE: f64 = 18.0;
const KEY_WIDTH: f64 = 32.0;
const LEFT: f64 = 68.0;
const RIGHT: f64 = 14.0;
const TOP: f64 = 30.0;
const BOTTOM: f64 = 48.0;
/// Width and height that titles and labels take of a panel.
pub const EDGES: (f64, f64) = (LEFT + RIGHT, TOP + BOTTOM);

/// A rectangle in figure units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rect {
    /// Left edge.
    pub x: f64,
    /// Upper edge.
    pub y: f64,
    /// Width.
    pub width: f64,
    /// Height.
    pub height: f64,
}

impl Rect {
    /// Returns the plot area without titles and labels.
    pub fn plot_area(self) -> Rect {
        Rect { x: self.x + LEFT, y: self.y + TOP, width: self.width - EDGES.0, height: self.height - EDGES.1 }
    }

    /// Returns whether two rectangles overlap.
    pub fn overlaps(self, other: Rect) -> bool {
        let along = |a: f64, a_length: f64, b: f64, b_length: f64| a < b + b_length && b < a + a_length;
        along(self.x, self.width, other.x, other.width) && along(self.y, self.height, other.y, other.height)
    }

    /// Returns whether another rectangle is completely inside.
    pub fn holds(self, other: Rect) -> bool {
        self.contains((other.x, other.y)) && self.contains((other.x + other.width, other.y + other.height))
    }

    fn contains(self, (x, y): Point) -> bool {
        x >= self.x && x <= self.x + self.width && y >= self.y && y <= self.y + self.height
    }
}

/// Half the size of a disc, a ring, a cross or a bar, and half the length of a legend's line.
const MARK: f64 = 5.0;
const HALF_LINE: f64 = 13.0;

/// Symbol of a legend entry, or of a data point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Key {
    /// A line segment.
    Line(Stroke),
    /// A disc.
    Disc(RGBColor),
    /// A disc with a white middle.
    Ring(RGBColor),
    /// A cross.
    Cross(Stroke),
    /// A vertical bar.
    Bar(Stroke),
    /// No symbol.
    None,
}

impl Key {
    /// Draws the symbol centred on a point.
    pub fn draw(self, figure: &mut Figure, (x, y): Point) {
        let mut disc = |radius: f64, fill: RGBColor| figure.add(Shape::Disc { centre: (x, y), radius, fill });
        let lines: &[[Point; 2]] = match self {
            Key::None => &[],
            Key::Disc(fill) => return disc(MARK, fill),
            Key::Ring(fill) => {
                disc(MARK, fill);
                return disc(0.5 * MARK, WHITE);
            }
            Key::Line(_) => &[[(-HALF_LINE, 0.0), (HALF_LINE, 0.0)]],
            Key::Cross(_) => &[[(-MARK, -MARK), (MARK, MARK)], [(-MARK, MARK), (MARK, -MARK)]],
            Key::Bar(_) => &[[(0.0, -MARK), (0.0, MARK)]],
        };
        let (Key::Line(stroke) | Key::Cross(stroke) | Key::Bar(stroke)) = self else { return };
        for line in lines {
            figure.line(line.map(|(right, down)| (x + right, y + down)), stroke);
        }
    }
}

/// A frame with two axes. Curves are clipped at the frame.
pub struct Panel<'a> {
    figure: &'a mut Figure,
    area: Rect,
    x: Axis,
    y: Axis,
    legend: Vec<(Key, String)>,
    /// Points along the curves, for placing the legend.
    seen: Vec<Point>,
    title_width: f64,
}

impl Stroke {
    /// A solid line.
    pub fn full(colour: RGBColor, width: f64) -> Stroke {
        Stroke { colour, width, dash: &[] }
    }

    /// A line with colour and dashes `index` of the palette.
    pub fn of_palette(index: usize, width: f64) -> Stroke {
        Stroke { colour: COLOURS[index % COLOURS.len()], width, dash: DASHES[index % DASHES.len()] }
    }
}

impl<'a> Panel<'a> {
    /// Draws grid, ticks, titles and labels inside `outer`.
    pub fn new(figure: &'a mut Figure, outer: Rect, title: &str, x: Axis, y: Axis) -> Panel<'a> {
        let area = outer.plot_area();
        figure.text((area.x, outer.y + 0.5 * TOP), title, TextSize::Heading, INK, Anchor::Left);
        let title_width = text_width(title, TextSize::Heading);
        let (x, y) = (x.labelled(area.width, Axis::beside), y.labelled(area.height, Axis::above));
        let mut panel = Panel { figure, area, x, y, legend: Vec::new(), seen: Vec::new(), title_width };
        panel.grid();
        panel.labels(outer);
        panel
    }

    fn grid(&mut self) {
        let Rect { x, y, width, height } = self.area;
        let inside = |share: f64| (-1e-9..=1.0 + 1e-9).contains(&share);
        let shares = |axis: &Axis| {
            let minor = axis.minor.iter().map(|&value| (axis.share(value), FAINT_GRID));
            let major = axis.ticks.iter().map(|(value, _)| (axis.share(*value), GRID));
            minor.chain(major).filter(|(share, _)| inside(*share)).collect::<Vec<_>>()
        };
        for (share, colour) in shares(&self.x) {
            let at = x + share * width;
            self.figure.line([(at, y), (at, y + height)], Stroke::full(colour, 0.8));
        }
        for (share, colour) in shares(&self.y) {
            let at = y + (1.0 - share) * height;
            self.figure.line([(x, at), (x + width, at)], Stroke::full(colour, 0.8));
        }
    }

    fn labels(&mut self, outer: Rect) {
        let Rect { x, y, width, height } = self.area;
        for (value, label) in self.x.ticks.clone() {
            // Keep a label at the end of the axis within the panel.
            let half = 0.5 * text_width(&label, TextSize::Label);
            let along = (x + self.x.share(value) * width).min(outer.x + outer.width - half - 1.0);
            let at = (along, y + height + 13.0);
            self.figure.text(at, &label, TextSize::Label, INK, Anchor::Centre);
        }
        for (value, label) in self.y.ticks.clone() {
            let at = (x - 6.0, y + (1.0 - self.y.share(value)) * height);
            self.figure.text(at, &label, TextSize::Label, INK, Anchor::Right);
        }
        let below = (x + 0.5 * width, y + height + 34.0);
        self.figure.text(below, &self.x.title.clone(), TextSize::Label, INK, Anchor::Centre);
        let beside = (outer.x + 10.0, y + 0.5 * height);
        let (text, size) = (self.y.title.clone(), TextSize::Label);
        let label =
            Shape::Text { at: beside, text, size, colour: INK, anchor: Anchor::Centre, upwards: true };
        self.figure.add(label);
    }

    /// Returns the position of a data point in the figure.
    pub fn place(&self, (x, y): Point) -> Point {
        let Rect { x: left, y: top, width, height } = self.area;
        (left + self.x.share(x) * width, top + (1.0 - self.y.share(y)) * height)
    }

    /// Returns the figure units per unit of a linear x axis.
    pub fn scale(&self) -> f64 {
        (self.x.share(1.0) - self.x.share(0.0)) * self.area.width
    }

    /// Draws a curve through data points, with a legend entry unless `label` is empty.
    pub fn line(&mut self, values: &[Point], stroke: Stroke, label: &str) {
        let points: Vec<Point> = values.iter().map(|&value| self.place(value)).collect();
        for run in clip(&points, self.area) {
            self.mark_occupied(&run);
            self.figure.line(run, stroke);
        }
        self.key(Key::Line(stroke), label);
    }

    /// Records points along a curve every few units.
    fn mark_occupied(&mut self, run: &[Point]) {
        for (a, b) in run.iter().zip(&run[1..]) {
            let pieces = ((b.0 - a.0).hypot(b.1 - a.1) / 8.0).ceil().clamp(1.0, 1000.0);
            let share = |i: usize| i as f64 / pieces;
            let points = (0..=pieces as usize).map(share);
            self.seen.extend(points.map(|s| (a.0 + s * (b.0 - a.0), a.1 + s * (b.1 - a.1))));
        }
    }

    /// Fills the area between two curves over the same x: (x, low, high).
    pub fn band(&mut self, values: &[(f64, f64, f64)], fill: RGBColor) {
        let clamped = |point: Point| {
            let (x, y) = self.place(point);
            (x, y.clamp(self.area.y, self.area.y + self.area.height))
        };
        let upper = values.iter().map(|&(x, _, high)| clamped((x, high)));
        let lower = values.iter().rev().map(|&(x, low, _)| clamped((x, low)));
        let corners: Vec<Point> = upper.chain(lower).collect();
        self.seen.extend(&corners);
        self.figure.add(Shape::Area { corners, fill });
    }

    /// Draws a disc at a data point; the radius is in figure units.
    pub fn disc(&mut self, value: Point, radius: f64, fill: RGBColor) {
        let centre = self.place(value);
        if self.area.contains(centre) {
            self.seen.push(centre);
            self.figure.add(Shape::Disc { centre, radius, fill });
        }
    }

    /// Draws a symbol at a data point.
    pub fn mark(&mut self, value: Point, key: Key) {
        let at = self.place(value);
        if self.area.contains(at) {
            self.seen.push(at);
            key.draw(self.figure, at);
        }
    }

    /// Draws a vertical line over the whole height at an x.
    pub fn upright(&mut self, x: f64, stroke: Stroke) {
        let (at, _) = self.place((x, 1.0));
        let Rect { y, height, .. } = self.area;
        if self.area.contains((at, y)) {
            self.figure.line([(at, y), (at, y + height)], stroke);
        }
    }

    /// Draws a short text at the top of the frame, next to an x.
    pub fn tag(&mut self, x: f64, text: &str) {
        let (at, _) = self.place((x, 1.0));
        let Rect { y, .. } = self.area;
        if self.area.contains((at, y)) {
            self.figure.text((at + 4.0, y + 9.0), text, TextSize::Label, INK, Anchor::Left);
        }
    }

    /// Draws a short bar on the x axis.
    pub fn bar(&mut self, x: f64, stroke: Stroke) {
        let (at, _) = self.place((x, 1.0));
        let foot = self.area.y + self.area.height;
        if self.area.contains((at, foot)) {
            self.figure.line([(at, foot - 10.0), (at, foot)], stroke);
        }
    }

    /// Draws a centred remark instead of curves.
    pub fn remark(&mut self, text: &str) {
        let Rect { x, y, width, height } = self.area;
        self.figure.text((x + 0.5 * width, y + 0.5 * height), text, TextSize::Label, INK, Anchor::Centre);
    }

    /// Adds a legend entry unless `label` is empty.
    pub fn key(&mut self, key: Key, label: &str) {
        if !label.is_empty() {
            self.legend.push((key, label.to_string()));
        }
    }

    /// Draws the frame, and the legend in the corner with the fewest curves.
    pub fn finish(mut self) {
        self.frame();
        let legend = std::mem::take(&mut self.legend);
        if legend.is_empty() {
            return;
        }
        let text = legend.iter().map(|(_, label)| text_width(label, TextSize::Label)).fold(0.0, f64::max);
        let size = (KEY_WIDTH + text + 18.0, LEGEND_LINE * legend.len() as f64 + 6.0);
        let corner = self.corner(size);
        let ground = Rect { x: corner.0, y: corner.1, width: size.0, height: size.1 };
        self.figure.rectangle(ground, WHITE);
        for (i, (key, label)) in legend.into_iter().enumerate() {
            self.entry(key, &label, (corner.0 + 8.0, corner.1 + 3.0 + LEGEND_LINE * (i as f64 + 0.5)));
        }
    }

    /// Draws the frame, and the legend in a row above it on the right, or inside if the title leaves no room.
    pub fn finish_with_row(mut self) {
        let entry = |(_, label): &(Key, String)| KEY_WIDTH + 16.0 + text_width(label, TextSize::Label);
        let row: f64 = self.legend.iter().map(entry).sum();
        if self.title_width + row > self.area.width {
            return self.finish();
        }
        self.frame();
        let mut right = self.area.x + self.area.width;
        for (key, label) in std::mem::take(&mut self.legend).into_iter().rev() {
            right -= KEY_WIDTH + 2.0 + text_width(&label, TextSize::Label);
            self.entry(key, &label, (right, self.area.y - 0.5 * TOP));
            right -= 14.0;
        }
    }

    fn frame(&mut self) {
        let Rect { x, y, width, height } = self.area;
        self.figure.line([(x, y), (x, y + height), (x + width, y + height)], Stroke::full(INK, 1.0));
    }

    /// Draws a legend entry, given its left end.
    fn entry(&mut self, key: Key, label: &str, (x, y): Point) {
        key.draw(self.figure, (x + 0.5 * KEY_WIDTH - 4.0, y));
        self.figure.text((x + KEY_WIDTH + 2.0, y), label, TextSize::Label, INK, Anchor::Left);
    }

    fn corner(&self, (width, height): Point) -> Point {
        let gap = 6.0;
        let (left, right) = (self.area.x + gap, self.area.x + self.area.width - width - gap);
        let (upper, lower) = (self.area.y + gap, self.area.y + self.area.height - height - gap);
        let corners = [(right, upper), (left, upper), (right, lower), (left, lower)];
        let covered = |&(x, y): &Point| {
            let cover = Rect { x, y, width, height };
            self.seen.iter().filter(|&&point| cover.contains(point)).count()
        };
        corners.into_iter().min_by_key(covered).unwrap_or(corners[0])
    }
}

/// Returns the pieces of a polyline inside a rectangle.
pub fn clip(points: &[Point], area: Rect) -> Vec<Vec<Point>> {
    let mut runs: Vec<Vec<Point>> = Vec::new();
    let mut open = false;
    for pair in points.windows(2) {
        let Some((a, b, whole)) = clip_piece(pair[0], pair[1], area) else {
            open = false;
            continue;
        };
        match runs.last_mut().filter(|_| open) {
            Some(run) => run.push(b),
            None => runs.push(vec![a, b]),
        }
        open = whole;
    }
    runs
}

/// Clips a line segment to a rectangle (Liang and Barsky 1984); also returns whether the result reaches the
/// segment's end.
fn clip_piece(a: Point, b: Point, area: Rect) -> Option<(Point, Point, bool)> {
    let d = (b.0 - a.0, b.1 - a.1);
    let (mut enter, mut leave) = (0.0f64, 1.0f64);
    let edges = [
        (-d.0, a.0 - area.x),
        (d.0, area.x + area.width - a.0),
        (-d.1, a.1 - area.y),
        (d.1, area.y + area.height - a.1),
    ];
    for (towards, room) in edges {
        if !(towards.is_finite() && room.is_finite()) || (towards == 0.0 && room < 0.0) {
            return None;
        }
        if towards < 0.0 {
            enter = enter.max(room / towards);
        } else if towards > 0.0 {
            leave = leave.min(room / towards);
        }
    }
    let at = |share: f64| (a.0 + share * d.0, a.1 + share * d.1);
    (enter <= leave).then(|| (at(enter), at(leave), leave >= 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_cut_at_the_frame() {
        let area = Rect { x: 0.0, y: 0.0, width: 10.0, height: 10.0 };
        let line =
            [(-5.0, 5.0), (5.0, 5.0), (5.0, 15.0), (8.0, 15.0), (8.0, 2.0), (f64::NAN, 2.0), (1.0, 1.0)];
        let runs = clip(&line, area);
        assert_eq!(runs, vec![vec![(0.0, 5.0), (5.0, 5.0), (5.0, 10.0)], vec![(8.0, 10.0), (8.0, 2.0)]]);
    }
}
