//! Cautions about likely problems of a completed run, for the final table and `summary.json`.

use super::outcome::findings;
use super::run_lane::RunLane;
use super::timing_lane::TimingLane;
use crate::plan::ModelError;

/// Returns the cautions of a run, one line each.
pub(super) fn cautions(run: &RunLane, timing: &TimingLane) -> Vec<String> {
    let first = [timing.fifo_refused.clone(), refused(timing)];
    let scene = run.scene.as_ref();
    let found = scene.map(|scene| findings(scene, &run.course)).unwrap_or_default();
    let model = scene.and_then(ModelError::of).map(|error| error.to_string());
    first.into_iter().flatten().chain(found).chain(model).collect()
}

fn refused(timing: &TimingLane) -> Option<String> {
    let (refused, sent) = (timing.refused_commands, timing.commands);
    let share = 100.0 * (refused as f64 / sent.max(1) as f64).min(1.0);
    (refused > 0).then(|| format!("{refused} of {sent} commands rejected ({share:.1} %)"))
}
