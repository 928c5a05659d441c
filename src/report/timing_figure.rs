//! The timing figure of a run.

use figures::{
    Axis, COLOURS, Figure, FigureError, HEAD, INK, Key, Panel, Point, RGBColor, Rect, Stroke, WIDTH,
    count_label, duration_label,
};
use run_log::RunMode;

use super::distribution::{Distribution, Quantiles};
use super::timing_lane::TimingLane;
use super::tip_figure::lighter;

const HEIGHT: f64 = 700.0;
const TOP_ROW: f64 = 330.0;
/// Histogram bars per decade.
const BARS_PER_DECADE: f64 = 20.0;
/// Shorter durations are shown as this, because they are below the clock's resolution.
const SHORTEST_US: f64 = 0.1;
const P50_DASH: &[f64] = &[6.0, 2.5];
const P99_DASH: &[f64] = &[1.5, 2.5];
const EMPTY: &str = "no data in the log";
const GREY: RGBColor = RGBColor(110, 110, 110);

/// Draws the figure; a panel without data says so. `end_ns` is the simulated length of the run.
pub fn draw(timing: &TimingLane, end_ns: u64) -> Result<Figure, FigureError> {
    let header = timing.header.as_ref();
    let (scene, mode) = header.map_or(("run", ""), |h| (h.scene_name.as_str(), h.mode.name()));
    let mode = if mode.is_empty() { String::new() } else { format!(", {mode}") };
    let title = format!("{scene}{mode}: timing of {} ticks", timing.step.count());
    let mut figure = Figure::titled(HEIGHT, &title)?;
    let end_s = end_ns.max(timing.end_ns) as f64 * 1e-9;
    draw_over_time(&mut figure, Rect { x: 0.0, y: HEAD, width: WIDTH, height: TOP_ROW }, timing, end_s);
    let y = HEAD + TOP_ROW;
    let column = WIDTH / 3.0;
    let cell = |i: f64| Rect { x: i * column, y, width: column, height: HEIGHT - y };
    let name = String::new;
    draw_histogram(&mut figure, cell(0.0), "Physics step", "step time", &[(name(), &timing.step)], EMPTY);
    let lateness = [(name(), &timing.lateness)];
    let (lateness, without): (&[_], _) =
        if is_realtime(timing) { (&lateness, EMPTY) } else { (&[], "no deadlines in lockstep") };
    draw_histogram(&mut figure, cell(1.0), "Wake-up after the deadline", "lateness", lateness, without);
    let controllers = header.map(|h| h.controllers.as_slice()).unwrap_or_default();
    let trips: Vec<_> = controllers.iter().cloned().zip(&timing.round_trips).collect();
    draw_histogram(&mut figure, cell(2.0), "State to command", "round trip", &trips, EMPTY);
    Ok(figure)
}

fn is_realtime(timing: &TimingLane) -> bool {
    timing.header.as_ref().is_some_and(|header| header.mode == RunMode::RealTime)
}

/// Returns the middle (s) and quantiles (µs) of each interval. A last interval less than half full is merged
/// into the previous one.
fn step_bins(timing: &TimingLane, end_s: f64) -> Vec<(f64, Quantiles)> {
    let bins = timing.step_over_time.iter();
    let mut bins: Vec<(f64, Quantiles)> =
        bins.filter_map(|(t, bin)| Some((t.min(end_s), bin.quantiles(1e3)?))).collect();
    if let [.., (_, before), (_, last)] = bins.as_mut_slice()
        && 2 * last.count < before.count
    {
        before.max = before.max.max(last.max);
        bins.pop();
    }
    bins
}

