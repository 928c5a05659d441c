//! Latching: decides u_k, the commands in effect at tick k.
//!
//! Pure: the result depends only on which commands were offered and in which order. A controller's newest
//! valid command is held; once it answers a state more than `hold_ticks` old, or the controller is released,
//! the safe command replaces it.

use messages::{
    ArmMode, BurrMode, Command, CommandSource, ControllerIndex, Latched, LatchedCommand, MAX_CONTROLLERS,
    Reset, Tick, TubeMode,
};
use scene::{Drives, Mode, Scene};

use crate::command_check::{CommandRefusal, check};

/// All controllers' newest commands, and the decision of the last latch.
#[derive(Debug, Clone)]
pub struct Latch {
    slots: Vec<Slot>,
    hold_ticks: Option<u64>,
}

#[derive(Debug, Clone)]
struct Slot {
    drives: Vec<Drives>,
    newest: Option<Command>,
    /// Sequence number of the newest accepted command on this connection.
    last_sequence: u64,
    last_state_tick: Tick,
    /// The newest command has not been latched yet.
    fresh: bool,
    /// Replaced by the safe command until the next one: see [`Latch::release`].
    released: bool,
    source: CommandSource,
}

impl Latch {
    /// Creates a latch for the scene's controllers. In lockstep no command is late, so the safe command never
    /// replaces one because of its age.
    pub fn new(scene: &Scene) -> Latch {
        let slot = |drives: &Vec<Drives>| Slot {
            drives: drives.clone(),
            newest: None,
            last_sequence: 0,
            last_state_tick: Tick::START,
            fresh: false,
            released: false,
            source: CommandSource::None,
        };
        Latch {
            slots: scene.controller.iter().map(|controller| slot(&controller.drives)).collect(),
            hold_ticks: (scene.run.mode == Mode::Realtime).then_some(scene.run.hold_ticks),
        }
    }

    /// Accepts a controller's command if it is valid; `tick` is that of the newest state.
    ///
    /// # Errors
    /// The [`CommandRefusal`]; the latch is then unchanged.
    pub fn offer(
        &mut self,
        controller: ControllerIndex,
        command: &Command,
        tick: Tick,
    ) -> Result<(), CommandRefusal> {
        self.check(controller, command, tick)?;
        let slot = &mut self.slots[controller.slot()];
        slot.last_sequence = command.sequence;
        slot.last_state_tick = Tick(command.state_tick);
        slot.newest = Some(*command);
        slot.fresh = true;
        slot.released = false;
        Ok(())
    }

    /// Checks a controller's command; `tick` is that of the newest state.
    ///
    /// # Errors
    /// The reason why [`Latch::offer`] would refuse it.
    pub fn check(
        &self,
        controller: ControllerIndex,
        command: &Command,
        tick: Tick,
    ) -> Result<(), CommandRefusal> {
        let slot = &self.slots[controller.slot()];
        let (state_tick, last) = (Tick(command.state_tick), slot.last_state_tick);
        if state_tick < last {
            return Err(CommandRefusal::PastState { state_tick, last });
        }
        check(command, &slot.drives, slot.last_sequence, tick)
    }

    /// Registers that a controller has reconnected and restarts its sequence numbers. Its last command stays
    /// in effect until its next one.
    pub fn connect(&mut self, controller: ControllerIndex) {
        let slot = &mut self.slots[controller.slot()];
        (slot.last_sequence, slot.last_state_tick) = (0, Tick::START);
    }

    /// Replaces a controller's command with the safe one, until its next command.
    pub fn release(&mut self, controller: ControllerIndex) {
        self.slots[controller.slot()].released = true;
    }

    /// Returns whether a controller has been released and has sent no command since.
    pub fn is_released(&self, controller: ControllerIndex) -> bool {
        self.slots[controller.slot()].released
    }

    /// Returns whether a controller's newest command answers the state of this tick.
    pub fn has_answer(&self, controller: ControllerIndex, tick: Tick) -> bool {
        self.slots[controller.slot()].newest.is_some_and(|command| command.state_tick == tick.0)
    }

    /// Returns whether any command of a controller has been accepted.
    pub fn has_command(&self, controller: ControllerIndex) -> bool {
        self.slots[controller.slot()].newest.is_some()
    }

    /// Returns the source that the last [`Latch::latch`] chose for a controller.
    pub fn source(&self, controller: ControllerIndex) -> CommandSource {
        self.slots[controller.slot()].source
    }

    /// Decides u_k for tick k.
    pub fn latch(&mut self, tick: Tick, reset: Reset) -> Latched {
        let mut latched = Latched {
            tick: tick.0,
            controller_count: self.slots.len().min(MAX_CONTROLLERS) as u32,
            reset: reset.code(),
            ..Latched::zeroed()
        };
        for (index, (slot, entry)) in self.slots.iter_mut().zip(&mut latched.commands).enumerate() {
            *entry = slot.latch(tick, self.hold_ticks);
            entry.controller_index = index as u32;
        }
        latched
    }
}

impl Slot {
    fn latch(&mut self, tick: Tick, hold_ticks: Option<u64>) -> LatchedCommand {
        let Some(command) = self.newest else {
            self.source = CommandSource::None;
            return LatchedCommand::zeroed();
        };
        let age_ticks = tick.since(Tick(command.state_tick));
        let late = self.released || hold_ticks.is_some_and(|limit| age_ticks > limit);
        let fresh = std::mem::take(&mut self.fresh);
        let (source, command) = match (late, fresh) {
            (true, _) => (CommandSource::Safe, self.safe_command(&command)),
            (false, true) => (CommandSource::Fresh, command),
            (false, false) => (CommandSource::Held, command),
        };
        self.source = source;
        LatchedCommand { source: source.code(), controller_index: 0, age_ticks, command }
    }

    /// Returns the safe command: burr off, arm and tube stopped, tension held at its current value; only for
    /// the parts that the controller drives. The plant ends the rates of tendons and the wrench on a body.
    fn safe_command(&self, last: &Command) -> Command {
        let mut safe = Command { sequence: last.sequence, state_tick: last.state_tick, ..Command::zeroed() };
        if self.drives.contains(&Drives::Burr) {
            safe.burr_mode = BurrMode::Speed.code();
        }
        if self.drives.contains(&Drives::Arm) {
            safe.arm_mode = ArmMode::Hold.code();
        }
        if self.drives.contains(&Drives::Tube) {
            safe.tube_mode = TubeMode::Hold.code();
        }
        safe
    }
}
