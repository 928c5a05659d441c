//! The picture of a search: clearance against bone removed, with the plans numbered.

use figures::{
    Anchor, Axis, COLOURS, Figure, FigureError, HEAD, INK, Key, Panel, Point, Rect, Stroke, TextSize, WIDTH,
};

use super::Candidate;

const HEIGHT: f64 = 420.0;
/// Distance of a number from its disc.
const BESIDE: (f64, f64) = (9.0, -9.0);

/// Draws all candidates that ended, and the plans among them in their order.
///
/// # Errors
/// [`FigureError`].
pub fn draw(name: &str, candidates: &[Candidate], plans: &[usize]) -> Result<Figure, FigureError> {
    let place = |candidate: &Candidate| -> Option<Point> {
        Some((candidate.outcome.bone_removed_mm3, candidate.outcome.clearance_mm?))
    };
    let places: Vec<Option<Point>> = candidates.iter().map(place).collect();
    let shown = || places.iter().flatten();
    let mut figure = Figure::titled(HEAD + HEIGHT, &format!("{name}: planned paths"))?;
    let area = Rect { x: 0.0, y: HEAD, width: WIDTH, height: HEIGHT };
    let x = Axis::over("healthy bone removed (mm³)", shown().map(|point| point.0), 0.08, 6);
    let y = Axis::over("least clearance (mm)", shown().map(|point| point.1), 0.08, 6);
    let mut panel = Panel::new(&mut figure, area, "", x, y);
    let front: Vec<Point> = plans.iter().filter_map(|index| places[*index]).collect();
    panel.line(&front, Stroke::full(COLOURS[0], 1.2), "");
    let cross = Key::Cross(Stroke::full(COLOURS[1], 1.4));
    let (ring, disc) = (Key::Ring(COLOURS[2]), Key::Disc(COLOURS[0]));
    for (index, (candidate, at)) in candidates.iter().zip(&places).enumerate() {
        let Some(at) = *at else { continue };
        let key = match candidate.outcome.fault {
            _ if plans.contains(&index) => disc,
            Some(_) => cross,
            None => ring,
        };
        panel.mark(at, key);
    }
    panel.key(disc, "plan");
    panel.key(ring, "reaches the target");
    panel.key(cross, "does not, breaches or stops");
    let numbers: Vec<Point> = front.iter().map(|point| panel.place(*point)).collect();
    panel.finish();
    for (index, (x, y)) in numbers.into_iter().enumerate() {
        let at = (x + BESIDE.0, y + BESIDE.1);
        figure.text(at, &(index + 1).to_string(), TextSize::Label, INK, Anchor::Left);
    }
    Ok(figure)
}
