//! A figure as a list of shapes, rendered to PNG and SVG.

use std::path::{Path, PathBuf};

use plotters::backend::{BitMapBackend, SVGBackend};
use plotters::coord::Shift;
use plotters::drawing::{DrawingArea, IntoDrawingArea};
use plotters::element::{BitMapElement, Circle, PathElement, Polygon};
use plotters::prelude::DrawingBackend;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use plotters::style::{
    Color, FontStyle, FontTransform, IntoFont, RGBColor, ShapeStyle, TextStyle, WHITE, register_font,
};

use super::FigureError;
use super::panel::{INK, Rect};
use super::picture::encode;

/// Width of every figure. Shown at page width, about 830 pixels, the smallest text is 13 pixels high.
pub const WIDTH: f64 = 880.0;

const FONT: &str = "sans-serif";
/// Pixels per figure unit while drawing; plotters snaps shapes to whole pixels.
const SCALE: usize = 4;
/// Side of the pixel squares averaged into one pixel of the PNG file, because plotters does not antialias
/// wide lines.
const SHRINK: usize = 2;

/// Height of a figure's title.
pub const HEAD: f64 = 40.0;

/// A point of the figure: right and down from the top left corner, in units of half a pixel of the PNG file.
pub type Point = (f64, f64);

/// Font size of a text. Anything smaller than a label would be unreadable at page width.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TextSize {
    /// Title of a figure.
    Title,
    /// Title of a panel.
    Heading,
    /// Ticks, axes, legends.
    Label,
}

impl TextSize {
    /// Returns the size in figure units.
    pub fn units(self) -> f64 {
        match self {
            TextSize::Title => 18.0,
            TextSize::Heading => 15.5,
            TextSize::Label => 14.0,
        }
    }
}

/// How a line is drawn.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stroke {
    /// Colour.
    pub colour: RGBColor,
    /// Width in figure units.
    pub width: f64,
    /// Alternating lengths of dash and gap, in figure units; empty for a solid line.
    pub dash: &'static [f64],
}

/// Anchor point of a text.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Anchor {
    /// Left end, half height.
    Left,
    /// Centre.
    Centre,
    /// Right end, half height.
    Right,
}

/// A drawing primitive.
#[derive(Debug, Clone)]
pub enum Shape {
    /// A line through points.
    Line {
        /// The points.
        points: Vec<Point>,
        /// How it is drawn.
        stroke: Stroke,
    },
    /// A filled area without outline.
    Area {
        /// Its corners.
        corners: Vec<Point>,
        /// Its colour.
        fill: RGBColor,
    },
    /// A filled circle.
    Disc {
        /// Its centre.
        centre: Point,
        /// Its radius in figure units.
        radius: f64,
        /// Its colour.
        fill: RGBColor,
    },
    /// A bitmap, each pixel drawn as a rectangle of one colour.
    Picture {
        /// Its upper left corner.
        corner: Point,
        /// Its width in figure units.
        width: f64,
        /// Its height in figure units.
        height: f64,
        /// Pixel columns.
        columns: usize,
        /// Pixel rows.
        rows: usize,
        /// `columns` x `rows` RGB pixels, row by row from the top left.
        rgb: Vec<u8>,
    },
    /// One line of text.
    Text {
        /// Position of its anchor.
        at: Point,
        /// Content.
        text: String,
        /// Height of its font.
        size: TextSize,
        /// Its colour.
        colour: RGBColor,
        /// Which point of the text is at `at`.
        anchor: Anchor,
        /// True if the text runs upwards.
        upwards: bool,
    },
}

/// A figure of [`WIDTH`] on a white background.
#[derive(Debug, Clone)]
pub struct Figure {
    height: f64,
    shapes: Vec<Shape>,
}

/// Registers the figures' font, Ubuntu Light, from memory, so that no font needs to be installed.
fn register() -> Result<(), FigureError> {
    register_font(FONT, FontStyle::Normal, epaint_default_fonts::UBUNTU_LIGHT).map_err(|_| FigureError::Font)
}

/// Returns the approximate width of a text in figure units.
pub fn text_width(text: &str, size: TextSize) -> f64 {
    let size = size.units();
    let drawn = (FONT, size * SCALE as f64).into_font().box_size(text);
    // A letter is usually about half as wide as the font is high.
    drawn.map_or(0.5 * size * text.chars().count() as f64, |(width, _)| f64::from(width) / SCALE as f64)
}

