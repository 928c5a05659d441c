//! A straight insertion into denser material (Fig. 3, bottom), and the planar burr of Fig. 4.

use crate::effort::Effort;
use figures::{Axis, Figure, FigureError, Panel, RGBColor, Stroke};
use nalgebra::Vector3;
use rayon::prelude::*;

use super::output::{Plan, Table};
use super::planar_burr;
use super::rig::{Block, Outcome, Trial};
use super::tunnel::FOAM_KG_PER_M3;
use trabecula::failure::Failure;

/// Density ratios of the far side to the near side.
const RATIOS: [f64; 5] = [1.0, 2.0, 3.0, 5.0, 10.0];
/// Feeds, mm/s.
const FEEDS_MM_PER_S: [f64; 4] = [0.1, 0.5, 1.0, 2.0];
/// Length of the feed, mm.
pub const INSERTION_MM: f64 = 14.0;
/// Depth at which the axis reaches the dense side, mm.
const MEETS_MM: f64 = 7.0;
/// Angle between the axis and the boundary: 30 degrees.
const NORMAL: [f64; 3] = [0.866_025_403_784_438_6, 0.0, 0.5];
/// Edge force, N/mm, and exponent of the density: assumptions, for about 1.2 N of thrust in this foam.
const EDGE: [f64; 2] = [7.0, 1.5];
/// With an edge force, the tool should leave its line by at least this much into 1:10 at the experiment's
/// feed, and stay on it into 1:1, mm.
const SKIVES_MM: f64 = 2.0;
const STRAIGHT_MM: f64 = 0.02;
/// Maximum number of ticks that the decrement takes for a voxel of the dense side, at the burr's speed.
const DECREMENT_TICKS: f64 = 150.0;
const COLOURS: [RGBColor; 4] =
    [RGBColor(0, 114, 178), RGBColor(213, 94, 0), RGBColor(0, 158, 115), RGBColor(204, 121, 167)];

/// Foam, with material denser by `ratio` beyond an oblique plane.
pub fn block(foam_kg_per_m3: f64, ratio: f64, effort: Effort) -> Block {
    let voxel_mm = voxel_mm(effort);
    let (normal, point) = (Vector3::from(NORMAL), Vector3::new(0.0, 0.0, MEETS_MM * 1e-3));
    let density = move |p: &Vector3<f64>| {
        if (p - point).dot(&normal) > 0.0 { foam_kg_per_m3 * ratio } else { foam_kg_per_m3 }
    };
    Block::new([-16.0, -8.0, -38.0], [16.0, 8.0, 24.0], voxel_mm, density)
}

fn voxel_mm(effort: Effort) -> f64 {
    if effort == Effort::Quick { 1.0 } else { 0.5 }
}

/// The straight insertion.
pub fn trial(feed_mm_per_s: f64) -> Trial {
    Trial { dt_ms: 2.0, ..Trial::new(0.0, feed_mm_per_s, INSERTION_MM) }
}

pub(super) fn run(plan: &Plan) -> Result<(), Failure> {
    sweep(plan)?;
    say!("");
    edge(plan)?;
    say!("");
    rules(plan)?;
    say!("");
    planar_burr::run(plan)
}

fn cells(ratio: f64, feed: f64, outcome: &Outcome) -> Vec<String> {
    let end = outcome.burr_m() * 1e3;
    vec![
        format!("{ratio}"),
        format!("{feed}"),
        format!("{:.2}", end.x),
        format!("{:.2}", end.y),
        format!("{:.2}", end.z),
        format!("{:.2}", outcome.end.bend_rad.to_degrees()),
        format!("{:.2}", outcome.most_force_n),
        format!("{:.3}", outcome.deepest_m * 1e3),
    ]
}

const HEAD: [&str; 8] = [
    "density_ratio",
    "feed_mm_per_s",
    "tip_x_mm",
    "tip_y_mm",
    "tip_z_mm",
    "bend_deg",
    "burr_force_max_n",
    "overlap_max_mm",
];

fn sweep(plan: &Plan) -> Result<(), Failure> {
    let ratios: &[f64] = if plan.effort == Effort::Quick { &[1.0, 10.0] } else { &RATIOS };
    let feeds: &[f64] = if plan.effort == Effort::Quick { &FEEDS_MM_PER_S[2..] } else { &FEEDS_MM_PER_S };
    let pairs: Vec<(f64, f64)> =
        ratios.iter().flat_map(|ratio| feeds.iter().map(move |feed| (*ratio, *feed))).collect();
    let outcomes: Vec<(f64, f64, Outcome)> = pairs
        .into_par_iter()
        .map(|(ratio, feed)| {
            let block = block(FOAM_KG_PER_M3, ratio, plan.effort);
            trial(feed).play(&block, |_, _| {}).map(|outcome| (ratio, feed, outcome))
        })
        .collect::<Result<_, _>>()?;
    let mut table = Table::new(&HEAD);
    outcomes.iter().for_each(|(ratio, feed, outcome)| table.row(cells(*ratio, *feed, outcome)));
    table.finish(&plan.out, "reproduce-2-skiving.csv")?;
    plan.draw(draw(&outcomes, feeds), "reproduce-2-skiving")
}

