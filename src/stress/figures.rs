//! The figures of a stress test.

use figures::{
    Anchor, Axis, COLOURS, Figure, FigureError, HEAD, INK, Key, Panel, Point, RGBColor, Rect, Stroke,
    TextSize, WIDTH, duration_label, text_width,
};
use run_log::misses::Cause;

use super::measure::{Curves, DRAWN_MISSES, RunMeasurements};
use super::plan::{Combination, policy_name, wait_name};
use super::report::CombinationResult;
use crate::report::timing_figure::draw_histogram;

const HEIGHT: f64 = 640.0;
const SHORTEST_US: f64 = 0.1;
/// Maximum width of a map cell, and its height.
const CELL: (f64, f64) = (120.0, 46.0);
/// Width of a map's row names.
const NAMES: f64 = 80.0;

/// Colour of a cause, always shown with its letter (Okabe and Ito 2008).
fn colour(cause: Cause) -> RGBColor {
    match cause {
        Cause::OwnComputation => COLOURS[0],
        Cause::RunQueue => COLOURS[1],
        Cause::Stolen => COLOURS[2],
        Cause::PageFault => COLOURS[3],
        Cause::Blocked => RGBColor(230, 159, 0),
        Cause::Controllers => RGBColor(86, 180, 233),
        Cause::Throttled => RGBColor(0, 158, 115),
        Cause::Stopped => RGBColor(204, 121, 167),
        Cause::Recorder => RGBColor(0, 114, 178),
        Cause::Unknown => RGBColor(60, 60, 60),
    }
}

/// Figure of a combination: distributions, and the run with its misses.
pub fn combination(
    tested: &Combination,
    measured: &RunMeasurements,
    curves: &Curves,
) -> Result<Figure, FigureError> {
    let title = format!("{tested}: {} of {} ticks missed", measured.missed, measured.ticks);
    let mut figure = Figure::titled(HEIGHT, &title)?;
    let cells = figure.cells(3, 2, 0.0);
    let panels = [
        ("Wake-up after the deadline", "lateness", &curves.lateness),
        ("Physics step", "step time", &curves.step),
        ("State to command", "round trip", &curves.round_trip),
    ];
    for (cell, (name, quantity, distribution)) in cells.iter().zip(panels) {
        let one = [(String::new(), distribution)];
        draw_histogram(&mut figure, *cell, name, quantity, &one, "no data in the log");
    }
    let below = Rect { width: WIDTH, ..cells[3] };
    time_line(&mut figure, below, measured, curves);
    Ok(figure)
}

fn time_line(figure: &mut Figure, outer: Rect, measured: &RunMeasurements, curves: &Curves) {
    let latest = curves.latest.iter().filter_map(|(time_s, bin)| Some((time_s, bin.range()?[2])));
    let points: Vec<Point> = latest.map(|(time_s, late_us)| (time_s, late_us.max(SHORTEST_US))).collect();
    let marks = curves.misses.iter().map(|miss| miss.late_us);
    let values = points.iter().map(|point| point.1).chain(marks).chain([curves.period_us]);
    let y = Axis::logarithmic("lateness", values, duration_label);
    let x = Axis::linear("simulated time (s)", 0.0, curves.end_s, 12);
    let shown = if measured.missed as usize > DRAWN_MISSES {
        format!("Latest tick of each interval, and the {DRAWN_MISSES} worst misses by cause")
    } else {
        "Latest tick of each interval, and every miss by cause".to_owned()
    };
    let mut panel = Panel::new(figure, outer, &shown, x, y);
    if points.is_empty() {
        panel.remark("no timing in the log");
        return panel.finish();
    }
    panel.line(&points, Stroke::full(RGBColor(150, 150, 150), 1.2), "");
    let period = Stroke { colour: INK, width: 1.2, dash: &[8.0, 2.5, 2.0, 2.5] };
    panel.line(&[(0.0, curves.period_us), (curves.end_s, curves.period_us)], period, "period");
    for miss in &curves.misses {
        panel.disc((miss.time_s, miss.late_us), 3.5, colour(miss.cause));
    }
    let letters: Vec<(Point, Cause)> =
        curves.misses.iter().map(|miss| (panel.place((miss.time_s, miss.late_us)), miss.cause)).collect();
    let causes = Cause::ALL.into_iter().filter(|cause| measured.misses.by_cause.contains_key(cause.name()));
    for cause in causes {
        let count = measured.misses.by_cause.get(cause.name()).copied().unwrap_or(0);
        panel.key(Key::Disc(colour(cause)), &format!("{} {} {count}", cause.letter(), cause.name()));
    }
    panel.finish_with_row();
    for ((x, y), cause) in letters {
        figure.text(
            (x, y - 11.0),
            &cause.letter().to_string(),
            TextSize::Label,
            colour(cause),
            Anchor::Centre,
        );
    }
}

