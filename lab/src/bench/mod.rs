//! Benchmarks of the hub, printed as tables or figures. Times depend on the machine, so nothing here asserts
//! one.

pub mod bridge;
mod callgrind;
pub mod drr;
pub mod drr_batch;
mod drr_layers;
pub mod drr_poses;
mod growth;
pub mod instructions;
pub mod latency;
pub mod lateness;
pub mod log;
pub mod memory;
mod outside;
pub mod overhead;
pub mod ping_pong;
pub mod readings;
pub mod recorder;
pub mod samples;
pub mod soak;
pub mod start;
pub mod step;
pub mod tools;
mod turning;
pub mod viewer;
pub mod xray;

use ipc_types::process::EndRequest;
use ipc_types::scene::Scene;

use trabecula::failure::Failure;
use trabecula::launcher::run::{Outcome, RunPlan, RunResult, RunSnapshot, run as run_scene};

/// Wraps an error that ends a measurement.
fn failed(cause: impl ToString) -> Failure {
    Failure::failed(cause.to_string())
}

/// Runs a scene with all its processes; a run that does not complete is an error.
fn complete_run(
    plan: &RunPlan,
    end: &EndRequest,
    show: impl FnMut(&RunSnapshot),
) -> Result<RunResult, Failure> {
    let result = run_scene(plan, end, show).map_err(failed)?;
    match &result.outcome {
        Outcome::Completed => Ok(result),
        Outcome::Stopped
        | Outcome::Interrupted
        | Outcome::LogGone(_)
        | Outcome::ControllerFailed(_)
        | Outcome::SimulationFailed(_) => Err(Failure::failed(result.outcome.text())),
        Outcome::PartDied { name, how, last_words } => {
            Err(Failure::failed(format!("part `{name}` died ({how}): {}", last_words.join("; "))))
        }
    }
}

/// Limits a scene to a number of ticks.
fn cut(scene: &mut Scene, ticks: Option<u64>) {
    let ticks = ticks.map_or(scene.tick_count(), |most| most.clamp(1, scene.tick_count()));
    scene.run.duration_s = ticks as f64 * scene.dt_s();
}
