//! Bend against tension in free space: friction in the channels, loading and unloading.

use figures::{Axis, Figure, FigureError, Panel, RGBColor, Rect, Stroke, WIDTH};
use nalgebra::{Isometry3, Vector3};
use rayon::prelude::*;
use simulation::manipulator::{
    BaseMotion, Manipulator, ManipulatorError, ManipulatorModel, ManipulatorParameters, StepInput,
    TendonCommand, Wrench,
};

use super::output::{Plan, Table};
use super::tunnel::radius_mm;
use trabecula::failure::Failure;

const FRICTIONS: [f64; 4] = [0.0, 0.1, 0.2, 0.3];
const MAX_TENSION_N: f64 = 14.0;
/// Duration of the loading, and of the unloading, s: 240 periods of the first mode.
const RAMP_S: f64 = 8.0;
const DT_S: f64 = 2e-3;
/// Ma et al. 2023: curvature of the same tool at 90 degrees, 1/mm.
const PUBLISHED_CURVATURE: f64 = 0.045;
const COLOURS: [RGBColor; 4] =
    [RGBColor(0, 114, 178), RGBColor(213, 94, 0), RGBColor(0, 158, 115), RGBColor(204, 121, 167)];

struct Loop {
    friction: f64,
    /// Tension in N and bend in degrees.
    loading: Vec<(f64, f64)>,
    unloading: Vec<(f64, f64)>,
    /// Tension and curvature in 1/mm where the loading passes 90 degrees.
    right_angle: Option<(f64, f64)>,
}

pub(super) fn run(plan: &Plan) -> Result<(), Failure> {
    let loops: Vec<Loop> = FRICTIONS
        .into_par_iter()
        .map(sweep)
        .collect::<Result<_, _>>()
        .map_err(|cause| Failure::failed(cause.to_string()))?;
    let mut table = Table::new(&["friction", "tension_n", "loading_deg", "unloading_deg"]);
    for own in &loops {
        for tension in [2.0, 4.0, 6.0, 8.0, 10.0, 12.0, 14.0] {
            table.row(vec![
                format!("{}", own.friction),
                format!("{tension}"),
                format!("{:.2}", at(&own.loading, tension)),
                format!("{:.2}", at(&own.unloading, tension)),
            ]);
        }
    }
    table.finish(&plan.out, "reproduce-4-tension.csv")?;
    say!("");
    for own in &loops {
        match own.right_angle {
            Some((tension, curvature)) => say!(
                "friction {}: 90 degrees at {tension:.2} N, curvature {curvature:.4} /mm by the \
                 nearest circle (published: {PUBLISHED_CURVATURE})",
                own.friction
            ),
            None => say!("friction {}: below 90 degrees up to {MAX_TENSION_N} N", own.friction),
        }
    }
    plan.draw(draw(&loops), "reproduce-4-tension")
}

fn sweep(friction: f64) -> Result<Loop, ManipulatorError> {
    let mut p = ManipulatorParameters::jhu_27();
    p.tendon.friction_coefficient = friction;
    let base = BaseMotion::at_rest(Isometry3::identity());
    let mut tool = Manipulator::new(p, &base)?;
    let steps = (RAMP_S / DT_S) as usize;
    let mut own = Loop { friction, loading: Vec::new(), unloading: Vec::new(), right_angle: None };
    for k in 0..=2 * steps {
        let share = if k <= steps { k } else { 2 * steps - k } as f64 / steps as f64;
        let tension = MAX_TENSION_N * share;
        let tendon = TendonCommand::Force([tension, 0.0]);
        tool.step(DT_S, &StepInput { base, tendon, tip_wrench: Wrench::zero(), contacts: &[] })?;
        let bend_deg = tool.bend_rad().to_degrees();
        if k <= steps {
            own.loading.push((tension, bend_deg));
            if bend_deg >= 90.0 && own.right_angle.is_none() {
                own.right_angle = Some((tension, curvature_per_mm(&tool)));
            }
        } else {
            own.unloading.push((tension, bend_deg));
        }
    }
    own.unloading.reverse();
    Ok(own)
}

/// Returns the curvature of the best-fit circle through the flexures and the burr.
fn curvature_per_mm(tool: &Manipulator) -> f64 {
    let point = |p: Vector3<f64>| (p.z * 1e3, p.x * 1e3);
    let mut points: Vec<(f64, f64)> =
        (1..=tool.joint_count()).map(|link| point(tool.t_world_link(link).translation.vector)).collect();
    points.push(point(tool.t_world_tip().translation.vector));
    1.0 / radius_mm(&points)
}

/// Returns the bend at the nearest tension of the sweep.
fn at(values: &[(f64, f64)], tension: f64) -> f64 {
    let nearer = |a: &&(f64, f64), b: &&(f64, f64)| (a.0 - tension).abs().total_cmp(&(b.0 - tension).abs());
    values.iter().min_by(nearer).map_or(f64::NAN, |(_, bend)| *bend)
}

fn draw(loops: &[Loop]) -> Result<Figure, FigureError> {
    let mut figure = Figure::new(500.0)?;
    let cell = Rect { x: 0.0, y: 8.0, width: WIDTH, height: 484.0 };
    let (x, y) =
        (Axis::linear("tension (N)", 0.0, MAX_TENSION_N, 7), Axis::linear("bend (degrees)", 0.0, 135.0, 6));
    let title = "Bend against tension: loading full, unloading dashed";
    let mut panel = Panel::new(&mut figure, cell, title, x, y);
    for (own, colour) in loops.iter().zip(COLOURS) {
        panel.line(&own.loading, Stroke::full(colour, 2.0), &format!("friction {}", own.friction));
        panel.line(&own.unloading, Stroke { colour, width: 2.0, dash: &[6.0, 4.0] }, "");
    }
    panel.finish();
    Ok(figure)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// k_i q_i = T_i d, T_{i+1} = T_i exp(-mu q_i) (capstan equation of Euler and Eytelwein) for this table
    /// of stiffnesses: 10 N bends the tool by 86.5, 80.4, 75.2, 70.9 degrees.
    #[test]
    fn loading_follows_the_capstan_and_unloading_stays_behind() -> Result<(), ManipulatorError> {
        for (friction, exact) in FRICTIONS.into_iter().zip([86.5, 80.4, 75.2, 70.9]) {
            let own = sweep(friction)?;
            let (loading, unloading) = (at(&own.loading, 10.0), at(&own.unloading, 10.0));
            // The prediction's links are offset from ours by half a link; presliding.
            assert!((loading - exact).abs() < 0.6, "{friction}: {loading}");
            assert!(if friction > 0.0 {
                unloading > loading + 5.0
            } else {
                (unloading - loading).abs() < 0.1
            });
        }
        Ok(())
    }
}