/// p99 of the lateness over cores and loads: a colour table for each policy and wait strategy.
pub fn map(all: &[CombinationResult]) -> Result<Figure, FigureError> {
    let mut groups: Vec<(String, Vec<&CombinationResult>)> = Vec::new();
    for tested in all {
        let of = &tested.combination;
        let name = format!("{}, {}", policy_name(of.policy), wait_name(of.wait));
        match groups.iter_mut().find(|(known, _)| *known == name) {
            Some((_, members)) => members.push(tested),
            None => groups.push((name, vec![tested])),
        }
    }
    let mut loads: Vec<String> = Vec::new();
    let mut cores: Vec<usize> = Vec::new();
    for tested in all {
        let load = tested.combination.load.to_string();
        if !loads.contains(&load) {
            loads.push(load);
        }
        if !cores.contains(&tested.combination.cores) {
            cores.push(tested.combination.cores);
        }
    }
    let high = 64.0 + CELL.1 * cores.len() as f64;
    let room = |columns: usize| (WIDTH / columns as f64 - NAMES - 20.0) / loads.len().max(1) as f64;
    // Two maps side by side if the load names fit.
    let load_width = loads.iter().map(|load| text_width(load, TextSize::Label) + 8.0).fold(0.0, f64::max);
    let columns = if groups.len() > 1 && room(2) >= load_width { 2 } else { 1 };
    let cell = (room(columns).min(CELL.0.max(load_width)), CELL.1);
    let height = groups.len().div_ceil(columns).max(1) as f64 * high + HEAD;
    let mut figure = Figure::titled(height, "p99 lateness of ticks, by cores and load")?;
    for (index, (name, members)) in groups.iter().enumerate() {
        let left = (index % columns) as f64 * WIDTH / columns as f64 + 10.0;
        let top = (index / columns) as f64 * high + HEAD;
        figure.text((left + 4.0, top + 12.0), name, TextSize::Heading, INK, Anchor::Left);
        for (column, load) in loads.iter().enumerate() {
            let x = left + NAMES + cell.0 * (column as f64 + 0.5);
            figure.text((x, top + 34.0), load, TextSize::Label, INK, Anchor::Centre);
        }
        for (row, count) in cores.iter().enumerate() {
            let y = top + 44.0 + cell.1 * row as f64;
            let label = if *count == 1 { "1 core".to_owned() } else { format!("{count} cores") };
            figure.text((left + 4.0, y + 0.5 * cell.1), &label, TextSize::Label, INK, Anchor::Left);
            for (column, load) in loads.iter().enumerate() {
                let found = members.iter().find(|tested| {
                    tested.combination.cores == *count && tested.combination.load.to_string() == *load
                });
                let p99_us = found.and_then(|tested| tested.measured.lateness_us).map(|q| q.p99);
                map_cell(&mut figure, (left + NAMES + cell.0 * column as f64, y), cell, p99_us);
            }
        }
    }
    Ok(figure)
}

/// Draws a cell, from white at 10 µs to dark blue at 100 ms by decades, with the number inside.
fn map_cell(figure: &mut Figure, (x, y): Point, cell: (f64, f64), p99_us: Option<f64>) {
    let shade = p99_us.map(|us| ((us.max(1.0).log10() - 1.0) / 4.0).clamp(0.0, 1.0));
    let mix = |from: f64, to: f64| shade.map_or(245, |s| (from + (to - from) * s) as u8);
    let fill = RGBColor(mix(255.0, 8.0), mix(255.0, 48.0), mix(255.0, 107.0));
    let (right, lower) = (x + cell.0 - 3.0, y + cell.1 - 3.0);
    figure.rectangle(Rect { x, y, width: cell.0 - 3.0, height: cell.1 - 3.0 }, fill);
    let outline = [(x, y), (right, y), (right, lower), (x, lower), (x, y)];
    figure.line(outline, Stroke::full(RGBColor(190, 190, 190), 0.8));
    let ink = if shade.is_some_and(|s| s > 0.5) { RGBColor(255, 255, 255) } else { INK };
    let text = p99_us.map_or("not run".to_owned(), duration_label);
    figure.text((0.5 * (x + right), 0.5 * (y + lower)), &text, TextSize::Label, ink, Anchor::Centre);
}

#[cfg(test)]
mod tests {
    use ipc_types::scene::{Policy, Wait};

    use super::*;
    use crate::stress::plan::Load;

    /// Five loads and all policies and waits: the widest case, in which two maps do not fit side by side.
    #[test]
    fn nothing_lies_over_anything_in_a_wide_map() {
        let loads = ["none", "spin:1", "memory:16", "disk:64", "fork:8"];
        let mut all = Vec::new();
        for policy in [Policy::Other, Policy::Fifo] {
            for load in loads {
                for cores in [1, 2] {
                    let load = Load::try_from(load.to_owned()).unwrap();
                    let combination = Combination { cores, load, policy, wait: Wait::Hybrid };
                    all.push(CombinationResult {
                        combination,
                        measured: RunMeasurements::default(),
                        busy_percent: 0.0,
                        stolen_percent: 0.0,
                        failure: None,
                        not_permitted: Vec::new(),
                        figure: String::new(),
                    });
                }
            }
        }
        assert_eq!(map(&all).unwrap().collisions(), []);
        assert_eq!(map(&all[..4]).unwrap().collisions(), []);
    }
}