/// Repeats the insertion at the experiments' feeds with the edge force of part 5.
fn edge(plan: &Plan) -> Result<(), Failure> {
    let feeds: &[f64] = if plan.effort == Effort::Quick { &[1.0] } else { &[0.1, 0.5] };
    let jobs: Vec<(f64, f64)> =
        [1.0, 10.0].into_iter().flat_map(|ratio| feeds.iter().map(move |feed| (ratio, *feed))).collect();
    let outcomes: Vec<(f64, f64, Outcome)> = jobs
        .into_par_iter()
        .map(|(ratio, feed)| {
            let block = block(FOAM_KG_PER_M3, ratio, plan.effort);
            let trial = Trial { edge_law: Some(EDGE), ..trial(feed) };
            trial.play(&block, |_, _| {}).map(|outcome| (ratio, feed, outcome))
        })
        .collect::<Result<_, _>>()?;
    let mut table = Table::new(&HEAD);
    outcomes.iter().for_each(|(ratio, feed, outcome)| table.row(cells(*ratio, *feed, outcome)));
    table.finish(&plan.out, "reproduce-2-edge.csv")?;
    say!("edge force {} N/mm, exponent {}", EDGE[0], EDGE[1]);
    for (ratio, feed, outcome) in &outcomes {
        let aside_mm = outcome.burr_m().x.hypot(outcome.burr_m().y) * 1e3;
        let wanted = if *ratio > 1.0 { aside_mm >= SKIVES_MM } else { aside_mm <= STRAIGHT_MM };
        let verdict = if wanted { "as expected" } else { "NOT as expected" };
        say!("1:{ratio} at {feed} mm/s: {aside_mm:.3} mm aside, {verdict}");
    }
    Ok(())
}

/// Repeats the insertion with the published removal rules; the paper's own rule also at feeds at and above
/// its clearance rate.
fn rules(plan: &Plan) -> Result<(), Failure> {
    let at_1_mm_per_s = ["energy", "naive", "capped", "decrement"].map(|removal| (removal, 1.0));
    let clearance = clearance_mm_per_s(plan.effort);
    let above = [1.0, 2.0].map(|share| ("decrement", share * clearance));
    let jobs: Vec<(&'static str, f64, f64)> = at_1_mm_per_s
        .into_iter()
        .chain(above)
        .flat_map(|(removal, feed)| [1.0, 10.0].map(|ratio| (removal, feed, ratio)))
        .collect();
    let outcomes: Vec<(&str, f64, f64, Outcome)> = jobs
        .into_par_iter()
        .map(|(removal, feed, ratio)| {
            let block = block(FOAM_KG_PER_M3, ratio, plan.effort);
            let trial = Trial { removal, ..trial(feed) };
            trial.play(&block, |_, _| {}).map(|outcome| (removal, feed, ratio, outcome))
        })
        .collect::<Result<_, _>>()?;
    let mut head = vec!["removal"];
    head.extend(HEAD);
    let mut table = Table::new(&head);
    for (removal, feed, ratio, outcome) in &outcomes {
        let mut row = vec![(*removal).to_owned()];
        row.extend(cells(*ratio, (*feed * 1e3).round() * 1e-3, outcome));
        table.row(row);
    }
    table.finish(&plan.out, "reproduce-2-rules.csv")?;
    say!("decrement: the dense side is cleared at {clearance:.2} mm/s (a voxel in {DECREMENT_TICKS} ticks)");
    Ok(())
}

/// Returns the feed at which the decrement removes the densest voxels in time: one voxel per maximum number
/// of ticks.
fn clearance_mm_per_s(effort: Effort) -> f64 {
    voxel_mm(effort) / (DECREMENT_TICKS * trial(1.0).dt_ms * 1e-3)
}

/// Title, unit and value of a panel.
type Quantity<'a> = (&'a str, &'a str, &'a dyn Fn(&Outcome) -> f64);

fn draw(outcomes: &[(f64, f64, Outcome)], feeds: &[f64]) -> Result<Figure, FigureError> {
    let title = "Skiving: a straight insertion that meets denser material";
    let mut figure = Figure::titled(420.0, title)?;
    let at = |feed: f64, value: &dyn Fn(&Outcome) -> f64| -> Vec<(f64, f64)> {
        let own = outcomes.iter().filter(|(_, own, _)| *own == feed);
        own.map(|(ratio, _, outcome)| (*ratio, value(outcome))).collect()
    };
    let drift = |outcome: &Outcome| -outcome.burr_m().x * 1e3;
    let bend = |outcome: &Outcome| -outcome.end.bend_rad.to_degrees();
    let quantities: [Quantity<'_>; 2] =
        [("Tip, away from the dense side", "mm", &drift), ("Bend away", "degrees", &bend)];
    for (cell, (title, unit, value)) in figure.cells(2, 1, 0.0).into_iter().zip(quantities) {
        let all = outcomes.iter().map(|(.., outcome)| value(outcome)).chain([0.0]);
        let (x, y) = (Axis::linear("density ratio", 0.0, 10.5, 5), Axis::around(unit, all, 5));
        let mut panel = Panel::new(&mut figure, cell, title, x, y);
        for (feed, colour) in feeds.iter().zip(COLOURS) {
            let values = at(*feed, value);
            panel.line(&values, Stroke::full(colour, 2.0), &format!("{feed} mm/s"));
            values.into_iter().for_each(|value| panel.disc(value, 3.5, colour));
        }
        panel.finish();
    }
    Ok(figure)
}
