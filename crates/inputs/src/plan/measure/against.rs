//! Runs a scene in this process next to the reference, with the same commands.

use std::time::Instant;

use controllers::built_in;
use hub::in_process::{Answer, InProcess};
use ipc_types::messages::{Latched, MAX_TENDONS, TendonMode};
use ipc_types::scene::Scene;
use nalgebra::Vector3;
use simulation::{CtView, Simulation};
use zerocopy::IntoBytes;

use crate::failure::Failure;
use crate::plan::reference::{Reference, settings_of};

/// Samples of the burr per simulated second.
const SAMPLES_PER_S: f64 = 100.0;
/// Shortest run whose path error counts, s.
const SHORTEST_S: f64 = 0.1;

/// A run to compare.
#[derive(Debug, Clone, Copy)]
pub struct Run<'a> {
    /// Its scene.
    pub scene: &'a Scene,
    /// The scene's volume.
    pub ct: Option<CtView<'a>>,
    /// Tensions commanded from the first tick by a controller that is not built in, N.
    pub tensions_n: [f64; MAX_TENDONS],
}

impl<'a> Run<'a> {
    /// A run of built-in controllers.
    pub fn new(scene: &'a Scene, ct: Option<CtView<'a>>) -> Run<'a> {
        Run { scene, ct, tensions_n: [0.0; MAX_TENDONS] }
    }
}

/// Why a comparison gave no result.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ComparisonError {
    /// The physics refuses the scene or a step.
    #[error("{0}")]
    Run(String),
    /// The reference refuses the scene or a step.
    #[error("the reference (`full`, own flexures): {0}")]
    Reference(String),
}

impl From<ComparisonError> for Failure {
    fn from(cause: ComparisonError) -> Failure {
        Failure::failed(cause)
    }
}

/// Error of a run, and its cost.
#[derive(Debug, Clone)]
pub struct ReferenceComparison {
    /// Path error, r.m.s. over the run.
    pub path_mm: f64,
    /// Largest path error, r.m.s., over all shorter runs, excluding the first 0.1 s.
    pub worst_path_mm: f64,
    /// Distance at the end.
    pub end_mm: f64,
    /// Median time of a step, µs per simulated millisecond.
    pub us_per_ms: f64,
    /// The burr at every sample, m.
    pub burr_m: Vec<Vector3<f64>>,
    /// The reference's burr at every sample, m.
    pub reference_m: Vec<Vector3<f64>>,
}

/// Running root mean square of distances.
#[derive(Default)]
struct Mean {
    squares: f64,
    count: u64,
}

impl Mean {
    fn add(&mut self, distance_mm: f64) -> f64 {
        self.squares += distance_mm * distance_mm;
        self.count += 1;
        (self.squares / self.count as f64).sqrt()
    }
}

fn said(scene: &Scene, cause: &dyn core::fmt::Display) -> String {
    format!("scene `{}`: {cause}", scene.name)
}

/// Runs a scene's controllers and calls `see` after every tick with the run, u_k and the step time, ns.
fn play(run: &Run, mut see: impl FnMut(&Simulation, &Latched, u64)) -> Result<(), ComparisonError> {
    let Run { scene, ct, tensions_n } = *run;
    let failed = |cause: &dyn core::fmt::Display| ComparisonError::Run(said(scene, cause));
    let simulation = Simulation::new(scene, ct).map_err(|cause| failed(&cause))?;
    let mut run = InProcess::new(scene, simulation);
    let mut controllers = Vec::new();
    for entry in &scene.controller {
        let built_in = built_in(scene, &entry.name, &ipc_types::text_file::read);
        controllers.push(built_in.map_err(|cause| failed(&cause))?);
    }
    for _ in 0..scene.tick_count() {
        let latched = run.latch(|index, state, command| {
            match &mut controllers[index.slot()] {
                Some(controller) => controller.step(state, command),
                None => {
                    command.tendon_mode = TendonMode::ServoJf.code();
                    command.tendon_force_n = tensions_n;
                }
            }
            Answer::Command
        });
        let latched = latched.map_err(|cause| failed(&cause))?;
        let began = Instant::now();
        run.step(&latched).map_err(|cause| failed(&cause))?;
        see(run.plant(), &latched, began.elapsed().as_nanos() as u64);
    }
    Ok(())
}

/// Ticks between samples of the burr.
fn every(scene: &Scene) -> u64 {
    ((1.0 / (SAMPLES_PER_S * scene.dt_s()) + 0.5) as u64).max(1)
}

fn median(mut nanoseconds: Vec<u64>, dt_ms: f64) -> f64 {
    nanoseconds.sort_unstable();
    let median = nanoseconds.get(nanoseconds.len() / 2).copied().unwrap_or(0);
    median as f64 * 1e-3 / dt_ms
}

