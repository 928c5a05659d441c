//! Rules for the end of a run: every ending has a reason.

use hub::{ControllerFault, HubError};
use messages::{Blame, EventCode, Part};
use scene::Mode;

use super::Oracle;
use crate::plan::MS;

/// Longest time from the request to end to the end, without the time that the hub was stopped: consumers may
/// take half a second.
const END_LIMIT_NS: u64 = 700 * MS;

impl Oracle {
    /// Checks that the end reported by the hub is justified.
    pub fn ended(&mut self, now_ns: u64) {
        expect!(self, self.ended, "over without the phase `ended`".to_owned());
        let reason = self.tick == self.plan.tick_count || self.stopped || self.end_ns.is_some();
        expect!(self, reason, format!("over at tick {} without a reason", self.tick));
        if let Some(end_ns) = self.end_ns {
            let after_ns = now_ns.saturating_sub(end_ns + self.stopped_ns);
            expect!(self, after_ns < END_LIMIT_NS, format!("over {after_ns} ns after the request to end"));
            return;
        }
        for (part, here) in
            [(Part::Drr, self.plan.drr_ns.is_some()), (Part::Recorder, self.plan.recorder_ns.is_some())]
        {
            let taken = self.taken(part);
            expect!(self, !here || taken == Some(self.tick), {
                format!("over at tick {}, but {part} has taken {taken:?}", self.tick)
            });
        }
    }

    /// Checks that an early end has a reason.
    pub fn failed(&mut self, cause: &HubError<String, String>, now_ns: u64) {
        let lockstep = self.plan.mode == Mode::Lockstep;
        let justified = match cause {
            HubError::Environment(_) => false,
            HubError::Plant { tick, .. } => self.plant_fails && tick.0 == self.tick,
            HubError::NotConnected { part, .. } => {
                self.taken(*part).is_none() && now_ns - self.began_ns >= 60_000 * MS
            }
            HubError::Controller(ControllerFault::NotConnected { name, .. }) => {
                self.slot_of(name).is_some_and(|(slot, optional)| slot.newest.is_none() && !optional)
                    && !self.stopped
                    && self.has_waited(1000 * MS, now_ns)
            }
            HubError::Controller(ControllerFault::Silent { name, tick, .. }) => {
                let silent = self.slot_of(name).is_some_and(|(slot, optional)| {
                    !optional && slot.newest.is_none_or(|command| command.state_tick != tick.0)
                });
                lockstep
                    && silent
                    && tick.0 == self.tick
                    && !self.stopped
                    && self.has_waited(self.plan.controller_limit_ms * MS, now_ns)
            }
            HubError::ConsumerStuck { part, .. } => {
                self.taken(*part).is_none_or(|taken| taken < self.tick)
                    && self.has_waited(120_000 * MS, now_ns)
            }
        };
        expect!(self, justified, format!("ended early without a reason: {cause}"));
        if matches!(cause, HubError::Plant { .. } | HubError::Controller(_)) {
            let taken = self.taken(Part::Recorder);
            let is_whole = self.plan.recorder_ns.is_none() || taken == Some(self.tick);
            expect!(self, is_whole || self.has_waited(2_000 * MS, now_ns), {
                format!("failed at tick {}, but the recorder has taken {taken:?}; cause: {cause}", self.tick)
            });
        }
        let reason = match cause {
            HubError::Controller(fault) => Some(fault.event()),
            HubError::Plant { .. } => Some(EventCode::SimulationFailed),
            _ => None,
        };
        let told = (self.ended, self.blamed, self.told);
        expect!(self, told == (reason.is_some(), reason, reason), {
            format!(
                "the phase `ended`, the stored reason and the code of the event are {told:?}; cause: {cause}"
            )
        });
    }

    /// Records that the hub stores a reason, which must happen before the end is announced.
    pub fn blame(&mut self, blame: &Blame) {
        expect!(self, !self.ended, "a reason after the end".to_owned());
        self.blamed = Some(blame.code);
    }
}