fn draw_over_time(figure: &mut Figure, outer: Rect, timing: &TimingLane, end_s: f64) {
    let bins = step_bins(timing, end_s);
    let period_us = timing.header.as_ref().map_or(0.0, |header| header.dt_ns as f64 * 1e-3);
    let values = bins.iter().flat_map(|(_, q)| [q.p50, q.max]).map(|value| value.max(SHORTEST_US));
    let y = Axis::logarithmic("step time", values.chain([period_us]), duration_label);
    let x = Axis::linear("simulated time (s)", 0.0, end_s, 12);
    let mut panel = Panel::new(figure, outer, "Physics step in intervals of the run", x, y);
    if bins.is_empty() {
        panel.remark("no timing in the log");
        return panel.finish();
    }
    // Extend from the middle of the first and last interval to the ends of the run.
    let ends = [bins.first().map(|(_, q)| (0.0, *q)), bins.last().map(|(_, q)| (end_s, *q))];
    let [first, last] = ends.map(|end| end.into_iter());
    let all: Vec<_> = first.chain(bins.iter().copied()).chain(last).collect();
    let curve = |of: fn(&Quantiles) -> f64| all.iter().map(|(t, q)| (*t, of(q))).collect::<Vec<Point>>();
    let thin = Stroke { colour: GREY, width: 1.2, dash: &[1.5, 2.0] };
    panel.line(&curve(|q| q.max), thin, "longest");
    let p99 = Stroke { dash: &[7.0, 3.0], ..Stroke::full(COLOURS[1], 1.8) };
    panel.line(&curve(|q| q.p99), p99, "p99");
    panel.line(&curve(|q| q.p50), Stroke::full(COLOURS[0], 2.0), "p50");
    let period = Stroke { colour: INK, width: 1.2, dash: &[8.0, 2.5, 2.0, 2.5] };
    panel.line(&[(0.0, period_us), (end_s, period_us)], period, "period of a tick");
    let missed = Stroke::full(COLOURS[1], 2.0);
    let times: Vec<f64> = timing.missed_over_time.iter().filter(|(_, n)| **n > 0).map(|(t, _)| t).collect();
    for &time_s in &times {
        panel.bar(time_s.min(end_s), missed);
    }
    if is_realtime(timing) {
        let key = if times.is_empty() { Key::None } else { Key::Bar(missed) };
        panel.key(key, &format!("missed ticks: {}", timing.misses.missed()));
    }
    panel.finish_with_row();
}

/// Returns the outline (µs, count) of a histogram with bars of equal width on a logarithmic axis.
fn outline(distribution: &Distribution) -> Vec<Point> {
    let bar_of = |us: f64| (us.max(SHORTEST_US).log10() * BARS_PER_DECADE).floor() as i64;
    let edge = |bar: i64| 10f64.powf(bar as f64 / BARS_PER_DECADE);
    let mut bars: Vec<(i64, u64)> = Vec::new();
    for (value_ns, count) in distribution.recorded() {
        let bar = bar_of(value_ns as f64 * 1e-3);
        match bars.last_mut() {
            Some((last, sum)) if *last == bar => *sum += count,
            _ => bars.push((bar, count)),
        }
    }
    let mut points: Vec<Point> = Vec::new();
    for (i, &(bar, count)) in bars.iter().enumerate() {
        if i == 0 || bars[i - 1].0 + 1 != bar {
            points.push((edge(bar), 0.0));
        }
        points.extend([(edge(bar), count as f64), (edge(bar + 1), count as f64)]);
        if bars.get(i + 1).is_none_or(|next| next.0 != bar + 1) {
            points.push((edge(bar + 1), 0.0));
        }
    }
    points
}

/// Draws a panel with the distributions of a quantity, counts over µs, both axes logarithmic.
pub fn draw_histogram(
    figure: &mut Figure,
    outer: Rect,
    title: &str,
    quantity: &str,
    distributions: &[(String, &Distribution)],
    without: &str,
) {
    let outlines: Vec<Vec<Point>> = distributions.iter().map(|(_, d)| outline(d)).collect();
    let points = || outlines.iter().flatten();
    let x = Axis::logarithmic(quantity, points().map(|p| p.0), duration_label);
    // The axis begins below 1, so that counts of 1 are visible.
    let top = points().map(|p| p.1).fold(1.0, f64::max);
    let mut y = Axis::logarithmic("ticks", [0.6, 30.0 * top].into_iter(), count_label);
    y.retain(|value| value >= 1.0);
    let mut panel = Panel::new(figure, outer, title, x, y);
    if points().next().is_none() {
        panel.remark(without);
    }
    for (i, ((name, distribution), outline)) in distributions.iter().zip(&outlines).enumerate() {
        let Some(q) = distribution.quantiles(1e3) else { continue };
        let (stroke, mark) = (Stroke::of_palette(i, 1.6), Stroke::full(INK, 1.3));
        if distributions.len() == 1 {
            let band: Vec<_> = outline.iter().map(|&(us, count)| (us, 0.0, count)).collect();
            panel.band(&band, lighter(stroke.colour));
        }
        panel.line(outline, stroke, name);
        let [p50, p99, max] = [q.p50, q.p99, q.max].map(duration_label);
        let (median, tail) = (Stroke { dash: P50_DASH, ..mark }, Stroke { dash: P99_DASH, ..mark });
        if name.is_empty() {
            panel.upright(q.p50, median);
            panel.upright(q.p99, tail);
            panel.key(Key::Line(median), &format!("p50 {p50}"));
            panel.key(Key::Line(tail), &format!("p99 {p99}"));
            panel.key(Key::None, &format!("max {max}"));
        } else {
            panel.key(Key::None, &format!("p50 {p50}"));
            panel.key(Key::None, &format!("p99 {p99}, max {max}"));
        }
    }
    panel.finish();
}
