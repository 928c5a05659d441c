//! Cautions about likely problems of a completed run, for the final table and `summary.json`.

use ipc_types::scene::{Drives, Scene};
use simulation::arm::ArmParameters;

use super::run_lane::RunLane;
use super::timing_lane::TimingLane;
use crate::plan::ModelError;

/// Converts the arm's rated payload to the force above which a normal force is reported.
const GRAVITY_M_PER_S2: f64 = 9.81;
/// Force that is reported if the arm has no rated payload, N: 1 mm2 of cortical bone bears 0.2 kN.
const NO_ARM_BEARS_N: f64 = 1000.0;
/// A tip that stays within this distance of its start has not moved.
const STILL_M: f64 = 1e-5;

/// Returns the cautions of a run, one line each.
pub(super) fn cautions(run: &RunLane, timing: &TimingLane) -> Vec<String> {
    let found = [
        timing.fifo_refused.clone(),
        refused(timing),
        force(run),
        energy(run),
        tip_at_rest(run),
        on_stops(run),
        run.scene.as_ref().and_then(ModelError::of).map(|error| error.to_string()),
    ];
    found.into_iter().flatten().collect()
}

fn refused(timing: &TimingLane) -> Option<String> {
    let (refused, sent) = (timing.refused_commands, timing.commands);
    let share = 100.0 * (refused as f64 / sent.max(1) as f64).min(1.0);
    (refused > 0).then(|| format!("{refused} of {sent} commands rejected ({share:.1} %)"))
}

fn force(run: &RunLane) -> Option<String> {
    let of_scene = |scene: &Scene| ArmParameters::of(&scene.arm, scene.dt_s());
    let arm = run.scene.as_ref().map_or_else(|| ArmParameters::ur5(1e-3), of_scene);
    let most_n = arm.payload_kg.map_or(NO_ARM_BEARS_N, |payload_kg| payload_kg * GRAVITY_M_PER_S2);
    let limit = if arm.payload_kg.is_some() { "the arm's payload" } else { "what bone or a small arm bears" };
    let drilling = &run.course.peaks.drilling;
    let (burr_n, contact_n) = (drilling.max_burr_force_n, drilling.max_contact_force_n);
    let (what, force_n) = if burr_n > most_n { ("burr", burr_n) } else { ("contact", contact_n) };
    (force_n > most_n).then(|| format!("{what} force reached {force_n:.1} N, above {limit}: {most_n:.1} N"))
}

fn energy(run: &RunLane) -> Option<String> {
    let created_mj = 1e3 * run.course.last.as_ref()?.energy_created_j;
    (created_mj > 0.0).then(|| {
        format!(
            "{created_mj:.3} mJ of energy created: not physical; use a shorter time step or a heavier tool"
        )
    })
}

fn tip_at_rest(run: &RunLane) -> Option<String> {
    let moves = |scene: &Scene| {
        let drives = scene.controller.iter().flat_map(|controller| &controller.drives);
        drives.into_iter().any(|part| matches!(part, Drives::Tendon | Drives::Arm | Drives::Tube))
    };
    let is_driven = run.scene.as_ref().is_some_and(moves);
    (run.course.ticks > 0 && is_driven && run.course.peaks.tip_travel_m < STILL_M).then(|| {
        format!("the tip never moved more than {:.4} mm from its start", run.course.peaks.tip_travel_m * 1e3)
    })
}

fn on_stops(run: &RunLane) -> Option<String> {
    let share = 100.0 * (run.course.peaks.ticks_on_stops as f64 / run.course.ticks.max(1) as f64).min(1.0);
    (run.course.peaks.ticks_on_stops > 0)
        .then(|| format!("the tool was at its stops in {share:.1} % of the ticks and could not bend further"))
}
