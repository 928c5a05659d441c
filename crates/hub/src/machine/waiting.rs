//! The waits of a tick: for its deadline, the controllers' answers, the consumers. Every wait has a limit,
//! does not count time spent stopped, and checks for the request to end.

use messages::{ControllerIndex, EventCode, Phase, Plant, Severity, Tick};
use scene::Mode;

use super::control::StatusTiming;
use super::{
    ABANDONED_LIMIT_NS, CONNECT_LOOK_NS, CONSUMER_LIMIT_NS, ControllerFault, Failure, Hub, HubError,
    NS_PER_S, Next, Outcome, REPORT_LOOK_NS, SILENT_WAIT_NS, Stage, Step, Wait, WakeCondition, wait,
};
use crate::consumers::ConsumerSet;
use crate::environment::{Environment, Note};
use crate::patience::ProcessTimeout;

impl<P: Plant> Hub<P> {
    /// Waits for the tick's deadline (real time).
    pub(super) fn await_deadline<E: Environment>(&mut self, env: &mut E) -> Outcome<Step, P, E> {
        if self.ends(env) {
            return Ok((Stage::TickDue, None));
        }
        let (woken_ns, deadline_ns) = (env.now_ns(), self.schedule.deadline_ns());
        if woken_ns < deadline_ns {
            return Ok((Stage::AwaitDeadline, wait(WakeCondition::Deadline, deadline_ns)));
        }
        self.collect_commands(env)?;
        let start_ns = env.now_ns();
        let start = self.schedule.begin(start_ns);
        self.timing.collect_ns = start_ns - woken_ns;
        env.tick_begins(start_ns, start, &mut self.timing);
        self.make_tick(env, start)
    }

    /// Keeps every consumer within the capacity of its queues: in lockstep all consumers; in real time the
    /// recorder, if `recording.on_full = "wait"`.
    pub(super) fn await_consumers<E: Environment>(
        &mut self,
        env: &mut E,
        tick: Tick,
        whom: ConsumerSet,
        mut patience: ProcessTimeout,
        began_ns: u64,
    ) -> Outcome<Step, P, E> {
        let Some(part) = self.consumers.still_behind(env, tick, whom)? else {
            return Ok((self.after_consumers(env.now_ns(), began_ns), None));
        };
        self.obey(env)?;
        if self.ends(env) || self.rests() {
            return Ok((Stage::TickDue, None));
        }
        if patience.is_over(env.now_ns()) {
            let limit_s = patience.limit_ns() / NS_PER_S;
            return Err(HubError::ConsumerStuck { part, tick: self.tick, limit_s });
        }
        self.send_status(env, self.phase(), StatusTiming::IfDue)?;
        env.wake_consumers();
        let until_ns = env.now_ns() + REPORT_LOOK_NS;
        let stage = Stage::ConsumersBehind { tick, whom, patience, began_ns };
        Ok((stage, wait(WakeCondition::Report, until_ns)))
    }

    /// Returns the next stage once no consumer is behind.
    pub(super) fn after_consumers(&mut self, now_ns: u64, began_ns: u64) -> Stage {
        match self.settings.mode {
            Mode::Realtime => {
                self.timing.recorder_wait_ns = now_ns.saturating_sub(began_ns);
                Stage::AwaitDeadline
            }
            Mode::Lockstep => {
                let patience = ProcessTimeout::new(self.settings.controller_limit_ns, now_ns);
                let notice = Some(ProcessTimeout::new(SILENT_WAIT_NS, now_ns));
                Stage::AwaitAnswers { patience, silent: None, notice }
            }
        }
    }

    /// Waits until every controller has answered x_k (lockstep).
    pub(super) fn await_answers<E: Environment>(
        &mut self,
        env: &mut E,
        mut patience: ProcessTimeout,
        silent: Option<ControllerIndex>,
        mut notice: Option<ProcessTimeout>,
    ) -> Outcome<Step, P, E> {
        // The first round uses the clock reading with which its patience began, and run control has just been
        // executed.
        let mut begun_ns = silent.is_none().then(|| patience.looked_ns());
        loop {
            self.collect_commands(env)?;
            let Some(silent) = self.unsettled() else {
                if self.ends(env) {
                    return Ok((Stage::TickDue, None));
                }
                return self.make_tick(env, crate::Start { lateness_ns: 0, missed: false });
            };
            let began_ns = begun_ns.take();
            if began_ns.is_none() {
                self.obey(env)?;
                if self.ends(env) || self.rests() {
                    return Ok((Stage::TickDue, None));
                }
                // A reconnected controller needs the state it has to answer.
                env.deliver_state_history()?;
            }
            let now_ns = began_ns.unwrap_or_else(|| env.now_ns());
            // Checked in every round, so that a stream of messages that answer nothing cannot postpone the
            // limit.
            if patience.is_over(now_ns) {
                self.give_up(env, silent)?;
                continue;
            }
            self.send_status(env, self.phase(), StatusTiming::IfDueAt(now_ns))?;
            let limit_ns = patience.limit_ns();
            self.tell_if_long(env, &mut notice, silent, ("answer", limit_ns), now_ns)?;
            let until_ns = patience.next_look_ns(now_ns);
            let stage = Stage::AwaitAnswers { patience, silent: Some(silent), notice };
            return Ok((stage, wait(WakeCondition::Command(silent), until_ns)));
        }
    }

