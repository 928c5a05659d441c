//! Run control and run status.

use messages::{
    ControlAction, ControlStatus, EventCode, Phase, Plant, RunControl, RunControlReply, RunStatus, Severity,
};
use scene::Mode;

use super::{Hub, Outcome, POLL_NS, STATUS_PERIOD_NS, Stage, Step, WakeCondition, wait};
use crate::environment::{Environment, IncomingMessage, Note};
use crate::rate_limit::{Connection, LOOKED_AT};

/// Messages of the wrong length that one poll takes off the run-control queue.
const MALFORMED_AT_ONCE: usize = 64;

impl<P: Plant> Hub<P> {
    /// Executes run-control requests, rate-limited per program so that a flood cannot stall the tick.
    pub(super) fn obey<E: Environment>(&mut self, env: &mut E) -> Outcome<(), P, E> {
        let mut asked = false;
        for _ in 0..LOOKED_AT {
            let Some((request, connection)) = self.next_request(env)? else { break };
            if !self.control_limit.allows(connection, env.now_ns()) {
                self.refuse_control(env, "a program exceeds the rate limit")?;
                continue;
            }
            asked = true;
            let status = match request.action() {
                Ok(action) => self.obey_one(action, request.ticks),
                Err(_) => ControlStatus::Refused,
            };
            env.send_control_reply(&RunControlReply {
                request_id: request.request_id,
                tick: self.tick.0,
                action: request.action,
                status: status.code(),
            })?;
        }
        if let Some(more) = self.control_warnings.take_suppressed(|| env.now_ns()) {
            self.warn_of_control(env, &format!("{more} more requests"))?;
        }
        if asked { self.send_status(env, self.phase(), StatusTiming::Now) } else { Ok(()) }
    }

    /// Returns the next run-control request; skips messages of the wrong length.
    fn next_request<E: Environment>(
        &mut self,
        env: &mut E,
    ) -> Outcome<Option<(RunControl, Connection)>, P, E> {
        for _ in 0..MALFORMED_AT_ONCE {
            match env.receive_control()? {
                None => return Ok(None),
                Some(IncomingMessage::Message(request, connection)) => {
                    return Ok(Some((request, connection)));
                }
                Some(IncomingMessage::Malformed(reason)) => self.refuse_control(env, &reason)?,
            }
        }
        Ok(None)
    }

    fn refuse_control<E: Environment>(&mut self, env: &mut E, reason: &str) -> Outcome<(), P, E> {
        if !self.control_warnings.allows(env.now_ns()) {
            return Ok(());
        }
        self.warn_of_control(env, reason)
    }

    fn warn_of_control<E: Environment>(&self, env: &mut E, reason: &str) -> Outcome<(), P, E> {
        let text = format!("run control: {reason}; refused");
        Ok(env.send_event(&Note {
            tick: self.tick,
            severity: Severity::Warning,
            code: EventCode::RequestRefused,
            text: &text,
        })?)
    }

    fn obey_one(&mut self, action: ControlAction, ticks: u64) -> ControlStatus {
        match action {
            // Drops pending steps: the newest request wins.
            ControlAction::Pause => (self.paused, self.steps_left) = (true, 0),
            ControlAction::Resume => (self.paused, self.steps_left) = (false, 0),
            ControlAction::Step if self.paused => self.steps_left = self.steps_left.saturating_add(ticks),
            ControlAction::Step => return ControlStatus::Refused,
            ControlAction::Reset => self.reset_asked = true,
            ControlAction::Stop => self.stopped = true,
            // The recorder acts on the reply.
            ControlAction::Save if self.settings.keeps_ring => {}
            ControlAction::Save => return ControlStatus::Refused,
        }
        ControlStatus::Done
    }

    /// Polls again after a while, because the run is paused.
    pub(super) fn rest<E: Environment>(&mut self, env: &mut E) -> Outcome<Step, P, E> {
        self.send_status(env, Phase::Paused, StatusTiming::IfDue)?;
        env.deliver_state_history()?;
        self.collect_commands(env)?;
        Ok((Stage::Rested, wait(WakeCondition::Control, env.now_ns() + POLL_NS)))
    }

    pub(super) fn phase(&self) -> Phase {
        match (self.connected, self.paused) {
            (false, _) => Phase::Connecting,
            (true, true) => Phase::Paused,
            (true, false) => Phase::Running,
        }
    }

    /// Publishes the run's status.
    pub(super) fn send_status<E: Environment>(
        &mut self,
        env: &mut E,
        phase: Phase,
        when: StatusTiming,
    ) -> Outcome<(), P, E> {
        let now_ns = match when {
            StatusTiming::IfDueAt(now_ns) => now_ns,
            StatusTiming::Now | StatusTiming::IfDue => env.now_ns(),
        };
        let recent = |sent_ns: u64| now_ns.saturating_sub(sent_ns) < STATUS_PERIOD_NS;
        if when != StatusTiming::Now && self.status_sent_ns.is_some_and(recent) {
            return Ok(());
        }
        self.status_sent_ns = Some(now_ns);
        env.status_is_due();
        let foreign = self.consumers.new_foreign_reports(env);
        if foreign > 0 && self.control_warnings.allows(now_ns) {
            let text = format!(
                "progress: ignored {foreign} messages of a program that is neither the DRR process nor the \
                 recorder"
            );
            let (severity, code) = (Severity::Warning, EventCode::RequestRefused);
            env.send_event(&Note { tick: self.tick, severity, code, text: &text })?;
        }
        Ok(env.send_status(&RunStatus {
            tick: self.tick.0,
            tick_count: self.settings.tick_count,
            missed_ticks: self.schedule.missed(),
            refused_commands: self.refused_commands,
            removed_messages: self.lane.removed_messages(),
            phase: phase.code(),
            mode: u32::from(self.settings.mode == Mode::Realtime),
        })?)
    }

    pub(super) fn inform<E: Environment>(&self, env: &mut E, text: &str) -> Outcome<(), P, E> {
        Ok(env.send_event(&Note { tick: self.tick, severity: Severity::Info, code: EventCode::Run, text })?)
    }
}

/// When to send a status.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum StatusTiming {
    /// Immediately, because something has changed.
    Now,
    /// Only if the last one is old enough.
    IfDue,
    /// As `IfDue`, at this reading of the clock.
    IfDueAt(u64),
}
