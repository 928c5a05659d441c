//! The calibration figure: bend and tip position over the tendon's tension or displacement.

use controllers::{Calibration, CalibrationRow};
use figures::{Axis, Figure, FigureError, Panel, Point, Stroke};

const HEIGHT: f64 = 400.0;

/// Draws bend over tension, bend over displacement, and the tip's path in the bending plane.
pub fn draw(title: &str, calibration: &Calibration) -> Result<Figure, FigureError> {
    let mut figure = Figure::titled(HEIGHT, title)?;
    let cells = figure.cells(3, 1, 0.0);
    type Pick = fn(&CalibrationRow) -> Point;
    let panels: [(&str, &str, &str, Pick); 3] = [
        ("Bend over tension", "tension (N)", "bend (deg)", |row| (row.tension_n, row.bend_deg)),
        ("Bend over displacement", "displacement (mm)", "bend (deg)", |row| {
            (row.displacement_mm, row.bend_deg)
        }),
        ("Tip from the tool's base", "bend direction (mm)", "insertion (mm)", |row| {
            (row.tip_mm[0], row.tip_mm[2])
        }),
    ];
    for (cell, (title, x, y, pick)) in cells.into_iter().zip(panels) {
        let points: Vec<Point> = calibration.rows.iter().map(pick).collect();
        let x = Axis::over(x, points.iter().map(|p| p.0), 0.06, 5);
        let y = Axis::over(y, points.iter().map(|p| p.1), 0.06, 5);
        let mut panel = Panel::new(&mut figure, cell, title, x, y);
        for (index, (rising, label)) in [(true, "loading"), (false, "unloading")].into_iter().enumerate() {
            let rows = calibration.rows.iter().filter(|row| row.rising == rising);
            panel.line(&rows.map(pick).collect::<Vec<_>>(), Stroke::of_palette(index, 1.8), label);
        }
        panel.finish();
    }
    Ok(figure)
}
