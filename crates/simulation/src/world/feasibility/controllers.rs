//! Rules about the controllers, the arm and the X-ray of a run.

use nalgebra::Vector3;
use scene::{Controller, Drives, Feedback};

use super::{Feed, Start};
use crate::arm::{Arm, ArmCommand, LEAST_MANIPULABILITY_M3};
use crate::manipulator::{Integrator, ManipulatorModel, Rung};

/// Tolerance for a target beyond the end of the feed, mm: the drilled tip is not exactly at the tool tip, and
/// targets are not measured to a tenth of a burr.
const BEYOND_MM: f64 = 0.5;
/// Tolerance for a target behind the start, mm: less is displayed as 0.0, and rounding can put a target
/// beside the start behind it.
const BEHIND_MM: f64 = 0.05;
/// Relative difference below which two rates are the same: 30 ticks of 1 ms are usually written as 33.33 Hz.
const SAME_RATE: f64 = 2e-4;

/// The longest step, ms, at which most hard cases in bone end up at the same place as at 0.2 ms, and at which
/// every shipped tool is accurate on every model (docs/accuracy-physics.md, docs/tools.md; `trabecula-lab
/// chart stability --bone` and `--tools`).
const LONGEST_STEP_MS: f64 = 2.0;

impl Start<'_> {
    fn flexible_mm(&self) -> f64 {
        1e3 * self.simulation.manipulator.parameters().flexible_length_m()
    }

    /// Returns the start's `|det J|` of the joints that move on a path, if it is too small for a path.
    fn singular_m3(&self) -> Option<f64> {
        let arm = &self.simulation.arm;
        if !arm.parameters().geometry.turns() {
            return None;
        }
        let found_m3 = arm.parameters().geometry.manipulability_on_path_m3(&arm.state().q_rad);
        (found_m3 < LEAST_MANIPULABILITY_M3).then_some(found_m3)
    }

    /// Returns the first feed along a path of the arm.
    pub(super) fn arm_feed(&self) -> Option<Feed<'_>> {
        self.feeds().find(|feed| feed.is_arms && feed.drives.contains(&Drives::Arm) && feed.length_mm > 0.0)
    }
}

pub(super) fn program_is_missing(start: &Start) -> Option<String> {
    let mut controllers = start.scene.controller.iter();
    let (name, program) = controllers.find_map(|controller| {
        let program = controller.command.as_ref()?.first()?;
        (!(start.program_exists)(program)).then_some((&controller.name, program))
    })?;
    Some(format!(
        "of `{name}`: program `{program}` not found; expected a path to an executable file or a name in PATH"
    ))
}

pub(super) fn feed_ends_before_bone(start: &Start) -> Option<String> {
    let feed = start.feeds().next()?;
    let (gap_mm, reach_mm) = (1e3 * start.burr_gap_m?, feed.length_mm + start.flexible_mm());
    (gap_mm > reach_mm).then(|| {
        format!(
            "puts the burr {gap_mm:.1} mm from the nearest bone; allowed: at most {reach_mm:.1}: `{}.{}` \
             plus the tool's flexible length",
            feed.table, feed.length_key
        )
    })
}

pub(super) fn no_arm_to_move(start: &Start) -> Option<String> {
    let is_held = !start.simulation.arm.parameters().geometry.moves();
    (is_held && start.is_led(Drives::Arm)).then(|| {
        "is \"fixed\", but a controller drives the arm; choose an arm, or remove \"arm\" from \
         `controller.drives`"
            .to_owned()
    })
}

pub(super) fn no_path_from_singular_start(start: &Start) -> Option<String> {
    start.arm_feed()?;
    let found_m3 = start.singular_m3()?;
    Some(format!(
        "is singular (manipulability {found_m3:.1e} m³; allowed: {LEAST_MANIPULABILITY_M3:.0e} or more): \
         the arm cannot insert from there"
    ))
}

