//! A controller's part of u_k: a latch kept in parallel to the hub's.

use hub::IncomingMessage;
use hub::rate_limit::Connection;
use messages::{ArmMode, BurrMode, Command, CommandSource, ControllerIndex, Latched, TubeMode};
use scene::{Drives, Mode};

use super::Oracle;
use crate::actors::Form;
use crate::plan::MS;

/// State of one controller.
#[derive(Debug, Default)]
pub(super) struct Slot {
    connection: Option<Connection>,
    pub(super) newest: Option<Command>,
    fresh: bool,
    released: bool,
    last_sequence: u64,
    last_state_tick: u64,
    /// Whether its first refusal must be, or has been, reported.
    refusal: Refusal,
}

/// Whether a controller's first refusal has been reported.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
enum Refusal {
    /// None of its commands has been refused.
    #[default]
    None,
    /// To be reported before anything else is taken, published or waited for.
    Due,
    Reported,
}

impl Oracle {
    /// Records that the hub takes a command.
    pub fn command(&mut self, index: ControllerIndex, incoming: &IncomingMessage<Command>, form: Form) {
        self.first_refusals_are_reported();
        let IncomingMessage::Message(command, connection) = incoming else {
            return self.refuses(index);
        };
        let slot = &mut self.controllers[index.slot()];
        if slot.connection != Some(*connection) {
            slot.connection = Some(*connection);
            (slot.last_sequence, slot.last_state_tick) = (0, 0);
        }
        let in_order = command.sequence > slot.last_sequence
            && command.state_tick >= slot.last_state_tick
            && command.state_tick <= self.tick;
        if !(form == Form::Whole && in_order) {
            return self.refuses(index);
        }
        (slot.last_sequence, slot.last_state_tick) = (command.sequence, command.state_tick);
        (slot.newest, slot.fresh, slot.released) = (Some(*command), true, false);
    }

    fn refuses(&mut self, index: ControllerIndex) {
        self.refused += 1;
        let refusal = &mut self.controllers[index.slot()].refusal;
        if *refusal == Refusal::None {
            *refusal = Refusal::Due;
        }
    }

    /// Records an event that reports a refused command.
    pub(super) fn refusal_is_reported(&mut self, text: &str) {
        let name = text.strip_prefix("controller `c").and_then(|rest| rest.split_once('`'));
        let slot = name.and_then(|(index, _)| self.controllers.get_mut(index.parse::<usize>().ok()?));
        // The plant refuses commands too: those that the latch accepted.
        if let Some(slot) = slot.filter(|slot| slot.refusal == Refusal::Due) {
            slot.refusal = Refusal::Reported;
        }
    }

    /// Checks that a controller's first refused command was reported at once: a run that waits for a valid
    /// one would otherwise be silent until its time is up.
    pub fn first_refusals_are_reported(&mut self) {
        let due = self.controllers.iter().position(|slot| slot.refusal == Refusal::Due);
        expect!(self, due.is_none(), format!("the first refusal of controller {due:?} is not reported"));
    }

    /// Checks a controller's part of u_k.
    pub(super) fn check_latched(&mut self, index: ControllerIndex, latched: &Latched, now_ns: u64) {
        let (tick, entry) = (latched.tick, latched.commands[index.slot()]);
        let said = entry.source();
        let (lockstep, optional) =
            (self.plan.mode == Mode::Lockstep, self.plan.controllers[index.slot()].optional);
        let waited = self.has_waited(self.plan.controller_limit_ms * MS, now_ns);
        let may_release = lockstep && optional && waited;
        let slot = &mut self.controllers[index.slot()];
        if said == Ok(CommandSource::Safe) && may_release {
            slot.released = true;
        }
        let (fresh, released) = (std::mem::take(&mut slot.fresh), slot.released);
        let Some(command) = slot.newest else {
            expect!(self, said == Ok(CommandSource::None) && (optional || !lockstep), {
                format!("tick {tick}, controller {index}: {entry:?} though it has sent no command")
            });
            return;
        };
        let age = tick - command.state_tick;
        let late = released || (!lockstep && age > self.plan.hold_ticks);
        let source = match (late, fresh) {
            (true, _) => CommandSource::Safe,
            (false, true) => CommandSource::Fresh,
            (false, false) => CommandSource::Held,
        };
        if lockstep && !released {
            expect!(self, fresh && age == 0, {
                format!("tick {tick}, controller {index}: lockstep ran it without an answer to x_{tick}")
            });
        }
        let expected = if late { safe(&command, &self.drives[index.slot()]) } else { command };
        let right = said == Ok(source) && entry.age_ticks == age && entry.command == expected;
        expect!(self, right, {
            format!(
                "tick {tick}, controller {index}: source {}, age {}, sequence {}; expected {source:?}, \
                 {age}, {}",
                entry.source, entry.age_ticks, entry.command.sequence, expected.sequence
            )
        });
    }

    pub(super) fn slot_of(&self, name: &str) -> Option<(&Slot, bool)> {
        let index: usize = name.strip_prefix('c')?.parse().ok()?;
        Some((self.controllers.get(index)?, self.plan.controllers.get(index)?.optional))
    }
}

/// Returns the safe command: burr off, arm and tube stopped, tension as it is; only for the parts that the
/// controller drives.
fn safe(last: &Command, drives: &[Drives]) -> Command {
    let mut safe = Command { sequence: last.sequence, state_tick: last.state_tick, ..Command::zeroed() };
    if drives.contains(&Drives::Burr) {
        safe.burr_mode = BurrMode::Speed.code();
    }
    if drives.contains(&Drives::Arm) {
        safe.arm_mode = ArmMode::Hold.code();
    }
    if drives.contains(&Drives::Tube) {
        safe.tube_mode = TubeMode::Hold.code();
    }
    safe
}