impl Figure {
    /// Creates an empty figure of this height in figure units.
    pub fn new(height: f64) -> Result<Figure, FigureError> {
        register()?;
        Ok(Figure { height: height.ceil(), shapes: Vec::new() })
    }

    /// Creates a figure with a title at the top.
    pub fn titled(height: f64, title: &str) -> Result<Figure, FigureError> {
        let mut figure = Figure::new(height)?;
        figure.text((14.0, 0.5 * HEAD), title, TextSize::Title, INK, Anchor::Left);
        Ok(figure)
    }

    /// Divides the figure between [`HEAD`] and `foot` evenly into rectangles, row by row.
    pub fn cells(&self, columns: usize, rows: usize, foot: f64) -> Vec<Rect> {
        let (width, height) = (WIDTH / columns as f64, (self.height - HEAD - foot) / rows as f64);
        let cell = |index: usize| Rect {
            x: (index % columns) as f64 * width,
            y: HEAD + (index / columns) as f64 * height,
            width,
            height,
        };
        (0..columns * rows).map(cell).collect()
    }

    /// Returns its shapes in drawing order.
    pub fn shapes(&self) -> &[Shape] {
        &self.shapes
    }

    /// Returns its height in figure units.
    pub fn height(&self) -> f64 {
        self.height
    }

    /// Adds a shape over existing ones. Shapes with a non-finite coordinate are skipped.
    pub fn add(&mut self, shape: Shape) {
        let finite = |points: &[Point]| points.iter().all(|(x, y)| x.is_finite() && y.is_finite());
        let sound = match &shape {
            Shape::Line { points, .. } => points.len() > 1 && finite(points),
            Shape::Area { corners, .. } => corners.len() > 2 && finite(corners),
            Shape::Disc { centre, radius, .. } => finite(&[*centre]) && radius.is_finite(),
            Shape::Text { at, .. } => finite(&[*at]),
            Shape::Picture { corner, width, height, columns, rows, rgb } => {
                let is_whole = rgb.len() == columns * rows * 3 && !rgb.is_empty();
                finite(&[*corner, (*width, *height)]) && is_whole
            }
        };
        if sound {
            self.shapes.push(shape);
        }
    }

    /// Adds a line through points.
    pub fn line(&mut self, points: impl Into<Vec<Point>>, stroke: Stroke) {
        self.add(Shape::Line { points: points.into(), stroke });
    }

    /// Adds a filled rectangle.
    pub fn rectangle(&mut self, Rect { x, y, width, height }: Rect, fill: RGBColor) {
        let corners = vec![(x, y), (x + width, y), (x + width, y + height), (x, y + height)];
        self.add(Shape::Area { corners, fill });
    }

    /// Adds a text.
    pub fn text(&mut self, at: Point, text: &str, size: TextSize, colour: RGBColor, anchor: Anchor) {
        self.add(Shape::Text { at, text: text.to_string(), size, colour, anchor, upwards: false });
    }

    /// Writes only a PNG file, because SVG would store a [`Shape::Picture`] as one rectangle per pixel.
    pub fn write_png(&self, file: &Path) -> Result<(), FigureError> {
        Ok(output_file::write(file, self.png(file)?)?)
    }

    /// Writes `<stem>.png` and `<stem>.svg`.
    pub fn write(&self, folder: &Path, stem: &str) -> Result<(), FigureError> {
        Ok(output_file::write_all(&self.files(folder, stem)?)?)
    }

    /// Returns `<stem>.png` and `<stem>.svg` with their contents.
    pub fn files(&self, folder: &Path, stem: &str) -> Result<[(PathBuf, Vec<u8>); 2], FigureError> {
        let [png, svg] = ["png", "svg"].map(|ending| folder.join(format!("{stem}.{ending}")));
        let bytes = (self.png(&png)?, self.svg(&svg)?.into_bytes());
        Ok([(png, bytes.0), (svg, bytes.1)])
    }

    /// Renders the figure as PNG; errors name this file.
    pub fn png(&self, path: &Path) -> Result<Vec<u8>, FigureError> {
        let size = (WIDTH as u32 * SCALE as u32, self.height as u32 * SCALE as u32);
        let mut pixels = vec![0u8; size.0 as usize * size.1 as usize * 3];
        {
            let backend = BitMapBackend::with_buffer(&mut pixels, size);
            self.draw(backend, Medium::Bitmap).map_err(FigureError::content(path, "drawn"))?;
        }
        let (columns, rows) = (size.0 as usize / SHRINK, size.1 as usize / SHRINK);
        let shrunk = shrink(&pixels, columns, rows);
        let kind = (png::ColorType::Rgb, png::BitDepth::Eight);
        encode([columns as u32, rows as u32], kind, png::Compression::Fast, &shrunk)
            .map_err(FigureError::content(path, "written as PNG"))
    }