/// Paths of the reference, shared by settings with the same time step: without feedback they all latch the
/// same u_k.
#[derive(Default)]
pub struct References {
    known: Vec<Known>,
}

struct Known {
    scene: Scene,
    latched: Vec<Latched>,
    burr_m: Vec<Vector3<f64>>,
}

impl References {
    /// The reference's burr after each tick. Reuses a known path for the same settings and the same u_k; all
    /// requests to one value use the same voxels.
    fn burr_m(
        &mut self,
        scene: &Scene,
        ct: Option<CtView>,
        latched: Vec<Latched>,
    ) -> Result<&[Vector3<f64>], ComparisonError> {
        let settings = settings_of(scene);
        let same = |known: &Known| known.scene == settings && known.latched.as_bytes() == latched.as_bytes();
        let place = match self.known.iter().position(same) {
            Some(place) => place,
            None => {
                let refused =
                    |cause: simulation::SimulationError| ComparisonError::Reference(said(scene, &cause));
                let mut reference = Reference::new(scene, ct).map_err(refused)?;
                let mut burr_m = Vec::new();
                for latched in &latched {
                    reference.step(latched).map_err(refused)?;
                    burr_m.push(Vector3::from(reference.burr_m()));
                }
                self.known.push(Known { scene: settings, latched, burr_m });
                self.known.len() - 1
            }
        };
        Ok(&self.known[place].burr_m)
    }
}

/// Runs a scene and the reference with the same commands, on the same voxels.
///
/// # Errors
/// The physics refuses the scene or a step.
pub fn against_reference(
    run: &Run,
    references: &mut References,
) -> Result<ReferenceComparison, ComparisonError> {
    let Run { scene, ct, .. } = *run;
    let (mut all, mut own, mut nanoseconds) = (Vec::new(), Vec::new(), Vec::new());
    play(run, |run, latched, step_ns| {
        nanoseconds.push(step_ns);
        all.push(*latched);
        own.push(Vector3::from(run.state().t_world_burr.position_m));
    })?;
    let reference = references.burr_m(scene, ct, all)?;
    let (mut mean, us_per_ms) = (Mean::default(), median(nanoseconds, scene.run.dt_ms));
    let mut compared = ReferenceComparison {
        path_mm: 0.0,
        worst_path_mm: 0.0,
        end_mm: 0.0,
        us_per_ms,
        burr_m: Vec::new(),
        reference_m: Vec::new(),
    };
    for (tick, (own, reference)) in
        (1..).zip(own.iter().zip(reference)).filter(|(tick, _)| tick % every(scene) == 0)
    {
        compared.burr_m.push(*own);
        compared.reference_m.push(*reference);
        compared.end_mm = (own - reference).norm() * 1e3;
        compared.path_mm = mean.add(compared.end_mm);
        if tick as f64 * scene.dt_s() >= SHORTEST_S - 1e-9 {
            // NaN must win.
            let is_lost = compared.path_mm.is_nan();
            let worst = compared.worst_path_mm.max(compared.path_mm);
            compared.worst_path_mm = if is_lost { f64::NAN } else { worst };
        }
    }
    Ok(compared)
}

/// The burr at every sample of a run, m, and the cost of a simulated millisecond, µs.
///
/// # Errors
/// The physics refuses the scene or a step.
pub fn path(run: &Run) -> Result<(Vec<Vector3<f64>>, f64), ComparisonError> {
    let scene = run.scene;
    let (every, mut path, mut nanoseconds) = (every(scene), Vec::new(), Vec::new());
    play(run, |run, latched, step_ns| {
        nanoseconds.push(step_ns);
        if (latched.tick + 1).is_multiple_of(every) {
            path.push(Vector3::from(run.state().t_world_burr.position_m));
        }
    })?;
    Ok((path, median(nanoseconds, scene.run.dt_ms)))
}

/// Root mean square of the distance between two paths, mm; NaN if they cannot be compared.
pub fn distance_mm(path: &[Vector3<f64>], other: &[Vector3<f64>]) -> f64 {
    if path.len() != other.len() || path.is_empty() {
        return f64::NAN;
    }
    let squares: f64 = path.iter().zip(other).map(|(a, b)| (a - b).norm_squared()).sum();
    (squares / path.len() as f64).sqrt() * 1e3
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_distance_of_paths_is_the_root_mean_square() {
        let path = [Vector3::zeros(), Vector3::x() * 4e-3];
        let other = [Vector3::y() * 3e-3, Vector3::x() * 4e-3 + Vector3::z() * 3e-3];
        assert!((distance_mm(&path, &other) - 3.0).abs() < 1e-12);
        assert!(distance_mm(&path, &other[..1]).is_nan() && distance_mm(&[], &[]).is_nan());
    }
}
