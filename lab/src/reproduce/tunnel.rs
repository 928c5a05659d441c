//! Curved drilling in homogeneous foam (Fig. 3, top): tension against feed.

use crate::effort::Effort;
use figures::{Axis, EDGES, Figure, FigureError, HEAD, INK, Panel, RGBColor, Rect, Stroke, WIDTH, bounds};
use nalgebra::Vector3;
use rayon::prelude::*;

use super::output::{Plan, Table};
use super::rig::{Block, Outcome, Trial};
use trabecula::failure::Failure;

/// Tensions of Alambeigi et al. 2017, N.
const TENSIONS_N: [f64; 4] = [6.0, 10.0, 15.0, 25.0];
/// Feeds of Alambeigi et al. 2017, mm/s.
const FEEDS_MM_PER_S: [f64; 3] = [0.05, 0.10, 0.15];
/// Sawbones foam of 10 pounds per cubic foot, kg/m³.
pub const FOAM_KG_PER_M3: f64 = 160.0;
/// Length of the feed beyond the pilot hole, mm.
pub const INSERTION_MM: f64 = 30.0;
/// A tunnel in foam that should follow the tool's own bend stays within this fraction of the bend in air at
/// the same tension.
const OF_AIR: f64 = 0.25;
/// Start of the plotted part of the pilot hole, mm along the feed.
const PILOT_SHOWN_MM: f64 = -6.0;
/// Margin around the drilled region, mm.
const MARGIN_MM: f64 = 1.5;
const REMOVED: RGBColor = RGBColor(214, 226, 236);
const TOOL: RGBColor = RGBColor(0, 114, 178);

/// Returns the block; the origin is the end of the pilot hole.
pub fn block(density_kg_per_m3: f64, effort: Effort) -> Block {
    let voxel_mm = if effort == Effort::Quick { 1.0 } else { 0.5 };
    Block::new([-10.0, -8.0, -38.0], [34.0, 8.0, 36.0], voxel_mm, |_| density_kg_per_m3)
}

struct Case {
    tension_n: f64,
    feed_mm_per_s: f64,
    outcome: Outcome,
    /// Removed voxels of the middle slice, mm.
    slice: Vec<(f64, f64)>,
    voxel_mm: f64,
    path: Vec<(f64, f64)>,
}

pub(super) fn run(plan: &Plan) -> Result<(), Failure> {
    let block = block(FOAM_KG_PER_M3, plan.effort);
    // The quick variant uses ten times the feed.
    let faster = if plan.effort == Effort::Quick { 10.0 } else { 1.0 };
    let feeds: &[f64] = if plan.effort == Effort::Quick { &FEEDS_MM_PER_S[2..] } else { &FEEDS_MM_PER_S };
    let pairs: Vec<(f64, f64)> =
        TENSIONS_N.iter().flat_map(|t| feeds.iter().map(move |feed| (*t, *feed * faster))).collect();
    let cases: Vec<Case> = pairs
        .into_par_iter()
        .map(|(tension_n, feed_mm_per_s)| case(&block, tension_n, feed_mm_per_s))
        .collect::<Result<_, _>>()?;
    let mut table = Table::new(&[
        "tension_n",
        "feed_mm_per_s",
        "bend_deg",
        "tip_x_mm",
        "tip_z_mm",
        "radius_mm",
        "burr_force_max_n",
        "walls_max_n",
        "flange_max_n",
        "of_strength_max",
        "past_stop_max_deg",
        "overlap_max_mm",
        "contacts_max",
        "flexure_max_rad_per_s",
        "air_deg",
        "over_air",
        "within_a_quarter",
    ]);
    let air: Vec<f64> =
        TENSIONS_N.par_iter().map(|tension_n| air_deg(*tension_n)).collect::<Result<_, _>>()?;
    for case in &cases {
        let own = TENSIONS_N.iter().zip(&air).find(|(tension_n, _)| **tension_n == case.tension_n);
        let air_deg = own.map_or(f64::NAN, |(_, air_deg)| *air_deg);
        let (end, bend_deg) = (case.outcome.burr_m() * 1e3, case.outcome.end.bend_rad.to_degrees());
        table.row(vec![
            format!("{}", case.tension_n),
            format!("{}", case.feed_mm_per_s),
            format!("{bend_deg:.1}"),
            format!("{:.2}", end.x),
            format!("{:.2}", end.z),
            format!("{:.1}", radius_mm(&case.path)),
            format!("{:.3}", case.outcome.most_force_n),
            format!("{:.1}", case.outcome.most_wall_n),
            format!("{:.1}", case.outcome.most_flange_n),
            format!("{:.3}", case.outcome.most_share),
            format!("{:.3}", case.outcome.past_stop_rad.to_degrees()),
            format!("{:.3}", case.outcome.deepest_m * 1e3),
            format!("{}", case.outcome.most_contacts),
            format!("{:.3}", case.outcome.fastest_rad_per_s),
            format!("{air_deg:.1}"),
            format!("{:.2}", bend_deg / air_deg),
            if case.outcome.is_finite() && (bend_deg / air_deg - 1.0).abs() <= OF_AIR { "yes" } else { "no" }
                .to_owned(),
        ]);
    }
    table.finish(&plan.out, "reproduce-1-tunnel.csv")?;
    plan.draw(draw(&cases), "reproduce-1-tunnel")
}