pub(super) fn singular_start(start: &Start) -> Option<String> {
    if start.arm_feed().is_some() || !start.is_led(Drives::Arm) {
        return None;
    }
    let found_m3 = start.singular_m3()?;
    Some(format!(
        "is singular (manipulability {found_m3:.1e} m³, Cartesian motion needs \
         {LEAST_MANIPULABILITY_M3:.0e}): only joint commands work from there"
    ))
}

/// Checks that the arm accepts the feed that its controller will command: it rejects one that is out of
/// reach, beyond a joint's range or a gantry's travel, or through a singularity.
pub(super) fn feed_beyond_arm(start: &Start) -> Option<String> {
    let feed = start.arm_feed()?;
    let arm = &start.simulation.arm;
    if no_arm_to_move(start).is_some() || start.singular_m3().is_some() {
        return None;
    }
    let mut asked = Arm::new(*arm.parameters(), &arm.state().q_rad).ok()?;
    let refused = asked.command(ArmCommand::Insert {
        axis_world: Vector3::from(start.scene.tool.direction).normalize(),
        depth_m: feed.length_mm * 1e-3,
        feed_m_s: arm.parameters().cartesian_limits.speed_m_s,
    });
    let reason = refused.err()?;
    let Feed { table, length_key, length_mm, .. } = feed;
    Some(format!("cannot follow the feed (`{table}.{length_key}` = {length_mm}): {reason}"))
}

/// Checks the feed's speed: the arm would reject every command of a faster feed, and the tool would not move.
pub(super) fn feed_faster_than_arm(start: &Start) -> Option<String> {
    let feed = start.arm_feed()?;
    if no_arm_to_move(start).is_some() {
        return None;
    }
    let most_mm_s = start.scene.arm.max_speed_mm_per_s;
    let (key, speed_mm_s) = feed.fastest_mm_s;
    (speed_mm_s > most_mm_s).then(|| {
        format!("is {most_mm_s}, expected at least {speed_mm_s}: the arm rejects `{}.{key}`", feed.table)
    })
}

/// Returns the target of curved drilling, relative to the burr: ahead and off the feed axis, mm; and the
/// length of the feed, mm.
fn target_mm(start: &Start) -> Option<[f64; 3]> {
    let mut plans =
        start.scene.controller.iter().filter_map(|controller| controller.curved_drilling.as_ref());
    let (target_mm, length_mm) = plans.find_map(|plan| Some((plan.target_mm?, plan.insertion_mm)))?;
    let along = Vector3::from(start.scene.tool.direction).normalize();
    let away = Vector3::from(target_mm) - Vector3::from(start.scene.tool.burr_start_mm);
    let ahead_mm = away.dot(&along);
    Some([ahead_mm, (away - along * ahead_mm).norm(), length_mm])
}

pub(super) fn target_out_of_reach(start: &Start) -> Option<String> {
    let [ahead_mm, beside_mm, length_mm] = target_mm(start)?;
    let flexible_mm = start.flexible_mm();
    if ahead_mm < -BEHIND_MM {
        let behind_mm = -ahead_mm;
        return Some(format!(
            "is {behind_mm:.1} mm behind the start; allowed: 0 to {length_mm} mm ahead (`insertion_mm`)"
        ));
    }
    if ahead_mm > length_mm + BEYOND_MM {
        return Some(format!(
            "is {ahead_mm:.1} mm ahead of the start; allowed: 0 to {length_mm} mm (`insertion_mm`)"
        ));
    }
    (beside_mm > flexible_mm).then(|| {
        format!(
            "is {beside_mm:.1} mm off the feed axis; allowed: 0 to {flexible_mm:.1} (the tool's \
                 flexible length)"
        )
    })
}