    /// Renders the figure as SVG; errors name this file.
    pub fn svg(&self, path: &Path) -> Result<String, FigureError> {
        let size = (WIDTH as u32 * SCALE as u32, self.height as u32 * SCALE as u32);
        let mut text = String::new();
        self.draw(SVGBackend::with_string(&mut text, size), Medium::Vector)
            .map_err(FigureError::content(path, "drawn"))?;
        // Drawn on a fine grid, shown at its nominal size.
        let drawn = format!("width=\"{}\" height=\"{}\"", size.0, size.1);
        let shown = format!("width=\"{WIDTH}\" height=\"{}\"", self.height);
        Ok(text.replacen(&drawn, &shown, 1))
    }

    fn draw<DB: DrawingBackend>(&self, backend: DB, medium: Medium) -> Result<(), Box<dyn std::error::Error>>
    where
        DB::ErrorType: 'static,
    {
        let area = backend.into_drawing_area();
        area.fill(&WHITE)?;
        for shape in &self.shapes {
            draw_shape(&area, shape, medium)?;
        }
        area.present()?;
        Ok(())
    }
}

/// Output format of a figure.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Medium {
    Bitmap,
    Vector,
}

/// Averages squares of `SHRINK` × `SHRINK` RGB pixels.
fn shrink(pixels: &[u8], columns: usize, rows: usize) -> Vec<u8> {
    let wide = columns * SHRINK;
    let mut shrunk = Vec::with_capacity(columns * rows * 3);
    for row in 0..rows {
        for column in 0..columns {
            for channel in 0..3 {
                let mut sum = 0u32;
                for y in row * SHRINK..(row + 1) * SHRINK {
                    for x in column * SHRINK..(column + 1) * SHRINK {
                        sum += u32::from(pixels[(y * wide + x) * 3 + channel]);
                    }
                }
                let count = (SHRINK * SHRINK) as u32;
                shrunk.push(((sum + count / 2) / count) as u8);
            }
        }
    }
    shrunk
}

type DrawResult<DB> = Result<(), plotters::drawing::DrawingAreaErrorKind<<DB as DrawingBackend>::ErrorType>>;

fn pixel((x, y): Point) -> (i32, i32) {
    let round = |v: f64| (v * SCALE as f64).round() as i32;
    (round(x), round(y))
}

fn draw_shape<DB: DrawingBackend>(
    area: &DrawingArea<DB, Shift>,
    shape: &Shape,
    medium: Medium,
) -> DrawResult<DB> {
    match shape {
        Shape::Line { points, stroke } => draw_line(area, points, stroke, medium),
        Shape::Area { corners, fill } => {
            let corners: Vec<_> = corners.iter().map(|&corner| pixel(corner)).collect();
            area.draw(&Polygon::new(corners, fill.filled()))
        }
        Shape::Disc { centre, radius, fill } => {
            let radius = (radius * SCALE as f64).round().max(1.0) as i32;
            area.draw(&Circle::new(pixel(*centre), radius, fill.filled()))
        }
        Shape::Picture { corner, width, height, columns, rows, rgb } => {
            let (left, top) = pixel(*corner);
            let (right, foot) = pixel((corner.0 + width, corner.1 + height));
            let (wide, tall) = ((right - left).max(1) as usize, (foot - top).max(1) as usize);
            let drawn = stretched(rgb, [*columns, *rows], [wide, tall]);
            let size = (wide as u32, tall as u32);
            match BitMapElement::with_owned_buffer((left, top), size, drawn) {
                Some(element) => area.draw(&element),
                None => Ok(()),
            }
        }
        Shape::Text { at, text, size, colour, anchor, upwards } => {
            let horizontal = match anchor {
                Anchor::Left => HPos::Left,
                Anchor::Centre => HPos::Center,
                Anchor::Right => HPos::Right,
            };
            let size = size.units();
            let mut font = (FONT, size * SCALE as f64).into_font();
            if *upwards {
                font = font.transform(FontTransform::Rotate270);
            }
            let style = TextStyle::from(font).color(colour).pos(Pos::new(horizontal, VPos::Center));
            // In a bitmap, plotters centres text too high by about an eighth of its height.
            let lower = if medium == Medium::Bitmap { 0.12 * size } else { 0.0 };
            let at = if *upwards { (at.0 + lower, at.1) } else { (at.0, at.1 + lower) };
            area.draw_text(text, &style, pixel(at))
        }
    }
}

