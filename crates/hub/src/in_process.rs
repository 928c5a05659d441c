//! Lockstep in one thread, without processes: controllers answer each state as function calls, and the plant steps.

use messages::{Command, ControllerIndex, Latched, Plant, State, Tick};
use scene::{Mode, Scene};
use thiserror::Error;

use crate::command_check::CommandRefusal;
use crate::latch::{Latch, Reset};

/// How a controller answers a state.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Answer {
    /// Send the command it filled in.
    Command,
    /// Send nothing; its last command is held.
    Nothing,
}

/// Why a tick failed.
#[derive(Debug, Error)]
pub enum InProcessError<P> {
    /// A command is invalid.
    #[error("controller {controller}: command of tick {tick}: {cause}")]
    Refused {
        /// The controller.
        controller: ControllerIndex,
        /// Tick.
        tick: Tick,
        /// Reason.
        cause: CommandRefusal,
    },
    /// The plant rejected the tick.
    #[error("tick {tick}: {cause}")]
    Plant {
        /// Tick.
        tick: Tick,
        /// Reason from the plant.
        cause: P,
    },
}

/// A run in this thread.
///
/// ```
/// # use std::path::Path;
/// use hub::in_process::{Answer, InProcess};
/// # struct Still(messages::State);
/// # impl messages::Plant for Still {
/// #     type Error = String;
/// #     fn state(&self) -> &messages::State { &self.0 }
/// #     fn step(&mut self, _: &messages::Latched) -> Result<(), String> { self.0.tick += 1; Ok(()) }
/// #     fn removed(&self) -> &[u32] { &[] }
/// #     fn predrilled(&self) -> &[u32] { &[] }
/// #     fn refusals(&self) -> &[messages::Refusal] { &[] }
/// #     fn write_keyframe(&self, _: &mut [u8]) -> Result<usize, String> { Ok(0) }
/// #     fn restore_keyframe(&mut self, _: &[u8]) -> Result<(), String> { Ok(()) }
/// # }
/// # fn main() -> Result<(), Box<dyn std::error::Error>> {
/// # let text = "name = \"a\"\n[run]\nmode = \"lockstep\"\nduration_s = 1.0\n[tool]\nburr_start_mm = [0.0, 0.0, 0.0]\n\
/// #     direction = [0.0, 0.0, 1.0]\nbend_toward = [1.0, 0.0, 0.0]\n[[controller]]\nname = \"c\"\ndrives = [\"tendon\"]\n\
/// #     external = true\n";
/// # let scene = scene::Scene::parse(text, Path::new("scene.toml"))?;
/// # let plant = Still(messages::State::zeroed());
/// let mut run = InProcess::new(&scene, plant);
/// for _ in 0..10 {
///     run.tick(|_controller, state, command| {
///         command.tendon_mode = messages::TendonMode::ServoJf.code();
///         command.tendon_force_n[0] = 0.1 * state.tick as f64;
///         Answer::Command
///     })?;
/// }
/// # assert_eq!(messages::Plant::state(run.plant()).tick, 10);
/// # Ok(())
/// # }
/// ```
#[derive(Debug)]
pub struct InProcess<P> {
    plant: P,
    latch: Latch,
    controllers: usize,
}

impl<P: Plant> InProcess<P> {
    /// A run of the scene's controllers with this plant. Always lockstep, whatever mode the scene sets.
    pub fn new(scene: &Scene, plant: P) -> InProcess<P> {
        let controllers = scene.controller.len();
        let mut scene = scene.clone();
        scene.run.mode = Mode::Lockstep;
        InProcess { plant, latch: Latch::new(&scene), controllers }
    }

    /// The plant.
    pub fn plant(&self) -> &P {
        &self.plant
    }

    /// Latches u_k. Calls `answer` once per controller of the scene, with the controller's index, x_k, and a command that has `sequence`
    /// and `state_tick` filled in and every mode at "none".
    ///
    /// # Errors
    /// [`InProcessError::Refused`].
    pub fn latch(
        &mut self,
        mut answer: impl FnMut(ControllerIndex, &State, &mut Command) -> Answer,
    ) -> Result<Latched, InProcessError<P::Error>> {
        let state = self.plant.state();
        let tick = Tick(state.tick);
        for controller in ControllerIndex::first(self.controllers) {
            let mut command = Command { sequence: tick.0 + 1, state_tick: tick.0, ..Command::zeroed() };
            if answer(controller, state, &mut command) == Answer::Command {
                let offered = self.latch.offer(controller, &command, tick);
                offered.map_err(|cause| InProcessError::Refused { controller, tick, cause })?;
            }
        }
        Ok(self.latch.latch(tick, Reset::No))
    }

    /// Steps the plant from x_k to x_{k+1} under u_k.
    ///
    /// # Errors
    /// [`InProcessError::Plant`].
    pub fn step(&mut self, latched: &Latched) -> Result<(), InProcessError<P::Error>> {
        let cause = |cause| InProcessError::Plant { tick: Tick(latched.tick), cause };
        self.plant.step(latched).map_err(cause)?;
        self.plant.make_room();
        Ok(())
    }

    /// Runs one tick: [`latch`](InProcess::latch), then [`step`](InProcess::step).
    ///
    /// # Errors
    /// Any [`InProcessError`].
    pub fn tick(
        &mut self,
        answer: impl FnMut(ControllerIndex, &State, &mut Command) -> Answer,
    ) -> Result<(), InProcessError<P::Error>> {
        let latched = self.latch(answer)?;
        self.step(&latched)
    }
}
