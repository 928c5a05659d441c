//! Lockstep in one thread, without processes: controllers answer each state as function calls, and the plant
//! steps.

use messages::{Command, CommandSource, ControllerIndex, Latched, LatchedCommand, Plant, Reset, State, Tick};
use scene::{Mode, Scene};
use thiserror::Error;

use crate::command_check::CommandRefusal;
use crate::latch::Latch;

/// How a controller answers a state.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Answer {
    /// Send the command that it filled in.
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
    commands: Commands,
}

/// The controllers' commands: all of a run's state except the plant's.
#[derive(Debug, Clone)]
pub struct Commands {
    latch: Latch,
    /// Each controller's last sequence number.
    sequences: Vec<u64>,
}

impl<P: Plant> InProcess<P> {
    /// Creates a run of the scene's controllers with this plant. Always lockstep, whatever mode the scene
    /// sets.
    pub fn new(scene: &Scene, plant: P) -> InProcess<P> {
        let sequences = vec![0; scene.controller.len()];
        let mut scene = scene.clone();
        scene.run.mode = Mode::Lockstep;
        InProcess { plant, commands: Commands { latch: Latch::new(&scene), sequences } }
    }

    /// Returns the plant.
    pub fn plant(&self) -> &P {
        &self.plant
    }

    /// Returns the plant, to publish its steps or to move it to another state.
    pub fn plant_mut(&mut self) -> &mut P {
        &mut self.plant
    }

    /// Returns the controllers' commands; a copy of them and the plant's state suffice to return here later.
    pub fn commands(&self) -> &Commands {
        &self.commands
    }

    /// Continues from these commands, which must come from a run of the same scene.
    pub fn restore_commands(&mut self, commands: &Commands) {
        self.commands.clone_from(commands);
    }

    /// Checks a controller's command as [`InProcess::latch`] would, without changing anything.
    ///
    /// # Errors
    /// The reason why it would be refused.
    pub fn check(&self, controller: ControllerIndex, command: &Command) -> Result<(), CommandRefusal> {
        let tick = self.plant.state().tick;
        let command = Command { sequence: self.commands.next(controller), state_tick: tick, ..*command };
        self.commands.latch.check(controller, &command, Tick(tick))
    }

    /// Latches u_k. Calls `answer` once per controller of the scene, with the controller's index, x_k, and a
    /// command that has `sequence` and `state_tick` filled in and every mode at "none".
    ///
    /// # Errors
    /// [`InProcessError::Refused`].
    pub fn latch(
        &mut self,
        mut answer: impl FnMut(ControllerIndex, &State, &mut Command) -> Answer,
    ) -> Result<Latched, InProcessError<P::Error>> {
        let state = self.plant.state();
        let tick = Tick(state.tick);
        for controller in ControllerIndex::first(self.commands.sequences.len()) {
            let sequence = self.commands.next(controller);
            let mut command = Command { sequence, state_tick: tick.0, ..Command::zeroed() };
            if answer(controller, state, &mut command) == Answer::Command {
                let offered = self.commands.offer(controller, &command, tick);
                offered.map_err(|cause| InProcessError::Refused { controller, tick, cause })?;
            }
        }
        Ok(self.commands.latch.latch(tick, Reset::No))
    }

    /// Adopts the commands that a log's tick latched, so that the run can continue after it; the caller steps
    /// the plant with them.
    pub fn follow(&mut self, latched: &Latched) {
        for (controller, entry) in
            ControllerIndex::first(self.commands.sequences.len()).zip(&latched.commands)
        {
            self.commands.follow(controller, entry);
        }
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

impl Commands {
    fn next(&self, controller: ControllerIndex) -> u64 {
        self.sequences[controller.slot()] + 1
    }

    fn offer(
        &mut self,
        controller: ControllerIndex,
        command: &Command,
        tick: Tick,
    ) -> Result<(), CommandRefusal> {
        self.latch.offer(controller, command, tick)?;
        self.sequences[controller.slot()] = command.sequence;
        Ok(())
    }

    fn follow(&mut self, controller: ControllerIndex, entry: &LatchedCommand) {
        let (command, sequence) = (&entry.command, &mut self.sequences[controller.slot()]);
        *sequence = command.sequence.max(*sequence);
        let tick = Tick(command.state_tick);
        if entry.source() == Ok(CommandSource::Fresh) && self.latch.offer(controller, command, tick).is_err()
        {
            // A controller that reconnected restarted its sequence numbers.
            self.latch.connect(controller);
            // The log's own commands are valid; if not, the states will differ, which is detected.
            let _ = self.offer(controller, command, tick);
        }
    }
}
