//! Latching: deciding u_k, the commands that hold for tick k.
//!
//! Pure: what has been offered, in its order, decides. A controller's newest valid command holds; when it answers a
//! state that is more than `hold_ticks` old, or is waited for no longer, the safe command holds instead.

use messages::{
    ARM_HOLD, BURR_SPEED, Command, Latched, LatchedCommand, MAX_CONTROLLERS, SOURCE_FRESH, SOURCE_HELD,
    SOURCE_NONE, SOURCE_SAFE,
};
use scene::{Drives, Mode, Scene};

use crate::command_check::{CommandRefusal, check};

/// The commands of all controllers, and what is latched of them.
#[derive(Debug, Clone)]
pub struct Latch {
    slots: Vec<Slot>,
    hold_ticks: Option<u64>,
}

#[derive(Debug, Clone)]
struct Slot {
    drives: Vec<Drives>,
    newest: Option<Command>,
    /// Of the newest accepted command of this connection.
    last_sequence: u64,
    last_state_tick: u64,
    /// Not latched yet.
    fresh: bool,
    /// Nobody waits for it: see [`Latch::release`].
    released: bool,
    source: u32,
}

impl Latch {
    /// A latch for the scene's controllers. In lockstep nothing is late, so nothing is replaced by the safe command.
    pub fn new(scene: &Scene) -> Latch {
        let slot = |drives: &Vec<Drives>| Slot {
            drives: drives.clone(),
            newest: None,
            last_sequence: 0,
            last_state_tick: 0,
            fresh: false,
            released: false,
            source: SOURCE_NONE,
        };
        Latch {
            slots: scene.controller.iter().map(|controller| slot(&controller.drives)).collect(),
            hold_ticks: (scene.run.mode == Mode::Realtime).then_some(scene.run.hold_ticks),
        }
    }

    /// Takes a command of a controller if it is valid; the newest state is `tick`.
    ///
    /// # Errors
    /// The [`CommandRefusal`]; nothing has changed then.
    pub fn offer(&mut self, controller: usize, command: &Command, tick: u64) -> Result<(), CommandRefusal> {
        let slot = &mut self.slots[controller];
        let last = slot.last_state_tick;
        if command.state_tick < last {
            return Err(CommandRefusal::PastState { state_tick: command.state_tick, last });
        }
        check(command, &slot.drives, slot.last_sequence, tick)?;
        slot.last_sequence = command.sequence;
        slot.last_state_tick = command.state_tick;
        slot.newest = Some(*command);
        slot.fresh = true;
        slot.released = false;
        Ok(())
    }

    /// A controller has connected anew: it begins its numbers again. Until it commands, its last command acts on.
    pub fn connect(&mut self, controller: usize) {
        let slot = &mut self.slots[controller];
        (slot.last_sequence, slot.last_state_tick) = (0, 0);
    }

    /// Replaces a controller's command by the safe one, until its next command.
    pub fn release(&mut self, controller: usize) {
        self.slots[controller].released = true;
    }

    /// Whether a controller has been released and has not commanded since.
    pub fn is_released(&self, controller: usize) -> bool {
        self.slots[controller].released
    }

    /// Whether a controller's newest command answers the state of this tick.
    pub fn has_answer(&self, controller: usize, tick: u64) -> bool {
        self.slots[controller].newest.is_some_and(|command| command.state_tick == tick)
    }

    /// Whether any command of a controller has been accepted.
    pub fn has_command(&self, controller: usize) -> bool {
        self.slots[controller].newest.is_some()
    }

    /// What [`Latch::latch`] last decided for a controller: one of the `SOURCE_` constants.
    pub fn source(&self, controller: usize) -> u32 {
        self.slots[controller].source
    }

    /// Decides u_k for tick k.
    pub fn latch(&mut self, tick: u64, reset: bool) -> Latched {
        let mut latched = Latched {
            tick,
            controller_count: self.slots.len().min(MAX_CONTROLLERS) as u32,
            reset: u32::from(reset),
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
    fn latch(&mut self, tick: u64, hold_ticks: Option<u64>) -> LatchedCommand {
        let Some(command) = self.newest else {
            self.source = SOURCE_NONE;
            return LatchedCommand::zeroed();
        };
        let age_ticks = tick.saturating_sub(command.state_tick);
        let late = self.released || hold_ticks.is_some_and(|limit| age_ticks > limit);
        let fresh = std::mem::take(&mut self.fresh);
        let (source, command) = match (late, fresh) {
            (true, _) => (SOURCE_SAFE, self.safe_command(&command)),
            (false, true) => (SOURCE_FRESH, command),
            (false, false) => (SOURCE_HELD, command),
        };
        self.source = source;
        LatchedCommand { source, controller_index: 0, age_ticks, command }
    }

    /// Burr off, arm stopped, tension as it is; of these, what the controller drives.
    fn safe_command(&self, last: &Command) -> Command {
        let mut safe = Command { sequence: last.sequence, state_tick: last.state_tick, ..Command::zeroed() };
        if self.drives.contains(&Drives::Burr) {
            safe.burr_mode = BURR_SPEED;
        }
        if self.drives.contains(&Drives::Arm) {
            safe.arm_mode = ARM_HOLD;
        }
        safe
    }
}
