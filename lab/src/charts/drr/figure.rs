//! `drr.svg` and `drr.png`: error against milliseconds, both logarithmic.

use super::Point;
use figures::{
    Anchor, Axis, COLOURS, Figure, FigureError, HEAD, INK, Key, Panel, RGBColor, Rect, Stroke, TextSize,
    WIDTH, duration_label,
};

/// Height of the plot with its axes, and of a legend line below it.
const PLOT: f64 = 480.0;
const LINE: f64 = 21.0;
/// Methods in a line of the legend.
const COLUMNS: usize = 3;
const SKY: RGBColor = RGBColor(86, 180, 233);
const GREY: RGBColor = RGBColor(130, 130, 130);

/// Returns the mark of a method: ours are discs and rings; peers are crosses, distinguished by colour.
fn mark(method: &str, peers: &[&str]) -> Key {
    let [blue, vermilion, green, purple] = COLOURS;
    match method {
        "siddon" => Key::Disc(INK),
        "joseph" => Key::Ring(INK),
        "slice_ordered 1" => Key::Disc(blue),
        "slice_ordered 1, unsharpened" => Key::Ring(blue),
        "slice_ordered 0.9" => Key::Disc(SKY),
        "slice_ordered 0.8" => Key::Ring(SKY),
        "slice_ordered 1.5" => Key::Disc(green),
        "slice_ordered 2" => Key::Ring(green),
        "preview 2" => Key::Disc(purple),
        "preview 4" => Key::Ring(purple),
        peer => {
            let place = peers.iter().position(|own| *own == peer).unwrap_or(0);
            Key::Cross(Stroke::full([vermilion, INK, green, purple, GREY, SKY][place % 6], 2.0))
        }
    }
}

/// Draws the points of two threads; the upright line is the time to read the finest volume once.
pub fn draw(points: &[Point], stream_ms: f64) -> Result<Figure, FigureError> {
    let shown: Vec<&Point> = points.iter().filter(|p| p.threads == 2).collect();
    let mut methods: Vec<&str> = Vec::new();
    for point in &shown {
        if !methods.contains(&point.method.as_str()) {
            methods.push(&point.method);
        }
    }
    let peers: Vec<&str> = methods.iter().copied().filter(|method| method.starts_with("peer:")).collect();
    let lines = methods.len().div_ceil(COLUMNS) + 1;
    let title = "X-ray: error against the time of a frame on 2 threads (lower left is better)";
    let mut figure = Figure::titled(HEAD + PLOT + LINE * (lines as f64 + 0.5), title)?;
    let place = |point: &Point| (1e3 * point.least_and_median_ms().0, point.exact.rms);
    let times = shown.iter().map(|point| place(point).0).chain([1e3 * stream_ms]);
    let x = Axis::logarithmic("least time of a frame", times, duration_label);
    let error = "r.m.s. error against the closed integrals, relative";
    let y =
        Axis::logarithmic(error, shown.iter().map(|point| place(point).1), |value| format!("{value:.0e}"));
    let outer = Rect { x: 0.0, y: HEAD, width: WIDTH, height: PLOT };
    let mut panel = Panel::new(&mut figure, outer, "Voxels of 0.5, 1 and 2 mm, three poses", x, y);
    panel.upright(1e3 * stream_ms, Stroke::full(GREY, 1.4));
    panel.tag(1e3 * stream_ms, "reading the volume once");
    for point in &shown {
        panel.mark(place(point), mark(&point.method, &peers));
    }
    panel.finish();
    for (index, method) in methods.iter().enumerate() {
        let (column, line) = (index % COLUMNS, index / COLUMNS);
        let at = (
            40.0 + column as f64 * (WIDTH - 40.0) / COLUMNS as f64,
            HEAD + PLOT + LINE * (line as f64 + 0.6),
        );
        mark(method, &peers).draw(&mut figure, at);
        let name = method.strip_prefix("peer:").unwrap_or(method);
        figure.text((at.0 + 14.0, at.1), name, TextSize::Label, INK, Anchor::Left);
    }
    let foot = HEAD + PLOT + LINE * (lines as f64 - 0.4);
    figure.text((27.0, foot), "Crosses: other programs.", TextSize::Label, INK, Anchor::Left);
    Ok(figure)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::charts::drr::Errors;

    #[test]
    fn nothing_lies_over_anything_in_a_figure_of_every_method() {
        let peers =
            ["peer:itk_raycast", "peer:itk_siddon_jacobs", "peer:plastimatch_exact", "peer:rtk_joseph"];
        let methods = super::super::projectors().into_iter().map(|(name, _)| name).chain(peers);
        let points: Vec<Point> = methods
            .enumerate()
            .map(|(index, method)| Point {
                method: method.to_owned(),
                coarseness: 1,
                pose: "frontal",
                threads: 2,
                times_ms: vec![1.5 * 1.8_f64.powi(index as i32)],
                exact: Errors { rms: 2e-3 * 1.1_f64.powi(index as i32), max: 0.1 },
                siddon: Errors { rms: 0.0, max: 0.0 },
            })
            .collect();
        let marks: Vec<Key> = points.iter().map(|point| mark(&point.method, &peers)).collect();
        for (index, own) in marks.iter().enumerate() {
            assert!(!marks[..index].contains(own), "two methods share the mark {own:?}");
        }
        let figure = draw(&points, 8.8).unwrap();
        assert_eq!(figure.collisions(), []);
    }
}
