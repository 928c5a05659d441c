//! The reference against which errors are measured, for the table that plans choose from and for `plan
//! --check`.
//!
//! It is the tool with its own flexures, six degrees of freedom each, `hybrid`, at half the run's time step.
//! It starts with the run and gets every u_k of the run, so that the error includes everything that drilling
//! accumulates.

use ipc_types::messages::{Latched, SOURCE_FRESH, SOURCE_HELD, State};
use ipc_types::scene::{Integrator, ManipulatorRung, Scene};
use simulation::{CtView, Simulation, SimulationError};

/// Reference steps per step of the run.
const SUBSTEPS: u64 = 2;

/// A simulation that follows a run's commands with the reference's settings.
pub struct Reference<'v> {
    simulation: Simulation<'v>,
}

impl<'v> Reference<'v> {
    /// Starts at the beginning of the run of `scene`.
    ///
    /// # Errors
    /// The scene is refused.
    pub fn new(scene: &Scene, ct: Option<CtView<'v>>) -> Result<Self, SimulationError> {
        Ok(Self { simulation: Simulation::new(&settings_of(scene), ct)? })
    }

    /// Follows one tick of the run.
    ///
    /// # Errors
    /// The step is refused.
    pub fn step(&mut self, latched: &Latched) -> Result<(), SimulationError> {
        for latched in refined(latched) {
            self.simulation.step(&latched)?;
        }
        Ok(())
    }

    /// Position of the burr, m.
    pub fn burr_m(&self) -> [f64; 3] {
        self.simulation.state().t_world_burr.position_m
    }

    /// Distance of the burr from its position in a state of the run, mm.
    pub fn distance_mm(&self, state: &State) -> f64 {
        let (a, b) = (self.burr_m(), &state.t_world_burr.position_m);
        a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt() * 1e3
    }
}

/// The scene with the reference's settings.
pub fn settings_of(scene: &Scene) -> Scene {
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
