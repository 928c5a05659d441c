//! The chart's numbers: `drr.csv`, and the table that is printed and written as `drr.md`.

use std::fmt::Write;

use super::spectrum::SpectrumErrors;
use super::{Point, STANDARD};

/// Returns the table, the ratio to the peers, and the spectrum's errors.
pub fn text(points: &[Point], stream_ms: &[f64; 2], spectrum: &[SpectrumErrors]) -> String {
    let mut text = full_resolution(points);
    // Writing to a String cannot fail.
    let _ = writeln!(
        text,
        "\nReading the finest volume once: {:.2} ms with 1 thread, {:.2} with 2.",
        stream_ms[0], stream_ms[1]
    );
    text.push_str(&ratio_to_peers(points).unwrap_or_default());
    for errors in spectrum {
        let _ = writeln!(
            text,
            "Spectrum of {} kV: table error at most {:.1e} in -ln I. Error of a single energy ({:.0} keV, \
             exact for 200 mm of tissue): 20 mm of bone behind the tissue {:+.0} %, \
             3 mm of nitinol {:+.0} %.",
            errors.tube_kv,
            errors.table,
            errors.effective_kev,
            100.0 * errors.bone_20_mm,
            100.0 * errors.nitinol_3_mm
        );
    }
    text
}

/// Returns one row per point.
pub fn csv(points: &[Point]) -> String {
    let mut csv =
        "method,coarseness,pose,threads,least_ms,median_ms,exact_rms,exact_max,siddon_rms,siddon_max\n"
            .to_owned();
    for p in points {
        let (least_ms, median_ms) = p.least_and_median_ms();
        let _ = writeln!(
            csv,
            "{},{},{},{},{least_ms:.4},{median_ms:.4},{:.4e},{:.4e},{:.4e},{:.4e}",
            p.method, p.coarseness, p.pose, p.threads, p.exact.rms, p.exact.max, p.siddon.rms, p.siddon.max
        );
    }
    csv
}

/// Returns the points of the finest volume: one line per method and number of threads, with the poses side by
/// side.
fn full_resolution(points: &[Point]) -> String {
    let finest = points.iter().map(|p| p.coarseness).min();
    let at_full: Vec<&Point> = points.iter().filter(|p| Some(p.coarseness) == finest).collect();
    let mut poses: Vec<&str> = Vec::new();
    let mut lines: Vec<(&str, usize)> = Vec::new();
    for p in &at_full {
        if !poses.contains(&p.pose) {
            poses.push(p.pose);
        }
        if !lines.contains(&(p.method.as_str(), p.threads)) {
            lines.push((&p.method, p.threads));
        }
    }
    let mut text = format!(
        "| method | threads | ms min (median): {} | r.m.s. error, exact | largest, exact | r.m.s. error, \
        Siddon |\n\
         |---|---|---|---|---|---|\n",
        poses.join(", ")
    );
    for (method, threads) in lines {
        let of_line: Vec<&Point> = poses
            .iter()
            .filter_map(|pose| {
                at_full.iter().find(|p| p.method == method && p.threads == threads && p.pose == *pose)
            })
            .copied()
            .collect();
        let list = |what: &dyn Fn(&Point) -> String| {
            of_line.iter().map(|p| what(p)).collect::<Vec<String>>().join(", ")
        };
        let times = list(&|p| {
            let (least_ms, median_ms) = p.least_and_median_ms();
            format!("{least_ms:.3} ({median_ms:.3})")
        });
        let (rms, largest) = (list(&|p| error(p.exact.rms)), list(&|p| error(p.exact.max)));
        let siddon = list(&|p| error(p.siddon.rms));
        let _ = writeln!(text, "| {method} | {threads} | {times} | {rms} | {largest} | {siddon} |");
    }
    text
}

fn error(value: f64) -> String {
    if value == 0.0 { "0".to_owned() } else { format!("{value:.2e}") }
}

/// Returns sentences about the default projector at full resolution with two threads. For each pose: the time
/// of the fastest peer with an equal or larger error against the closed-form integrals, divided by our time,
/// from the minimum and from the median times; then the median over the poses.
fn ratio_to_peers(points: &[Point]) -> Option<String> {
    let finest = points.iter().map(|p| p.coarseness).min()?;
    let at_full: Vec<&Point> = points.iter().filter(|p| p.coarseness == finest && p.threads == 2).collect();
    let (mut text, mut least_ratios, mut median_ratios) = (String::new(), Vec::new(), Vec::new());
    for own in at_full.iter().filter(|p| p.method == STANDARD.0) {
        let (own_least, own_median) = own.least_and_median_ms();
        let peers = at_full.iter().filter(|p| p.is_peer() && p.pose == own.pose);
        let no_better = peers.filter(|p| p.exact.rms >= own.exact.rms);
        let fastest =
            no_better.min_by(|a, b| a.least_and_median_ms().0.total_cmp(&b.least_and_median_ms().0))?;
        let (least, median) = fastest.least_and_median_ms();
        let (by_least, by_median) = (least / own_least, median / own_median);
        let name = fastest.method.trim_start_matches("peer:");
        let _ = writeln!(
            text,
            "{}: {} is {by_least:.1} times as fast as {name} by minimum times, {by_median:.1} by medians.",
            own.pose, own.method
        );
        least_ratios.push(by_least);
        median_ratios.push(by_median);
    }
    let middle = |ratios: &mut Vec<f64>| {
        ratios.sort_by(f64::total_cmp);
        ratios.get(ratios.len() / 2).copied()
    };
    let (by_least, by_median) = (middle(&mut least_ratios)?, middle(&mut median_ratios)?);
    let _ = writeln!(
        text,
        "Median over the poses, against the fastest peer of equal or larger error: {by_least:.1} times by \
         minimum times, {by_median:.1} by medians."
    );
    Some(text)
}
