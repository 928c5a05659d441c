//! Figures of an identification.

use figures::{
    Axis, COLOURS, Figure, FigureError, HEAD, INK, Key, Panel, Point, RGBColor, Stroke, bounds,
};
use sim::identification::{FitReport, Series};

const ROW: f64 = 230.0;
/// Points of a curve; more cannot be told apart at page width.
const MOST_POINTS: usize = 400;
const BAND: RGBColor = RGBColor(200, 222, 238);
/// 97.5 % quantile of the standard normal distribution.
const QUANTILE: f64 = 1.96;

/// Returns every n-th index, so that at most [`MOST_POINTS`] remain.
fn thinned(count: usize) -> impl Iterator<Item = usize> + Clone {
    (0..count).step_by(count.div_ceil(MOST_POINTS).max(1))
}

/// Draws an experiment: for each column, measured and simulated values with their band, and the residuals.
pub(super) fn experiment(name: &str, series: &[&Series]) -> Result<Figure, FigureError> {
    let rows = series.len().max(1);
    let mut figure = Figure::titled(HEAD + ROW * rows as f64, name)?;
    for (index, cell) in figure.cells(2, rows, 0.0).into_iter().enumerate() {
        let Some(of) = series.get(index / 2) else { continue };
        match index % 2 {
            0 => draw_values(&mut figure, cell, of),
            _ => draw_residuals(&mut figure, cell, of),
        }
    }
    Ok(figure)
}

fn draw_values(figure: &mut Figure, cell: figures::Rect, of: &Series) {
    let at = thinned(of.times_s.len());
    let band = |i: usize| QUANTILE * of.sd[i];
    let low = at.clone().map(|i| of.simulated[i] - band(i));
    let high = at.clone().map(|i| of.simulated[i] + band(i));
    let measured = at.clone().filter_map(|i| of.measured.get(i).copied());
    let y = Axis::over(&format!("{} ({})", of.column, of.unit), low.chain(high).chain(measured), 0.08, 5);
    let x = Axis::over("time (s)", at.clone().map(|i| of.times_s[i]), 0.02, 5);
    let mut panel = Panel::new(figure, cell, &of.sensor, x, y);
    let edges: Vec<(f64, f64, f64)> = at
        .clone()
        .map(|i| (of.times_s[i], of.simulated[i] - band(i), of.simulated[i] + band(i)))
        .collect();
    panel.band(&edges, BAND);
    for i in at.clone().filter(|i| *i < of.measured.len()) {
        panel.disc((of.times_s[i], of.measured[i]), 1.6, COLOURS[1]);
    }
    let line: Vec<Point> = at.map(|i| (of.times_s[i], of.simulated[i])).collect();
    panel.line(&line, Stroke::full(COLOURS[0], 1.6), "simulated");
    if !of.measured.is_empty() {
        panel.key(Key::Disc(COLOURS[1]), "measured");
    }
    panel.finish_with_row();
}

fn draw_residuals(figure: &mut Figure, cell: figures::Rect, of: &Series) {
    let at = thinned(of.measured.len());
    let residual = |i: usize| of.simulated[i] - of.measured[i];
    let x = Axis::over("time (s)", of.times_s.iter().copied(), 0.02, 5);
    let limit = QUANTILE * of.noise;
    let ends = bounds(at.clone().map(residual)).map_or([-limit, limit], |(low, high)| [low, high]);
    let y = Axis::over(&format!("simulated - measured ({})", of.unit), ends.into_iter().chain([-limit, limit]), 0.08, 5);
    let mut panel = Panel::new(figure, cell, "Residuals", x, y);
    if of.measured.is_empty() {
        panel.remark("not measured");
        return panel.finish();
    }
    let ends = bounds(of.times_s.iter().copied()).unwrap_or((0.0, 1.0));
    for side in [-limit, limit] {
        panel.line(&[(ends.0, side), (ends.1, side)], Stroke { colour: INK, width: 0.8, dash: &[4.0, 3.0] }, "");
    }
    at.for_each(|i| panel.disc((of.times_s[i], residual(i)), 1.6, COLOURS[0]));
    panel.finish();
}

/// Draws estimates and intervals, each as a share of its range.
pub(super) fn intervals(report: &FitReport) -> Result<Figure, FigureError> {
    let count = report.parameters.len();
    let mut figure = Figure::titled(HEAD + 90.0 + 26.0 * count as f64, "Estimates and 95 % intervals")?;
    let cell = figure.cells(1, 1, 0.0)[0];
    let mut y = Axis::linear("parameter", 0.5, count as f64 + 0.5, 1);
    y.ticks = (1..=count).map(|i| (i as f64, format!("{}", count + 1 - i))).collect();
    let x = Axis::linear("share of the range, min to max", 0.0, 1.0, 5);
    let mut panel = Panel::new(&mut figure, cell, "", x, y);
    for (index, it) in report.parameters.iter().enumerate() {
        let share = |value: f64| (value - it.range[0]) / (it.range[1] - it.range[0]);
        let height = (count - index) as f64;
        let ends = it.interval.map(|end| (share(end), height));
        let colour = if it.is_determined { COLOURS[0] } else { COLOURS[1] };
        panel.line(&ends, Stroke::full(colour, 3.0), "");
        panel.disc((share(it.value), height), 4.0, colour);
    }
    panel.finish();
    Ok(figure)
}
