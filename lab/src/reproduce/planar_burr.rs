//! The planar burr of Fig. 4: pushed by a constant force along a boundary, free to move sideways.

use crate::effort::Effort;
use figures::{Axis, Figure, FigureError, Panel, RGBColor, Stroke};
use nalgebra::Vector3;
use rayon::prelude::*;

use simulation::bone::{BoneField, BoneParameters, BurrState, ContactBuffer, Removal};

use super::output::{Plan, Table};
use super::rig::Block;
use super::tunnel::FOAM_KG_PER_M3;
use trabecula::failure::Failure;

const RADIUS_M: f64 = 2.5e-3;
const SPEED_RAD_S: f64 = 235.6;
const DT_S: f64 = 1e-3;
/// Travel of an unobstructed burr per tick, m: 20 mm/s.
const STEP_M: f64 = 2e-5;
/// Limits at which a run ends, m and s.
const DEPTH_M: f64 = 8e-3;
const LIMIT_S: f64 = 120.0;
const RATIOS: [f64; 4] = [1.0, 2.0, 5.0, 10.0];
const FORCES_N: [f64; 3] = [1.0, 2.0, 5.0];
const RULES: [(Removal, &str, RGBColor); 4] = [
    (Removal::Naive, "naive", RGBColor(150, 150, 150)),
    (Removal::Capped, "capped", RGBColor(230, 159, 0)),
    (Removal::Decrement, "decrement", RGBColor(213, 94, 0)),
    (Removal::Energy, "energy", RGBColor(0, 114, 178)),
];

struct Run {
    rule: Removal,
    name: &'static str,
    ratio: f64,
    force_n: f64,
    /// Displacement of the burr centre from its start, m.
    moved: Vector3<f64>,
    seconds: f64,
    path: Vec<(f64, f64)>,
}

pub(super) fn run(plan: &Plan) -> Result<(), Failure> {
    let mut jobs = Vec::new();
    for (rule, name, _) in RULES {
        for ratio in RATIOS {
            // The published rules do not depend on force.
            let forces: &[f64] =
                if rule == Removal::Energy && plan.effort == Effort::Full { &FORCES_N } else { &[5.0] };
            jobs.extend(forces.iter().map(|force| (rule, name, ratio, *force)));
        }
    }
    let runs: Vec<Run> = jobs
        .into_par_iter()
        .map(|(rule, name, ratio, force_n)| drill(rule, name, ratio, force_n))
        .collect::<Result<_, _>>()?;
    let mut table =
        Table::new(&["removal", "density_ratio", "force_n", "aside_mm", "across_mm", "depth_mm", "seconds"]);
    for run in &runs {
        table.row(vec![
            run.name.to_owned(),
            format!("{}", run.ratio),
            format!("{}", run.force_n),
            format!("{:.3}", run.moved.x * 1e3),
            format!("{:.3}", run.moved.y * 1e3),
            format!("{:.2}", run.moved.z * 1e3),
            format!("{:.1}", run.seconds),
        ]);
    }
    table.finish(&plan.out, "reproduce-2-planar-burr.csv")?;
    plan.draw(draw(&runs), "reproduce-2-planar-burr")
}

/// Presses the burr along +z onto a boundary at x = 0, with the dense side at +x.
fn drill(rule: Removal, name: &'static str, ratio: f64, force_n: f64) -> Result<Run, Failure> {
    let failed = |cause: simulation::bone::BoneError| Failure::failed(cause.to_string());
    // An odd number of voxels across, 0.3 mm wide, so that the grid has no plane of symmetry at the burr.
    let block = Block::new([-6.0, -6.15, 0.0], [6.0, 6.15, 12.0], 0.3, |p| {
        if p.x > 0.0 { FOAM_KG_PER_M3 * ratio } else { FOAM_KG_PER_M3 }
    });
    let parameters = BoneParameters { threshold_hu: -100, removal: rule, ..BoneParameters::default() };
    let mut field = BoneField::new(block.geometry, &block.hu, parameters).map_err(failed)?;
    let start = Vector3::new(0.0, 0.0, -RADIUS_M);
    let (mut centre_m, mut seconds, mut path) = (start, 0.0, vec![(0.0, 0.0)]);
    while centre_m.z - start.z < DEPTH_M && seconds < LIMIT_S {
        let burr =
            BurrState { centre_m, radius_m: RADIUS_M, speed_rad_s: SPEED_RAD_S, normal_force_n: force_n };
        field.grind(&block.hu, &burr, DT_S).map_err(failed)?;
        centre_m = moved(&field, centre_m);
        seconds += DT_S;
        let at = ((centre_m.x - start.x) * 1e3, (centre_m.z - start.z) * 1e3);
        if path.last().is_none_or(|last| (last.0 - at.0).hypot(last.1 - at.1) > 0.05) {
            path.push(at);
        }
    }
    Ok(Run { rule, name, ratio, force_n, moved: centre_m - start, seconds, path })
}

/// Returns the position after one step along +z, as far as the contact planes allow: the nearest point of the
/// half-spaces' intersection.
fn moved(field: &BoneField, centre_m: Vector3<f64>) -> Vector3<f64> {
    let mut buffer = ContactBuffer::with_capacity(8);
    field.voxels().contact_planes(0, &centre_m, RADIUS_M, 0.3e-3, &mut buffer);
    let mut impulses = [0.0; 8];
    let mut step = Vector3::new(0.0, 0.0, STEP_M);
    for _ in 0..60 {
        for (plane, impulse) in buffer.planes().iter().zip(impulses.iter_mut()) {
            let push: f64 = -(plane.gap_m + plane.normal.dot(&step));
            let total = (*impulse + push).max(0.0);
            step += plane.normal.into_inner() * (total - *impulse);
            *impulse = total;
        }
    }
    centre_m + step
}

fn draw(runs: &[Run]) -> Result<Figure, FigureError> {
    let title = "Planar burr, constant force upward, 5 N, dense side on the right: path of its centre";
    let mut figure = Figure::titled(400.0, title)?;
    for (cell, ratio) in figure.cells(3, 1, 0.0).into_iter().zip([1.0, 5.0, 10.0]) {
        let (x, y) = (Axis::linear("aside (mm)", -8.0, 1.0, 4), Axis::linear("depth (mm)", 0.0, 8.5, 4));
        let mut panel = Panel::new(&mut figure, cell, &format!("density 1 : {ratio}"), x, y);
        for (rule, name, colour) in RULES {
            let own = |run: &&Run| run.rule == rule && run.ratio == ratio && run.force_n == 5.0;
            if let Some(run) = runs.iter().find(own) {
                panel.line(&run.path, Stroke::full(colour, 2.0), name);
            }
        }
        panel.finish();
    }
    Ok(figure)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Fig. 4: earlier rules move the burr only along its axis; strength moves it to the soft side.
    #[test]
    fn only_strength_makes_the_burr_skive() -> Result<(), Failure> {
        let aside_mm = |rule, ratio| drill(rule, "", ratio, 5.0).map(|run| run.moved.x * 1e3);
        for rule in [Removal::Naive, Removal::Capped] {
            assert!(aside_mm(rule, 10.0)?.abs() < 0.1, "{rule:?}");
        }
        for rule in [Removal::Decrement, Removal::Energy] {
            assert!(aside_mm(rule, 1.0)?.abs() < 0.1, "{rule:?} in homogeneous material");
            assert!(aside_mm(rule, 10.0)? < -1.0, "{rule:?}");
        }
        Ok(())
    }
}
