//! Measures the error that a run actually made, by re-running its commands on the reference rung.
//!
//! The reference is the tool with its own flexures, six degrees of freedom each, `hybrid`, at half the step. It starts
//! where the log starts and gets every u_k of the log, so that the error includes everything that drilling
//! accumulates; the tip is compared at a sample of the ticks.

use std::path::Path;
use std::time::Instant;

use ipc_types::messages::{Latched, SOURCE_FRESH, SOURCE_HELD, State};
use ipc_types::scene::{Integrator, ManipulatorRung, Scene};
use simulation::{CtView, Simulation, ct_geometry};

use crate::failure::Failure;
use crate::launcher::volume_source;
use crate::replay::{OpenedLog, Overrides};

/// Reference steps per step of the run.
const SUBSTEPS: u64 = 2;

/// Result of the check.
#[derive(Debug, Clone, PartialEq)]
pub struct Found {
    /// Ticks compared.
    pub samples: usize,
    /// Last tick re-run.
    pub last_tick: u64,
    /// Root mean square of the tip distance, mm.
    pub rms_mm: f64,
    /// Largest tip distance, mm, and its tick.
    pub largest: (f64, u64),
    /// Tip distance at the last tick, mm.
    pub end_mm: f64,
    /// Wall time, s.
    pub wall_s: f64,
}

/// Re-runs a log up to tick `to` and compares the tip at about `samples` ticks.
///
/// # Errors
/// Bad input (2): a log that this build cannot replay, or one without ticks. The reference refuses the scene (1).
pub fn check(log: &Path, overrides: &Overrides, samples: u64, to: u64) -> Result<(Scene, Found), Failure> {
    let log = OpenedLog::open(log, overrides)?;
    let ct = log.volume.as_ref().map(|(volume, hash)| {
        let message = volume_source::message(volume, *hash);
        CtView { geometry: ct_geometry(&message), hu: &volume.hu }
    });
    let failed = |cause: simulation::SimulationError| Failure::failed(cause.to_string());
    let mut reference = Simulation::new(&reference_scene(&log.scene), ct).map_err(failed)?;
    let every = log.scene.tick_count().min(to).div_ceil(samples.max(1)).max(1);
    let mut found =
        Found { samples: 0, last_tick: 0, rms_mm: 0.0, largest: (0.0, 0), end_mm: 0.0, wall_s: 0.0 };
    let (began, mut squares) = (Instant::now(), 0.0);
    for record in log.reader()? {
        let record = record.map_err(|cause| Failure::failed(cause.to_string()))?;
        let tick = record.latched.tick + 1;
        if tick > to {
            break;
        }
        for latched in refined(&record.latched) {
            reference.step(&latched).map_err(failed)?;
        }
        found.last_tick = tick;
        found.end_mm = distance_mm(reference.state(), &record.state);
        if tick.is_multiple_of(every) {
            squares += found.end_mm * found.end_mm;
            found.samples += 1;
            if found.end_mm > found.largest.0 {
                found.largest = (found.end_mm, tick);
            }
        }
    }
    if found.samples == 0 {
        return Err(Failure::bad_input(format!("{}: has no complete tick to compare", log.path.display())));
    }
    found.rms_mm = (squares / found.samples as f64).sqrt();
    found.wall_s = began.elapsed().as_secs_f64();
    Ok((log.scene, found))
}

/// The scene with the reference's settings.
fn reference_scene(scene: &Scene) -> Scene {
    let mut scene = scene.clone();
    scene.manipulator.model = Some(ManipulatorRung::Full);
    scene.manipulator.links = None;
    scene.manipulator.integrator = Some(Integrator::Hybrid);
    scene.run.dt_ms /= SUBSTEPS as f64;
    scene
}

/// u_k for each of the reference's steps; the fresh flags are set only in the first.
fn refined(latched: &Latched) -> [Latched; SUBSTEPS as usize] {
    let mut steps = [*latched; SUBSTEPS as usize];
    for (place, step) in (0..).zip(&mut steps) {
        step.tick = latched.tick * SUBSTEPS + place;
        if place > 0 {
            step.reset = 0;
            for entry in step.commands.iter_mut().filter(|entry| entry.source == SOURCE_FRESH) {
                entry.source = SOURCE_HELD;
            }
        }
    }
    steps
}

fn distance_mm(a: &State, b: &State) -> f64 {
    let (a, b) = (&a.t_world_burr.position_m, &b.t_world_burr.position_m);
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt() * 1e3
}