    /// Reports once which controller the run waits for, as soon as the wait has become long.
    pub(super) fn tell_if_long<E: Environment>(
        &self,
        env: &mut E,
        notice: &mut Option<ProcessTimeout>,
        controller: ControllerIndex,
        (what, limit_ns): (&str, u64),
        now_ns: u64,
    ) -> Outcome<(), P, E> {
        if !notice.as_mut().is_some_and(|notice| notice.is_over(now_ns)) {
            return Ok(());
        }
        *notice = None;
        let controller = &self.controllers[controller.slot()];
        let (name, valid) = (&controller.name, controller.refused.as_ref().map_or("", |_| "valid "));
        let limit_s = limit_ns as f64 / NS_PER_S as f64;
        let text = format!("waiting for controller `{name}`: no {valid}{what} yet (limit {limit_s} s)");
        let (severity, code) = (Severity::Info, EventCode::Waiting);
        Ok(env.send_event(&Note { tick: self.tick, severity, code, text: &text })?)
    }

    /// Returns the first controller that lockstep waits for.
    fn unsettled(&self) -> Option<ControllerIndex> {
        ControllerIndex::first(self.controllers.len()).find(|index| !self.is_settled(*index))
    }

    /// Returns whether lockstep need not wait for a controller: it has answered, or it is optional and not
    /// connected.
    fn is_settled(&self, index: ControllerIndex) -> bool {
        let away = !self.latch.has_command(index) || self.latch.is_released(index);
        (away && self.controllers[index.slot()].optional) || self.latch.has_answer(index, self.tick)
    }

    /// Handles a controller that missed its limit in lockstep: an optional one is released and the run
    /// continues without it.
    fn give_up<E: Environment>(&mut self, env: &mut E, silent: ControllerIndex) -> Outcome<(), P, E> {
        let limit_ms = self.settings.controller_limit_ns as f64 * 1e-6;
        let controller = &self.controllers[silent.slot()];
        if !controller.optional {
            let (name, refused) = (controller.name.clone(), controller.refused.clone());
            let fault = ControllerFault::Silent { name, tick: self.tick, limit_ms, refused };
            return Err(HubError::Controller(fault));
        }
        self.latch.release(silent);
        let text = format!(
            "no answer to tick {} within {limit_ms} ms (`run.controller_limit_ms`); it is optional: burr \
             off, arm stopped, and the run continues without it until its next command",
            self.tick
        );
        self.warn(env, silent, EventCode::SafeCommand, &text)
    }

    /// Publishes that the run is over.
    pub(super) fn finish<E: Environment>(&mut self, env: &mut E) -> Outcome<Step, P, E> {
        let text = format!("the run ended at tick {} of {}", self.tick, self.settings.tick_count);
        self.inform(env, &text)?;
        self.send_status(env, Phase::Ended, StatusTiming::Now)?;
        env.wake_controllers();
        let now_ns = env.now_ns();
        let patience = ProcessTimeout::new(CONSUMER_LIMIT_NS, now_ns);
        Ok((Stage::Ending { patience, abandoned: ProcessTimeout::new(ABANDONED_LIMIT_NS, now_ns) }, None))
    }

    /// Waits until the recorder has taken the last state, then fails.
    pub(super) fn fail<E: Environment>(
        &mut self,
        env: &mut E,
        failure: Failure<P::Error>,
        mut patience: ProcessTimeout,
    ) -> Outcome<Next, P, E> {
        self.consumers.update(env)?;
        let now_ns = env.now_ns();
        let is_behind = self.shown && self.consumers.behind(self.tick, ConsumerSet::Recorder).is_some();
        if !is_behind || patience.is_over(now_ns) {
            return Err(failure.error());
        }
        env.wake_consumers();
        self.failing = Some((failure, patience));
        Ok(Next::Wait(Wait { until_ns: now_ns + CONNECT_LOOK_NS, on: WakeCondition::Nothing }))
    }

    /// Waits until the consumers have taken everything.
    pub(super) fn await_last<E: Environment>(
        &mut self,
        env: &mut E,
        mut patience: ProcessTimeout,
        mut abandoned: ProcessTimeout,
    ) -> Outcome<Step, P, E> {
        self.consumers.update(env)?;
        let Some(part) = self.consumers.behind(self.tick, ConsumerSet::Everybody) else {
            return Ok((Stage::Over, Some(Next::Ended)));
        };
        let now_ns = env.now_ns();
        // After a signal the wait is short: the user is in a hurry, or a consumer has died and will never
        // take the last state.
        if env.end_requested() && (!self.shown || abandoned.is_over(now_ns)) {
            return Ok((Stage::Over, Some(Next::Ended)));
        }
        if patience.is_over(now_ns) {
            let limit_s = patience.limit_ns() / NS_PER_S;
            return Err(HubError::ConsumerStuck { part, tick: self.tick, limit_s });
        }
        env.wake_consumers();
        env.deliver_status_history()?;
        let until_ns = now_ns + CONNECT_LOOK_NS;
        Ok((Stage::Ending { patience, abandoned }, wait(WakeCondition::Nothing, until_ns)))
    }
}
