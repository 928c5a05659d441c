//! Thrust of a straight, stiff tool with the standard material law, compared with published ranges.

use crate::effort::Effort;
use rayon::prelude::*;

use super::output::{Plan, Table};
use super::rig::{Block, Trial};
use trabecula::failure::Failure;

struct Row {
    what: &'static str,
    density_kg_per_m3: f64,
    feed_mm_per_s: f64,
    rpm: f64,
    /// Published thrust, N.
    range_n: [f64; 2],
}

const fn row(what: &'static str, density: f64, feed: f64, rpm: f64, range_n: [f64; 2]) -> Row {
    Row { what, density_kg_per_m3: density, feed_mm_per_s: feed, rpm, range_n }
}

/// Ranges: thrust tables collected in J. Healthcare Eng. 2020, 8817422; 14.1 N: J. Braz. Soc. 2020. Where a source names no
/// feed or speed, 50 mm/min and 2250 rpm stand in; densities are those of the standard texts for the named bone. Foam: the few
/// newtons with which such foam is drilled at these feeds.
const ROWS: [Row; 9] = [
    row("foam 10 PCF, 0.05 mm/s", 160.0, 0.05, 2250.0, [1.0, 5.0]),
    row("foam 10 PCF, 0.15 mm/s", 160.0, 0.15, 2250.0, [1.0, 5.0]),
    row("foam 20 PCF, 0.15 mm/s", 320.0, 0.15, 2250.0, [1.0, 5.0]),
    row("human trochanter, cancellous", 350.0, 0.83, 2250.0, [1.0, 1.5]),
    row("porcine vertebra", 600.0, 0.83, 2250.0, [0.6, 29.6]),
    row("artificial femur", 640.0, 0.83, 2250.0, [3.9, 5.6]),
    row("porcine femur", 1700.0, 0.83, 2250.0, [8.1, 11.3]),
    row("bovine femur", 2000.0, 0.83, 2250.0, [12.3, 20.1]),
    row("bovine cortical, 12 000 rpm", 2000.0, 0.83, 12_000.0, [14.1, 14.1]),
];

/// J/mm³ at 1900 kg/m³, and exponent 1: chosen so that as many rows as possible with one pair of numbers are in range.
const LINEAR_LAW: [f64; 2] = [0.062, 1.0];

pub(super) fn run(plan: &Plan) -> Result<(), Failure> {
    let both: Vec<[f64; 2]> = ROWS
        .par_iter()
        .map(|row| Ok([thrust_n(row, None, plan.effort)?, thrust_n(row, Some(LINEAR_LAW), plan.effort)?]))
        .collect::<Result<_, Failure>>()?;
    let mut table = Table::new(&[
        "what",
        "density_kg_per_m3",
        "feed_mm_per_s",
        "rpm",
        "published_n",
        "standard_n",
        "inside",
        "linear_n",
        "inside_too",
    ]);
    for (row, [standard, linear]) in ROWS.iter().zip(both) {
        let [low, high] = row.range_n;
        let inside = |thrust: f64| if (low..=high).contains(&thrust) { "yes" } else { "no" }.to_owned();
        table.row(vec![
            row.what.replace(',', ""),
            format!("{}", row.density_kg_per_m3),
            format!("{}", row.feed_mm_per_s),
            format!("{}", row.rpm),
            if low == high { format!("{low}") } else { format!("{low}-{high}") },
            format!("{standard:.3}"),
            inside(standard),
            format!("{linear:.3}"),
            inside(linear),
        ]);
    }
    table.finish(&plan.out, "reproduce-5-thrust.csv")
}

/// Mean thrust at a steady feed, N.
fn thrust_n(row: &Row, cutting_law: Option<[f64; 2]>, effort: Effort) -> Result<f64, Failure> {
    let block = Block::new([-6.0, -6.0, -12.0], [6.0, 6.0, 12.0], 0.5, |_| row.density_kg_per_m3);
    let faster = if effort == Effort::Quick && row.feed_mm_per_s < 0.5 { 10.0 } else { 1.0 };
    let feed = row.feed_mm_per_s * faster;
    let stiff = Trial { dt_ms: 2.0, stiffness: 1000.0, burr_rpm: row.rpm, ..Trial::new(0.0, feed, 5.0) };
    // Steady thrust is proportional to the feed.
    Trial { cutting_law, ..stiff }.play(&block, |_, _| {}).map(|outcome| outcome.mean_force_n / faster)
}