pub(super) fn run_shorter_than_plan(start: &Start) -> Option<String> {
    let run_s = start.scene.run.duration_s;
    let sweeps = start.scene.controller.iter().filter_map(|controller| controller.tension_sweep.as_ref());
    let mut plans = start
        .feeds()
        .map(|feed| (feed.table, feed.time_s))
        .chain(sweeps.map(|sweep| ("controller.tension_sweep", sweep.duration_s())));
    let (table, plan_s) = plans.find(|(_, plan_s)| *plan_s > run_s)?;
    Some(format!("is {run_s}, but `{table}` needs {plan_s:.1} s"))
}

pub(super) fn long_step_in_bone(start: &Start) -> Option<String> {
    let dt_ms = start.scene.run.dt_ms;
    (start.scene.volume.is_some() && dt_ms > LONGEST_STEP_MS).then(|| {
        format!(
            "is {dt_ms}; expected at most {LONGEST_STEP_MS} in bone: longer steps change the drilled \
                 path and make forces jump"
        )
    })
}

/// Checks the step with a pre-curved tool: near its Euler buckling load, the hybrid integrator is up to 0.75
/// mm off; linearly implicit Euler is not.
pub(super) fn long_step_of_pre_curved_tool(start: &Start) -> Option<String> {
    let (tool, dt_ms) = (start.simulation.manipulator.parameters(), start.scene.run.dt_ms);
    let is_pre_curved = tool.joint_rest_rad.iter().any(|rest_rad| *rest_rad != 0.0);
    (is_pre_curved && tool.integrator == Integrator::Hybrid && dt_ms > LONGEST_STEP_MS).then(|| {
        format!(
            "is hybrid with a pre-curved tool at `run.dt_ms` = {dt_ms}, expected at most {LONGEST_STEP_MS} \
             ms or linearly_implicit_euler: near its buckling load the tool would end up in a wrong place"
        )
    })
}

/// Checks the modal model's tension: it cannot represent single flexures on their stops. Bending by the walls
/// in bone cannot be predicted here.
pub(super) fn modes_on_stops(start: &Start) -> Option<String> {
    let tool = &start.simulation.manipulator;
    if tool.rung() != Rung::Modal {
        return None;
    }
    let least_n = tool.parameters().first_stop_n()?;
    let pulls = start.scene.controller.iter().filter(|entry| entry.drives.contains(&Drives::Tendon));
    let most_n = pulls.map(most_tension_n).fold(0.0, f64::max);
    (most_n > least_n).then(|| {
        let asked = if most_n.is_finite() { format!("up to {most_n} N") } else { "any tension".to_owned() };
        format!(
            "is modal, which is not valid once single flexures reach their stops: above {least_n:.1} N at \
             rest in free space, and the controllers can command {asked}; use planar, or less tension"
        )
    })
}

/// Returns the largest tension that a controller can command, N; infinite if the scene does not limit it.
fn most_tension_n(entry: &Controller) -> f64 {
    let drilling = entry.curved_drilling.as_ref().filter(|drilling| drilling.feedback == Feedback::None);
    let drilled_n = drilling.and_then(|drilling| drilling.tension_n);
    let held_n = entry.hold.as_ref().map(|hold| hold.tension_n);
    let skived_n = entry.skiving.as_ref().map(|skiving| skiving.tension_n);
    let swept_n = entry.tension_sweep.as_ref().and_then(|sweep| sweep.most_n);
    drilled_n.or(held_n).or(skived_n).or(swept_n).unwrap_or(f64::INFINITY)
}

pub(super) fn frame_rate_is_rounded(start: &Start) -> Option<String> {
    let (rate_hz, ticks) = (start.scene.drr.as_ref()?.rate_hz, start.scene.frame_period_ticks()?);
    let real_hz = 1.0 / (ticks as f64 * start.scene.dt_s());
    ((real_hz - rate_hz).abs() > SAME_RATE * rate_hz).then(|| {
        format!(
            "is {rate_hz}, but a frame every {ticks} ticks of {} ms is {real_hz:.3} Hz",
            start.scene.run.dt_ms
        )
    })
}