/// Returns the bend of the tool in air under a tension, degrees.
fn air_deg(tension_n: f64) -> Result<f64, Failure> {
    let empty = Block::new([-1.0; 3], [1.0; 3], 1.0, |_| 0.0);
    let trial = Trial { pilot: false, ..Trial::new(tension_n, 1.0, 1.0) };
    trial.play(&empty, |_, _| {}).map(|outcome| outcome.end.bend_rad.to_degrees())
}

fn case(block: &Block, tension_n: f64, feed_mm_per_s: f64) -> Result<Case, Failure> {
    let trial = Trial::new(tension_n, feed_mm_per_s, INSERTION_MM);
    let [nx, ny, _] = block.geometry.dims;
    let middle = ny / 2;
    let (mut slice, mut path) = (Vec::new(), Vec::new());
    let outcome = trial.play(block, |state, removed| {
        for index in removed {
            let index = *index as usize;
            let (i, j, k) = (index % nx, (index / nx) % ny, index / (nx * ny));
            if j == middle {
                let centre = block.geometry.voxel_centre_world_m(i, j, k) * 1e3;
                slice.push((centre.z, centre.x));
            }
        }
        let burr = Vector3::from(state.t_world_burr.position_m) * 1e3;
        let far = path.last().is_none_or(|last: &(f64, f64)| (last.0 - burr.z).hypot(last.1 - burr.x) > 0.1);
        if far {
            path.push((burr.z, burr.x));
        }
    })?;
    let voxel_mm = block.geometry.spacing_m[0] * 1e3;
    Ok(Case { tension_n, feed_mm_per_s, outcome, slice, voxel_mm, path })
}

/// Returns the radius of the best-fit circle to the path by Kasa's method (1976), mm.
pub fn radius_mm(path: &[(f64, f64)]) -> f64 {
    let mut normal = nalgebra::Matrix3::zeros();
    let mut right = Vector3::zeros();
    for &(x, y) in path {
        let row = Vector3::new(x, y, 1.0);
        normal += row * row.transpose();
        right += row * (x * x + y * y);
    }
    let Some(solution) = normal.lu().solve(&right) else { return f64::NAN };
    let (x, y) = (0.5 * solution.x, 0.5 * solution.y);
    (solution.z + x * x + y * y).sqrt()
}

fn draw(cases: &[Case]) -> Result<Figure, FigureError> {
    let columns = cases.len() / TENSIONS_N.len();
    let shown = shown_mm(cases);
    let per_mm = plot_width(columns) / (shown[0][1] - shown[0][0]);
    let high = (shown[1][1] - shown[1][0]) * per_mm + EDGES.1;
    let title = "Drilled voxels (light), tool (blue), path of the burr's centre (dashed)";
    let mut figure = Figure::titled(HEAD + high * TENSIONS_N.len() as f64, title)?;
    for (cell, case) in figure.cells(columns, TENSIONS_N.len(), 0.0).into_iter().zip(cases) {
        draw_case(&mut figure, cell, case, shown);
    }
    Ok(figure)
}

/// Returns the width of a panel's plot, in a row of `columns` panels.
fn plot_width(columns: usize) -> f64 {
    WIDTH / columns as f64 - EDGES.0
}

/// Returns the plotted ranges along the feed and the bend, mm: every drilled voxel and path, and the pilot
/// hole's end.
fn shown_mm(cases: &[Case]) -> [[f64; 2]; 2] {
    let drilled = cases.iter().flat_map(|case| case.slice.iter().chain(&case.path));
    let points: Vec<(f64, f64)> = drilled.copied().chain([(PILOT_SHOWN_MM, 0.0)]).collect();
    let range = |values: Vec<f64>| bounds(values.into_iter()).unwrap_or((0.0, 1.0));
    let along = range(points.iter().map(|point| point.0).collect());
    let bend = range(points.iter().map(|point| point.1).collect());
    [along, bend].map(|(low, high)| [low - MARGIN_MM, high + MARGIN_MM])
}

fn draw_case(figure: &mut Figure, cell: Rect, case: &Case, [along, bend]: [[f64; 2]; 2]) {
    let title = format!(
        "{} N, {} mm/s: {:.0}°",
        case.tension_n,
        case.feed_mm_per_s,
        case.outcome.end.bend_rad.to_degrees()
    );
    let x = Axis::linear("along (mm)", along[0], along[1], 5);
    let y = Axis::linear("bend (mm)", bend[0], bend[1], 5);
    let mut panel = Panel::new(figure, cell, &title, x, y);
    let half = 0.5 * case.voxel_mm;
    for &(z, x) in &case.slice {
        panel.band(&[(z - half, x - half, x + half), (z + half, x - half, x + half)], REMOVED);
    }
    let state = &case.outcome.end;
    let links = state.t_world_link.iter().take(state.joint_count as usize);
    let tool: Vec<(f64, f64)> = links
        .chain([&state.t_world_burr])
        .map(|pose| (pose.position_m[2] * 1e3, pose.position_m[0] * 1e3))
        .collect();
    panel.line(&tool, Stroke::full(TOOL, 5.0), "");
    panel.line(&case.path, Stroke { colour: INK, width: 1.2, dash: &[4.0, 3.0] }, "");
    panel.finish();
}