/// Resizes RGB pixels by nearest neighbour.
fn stretched(rgb: &[u8], [columns, rows]: [usize; 2], [wide, tall]: [usize; 2]) -> Vec<u8> {
    let mut out = Vec::with_capacity(wide * tall * 3);
    for y in 0..tall {
        let row = y * rows / tall;
        for x in 0..wide {
            let at = (row * columns + x * columns / wide) * 3;
            out.extend_from_slice(&rgb[at..at + 3]);
        }
    }
    out
}

/// Draws dashes one by one. In a bitmap, draws each segment separately with round joints, because plotters'
/// outline of a dense polyline has spikes.
fn draw_line<DB: DrawingBackend>(
    area: &DrawingArea<DB, Shift>,
    points: &[Point],
    stroke: &Stroke,
    medium: Medium,
) -> DrawResult<DB> {
    let width = (stroke.width * SCALE as f64).round().max(1.0) as u32;
    let style = ShapeStyle { color: stroke.colour.to_rgba(), filled: true, stroke_width: width };
    for dash in dashes(points, stroke.dash) {
        let mut corners: Vec<_> = dash.iter().map(|&point| pixel(point)).collect();
        corners.dedup();
        if medium == Medium::Vector {
            area.draw(&PathElement::new(corners, style))?;
            continue;
        }
        for piece in corners.windows(2) {
            area.draw(&PathElement::new(piece.to_vec(), style))?;
        }
        let inner = corners.len().saturating_sub(1).max(1);
        for &joint in corners[..inner].iter().skip(1).filter(|_| width > 3) {
            area.draw(&Circle::new(joint, width as i32 / 2, style))?;
        }
    }
    Ok(())
}

/// Cuts a polyline into dashes. An empty pattern leaves it whole.
fn dashes(points: &[Point], pattern: &[f64]) -> Vec<Vec<Point>> {
    if pattern.is_empty() || pattern.iter().any(|&length| length.is_nan() || length <= 0.0) {
        return vec![points.to_vec()];
    }
    let mut all = Vec::new();
    let mut current: Vec<Point> = points.first().copied().into_iter().collect();
    let (mut index, mut left) = (0, pattern[0]);
    for pair in points.windows(2) {
        let (a, b) = (pair[0], pair[1]);
        let length = (b.0 - a.0).hypot(b.1 - a.1);
        let mut done = 0.0;
        while length - done > left {
            done += left;
            let share = done / length;
            let cut = (a.0 + share * (b.0 - a.0), a.1 + share * (b.1 - a.1));
            if index % 2 == 0 {
                current.push(cut);
                all.push(std::mem::take(&mut current));
            } else {
                current = vec![cut];
            }
            index += 1;
            left = pattern[index % pattern.len()];
        }
        left -= length - done;
        if index % 2 == 0 {
            current.push(b);
        }
    }
    if index % 2 == 0 && current.len() > 1 {
        all.push(current);
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    fn length(line: &[Point]) -> f64 {
        line.windows(2).map(|p| (p[1].0 - p[0].0).hypot(p[1].1 - p[0].1)).sum()
    }

    #[test]
    fn dashes_keep_the_shares_of_the_pattern() {
        // A corner inside a dash: 7 right, 5 down; total 12 with pattern 2 on, 1 off: 8 of 12 drawn in 4
        // dashes.
        let line = [(0.0, 0.0), (7.0, 0.0), (7.0, 5.0)];
        let cut = dashes(&line, &[2.0, 1.0]);
        assert_eq!(cut.len(), 4);
        assert!((cut.iter().map(|dash| length(dash)).sum::<f64>() - 8.0).abs() < 1e-12);
        assert_eq!(dashes(&line, &[]), vec![line.to_vec()]);
        assert_eq!(cut[2], vec![(6.0, 0.0), (7.0, 0.0), (7.0, 1.0)], "a dash goes round the corner");
    }

    #[test]
    fn stretching_repeats_pixels() {
        let (red, blue) = ([255, 0, 0], [0, 0, 255]);
        assert_eq!(
            stretched(&[red, blue].concat(), [2, 1], [4, 2]),
            [red, red, blue, blue].concat().repeat(2)
        );
    }

    #[test]
    fn shrinking_takes_means() {
        let pixels: Vec<u8> = [[0u8; 3], [255; 3], [255; 3], [0; 3]].concat();
        assert_eq!(shrink(&pixels, 1, 1), vec![128; 3]);
    }
}
