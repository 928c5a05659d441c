//! What the physics waits for: everybody's connection, the controllers' answers, the consumers of its states. Every wait
//! has a limit, of which time spent stopped takes no part, and looks at the request to end.

use std::time::{Duration, Instant};

use ipc_types::messages::{EVENT_RUN, EVENT_SAFE_COMMAND, PHASE_CONNECTING, PHASE_ENDED};
use ipc_types::patience::Patience;

use super::Runner;
use crate::process::PhysicsError;
use crate::process::clock::now_ns;
use crate::process::ports::Consumer;

/// How long every part may take to connect: a DRR process reads the whole volume first.
const CONNECT_LIMIT: Duration = Duration::from_secs(60);
/// How long a consumer may stand still in lockstep: a full frame of a large CT takes seconds.
const CONSUMER_LIMIT: Duration = Duration::from_secs(120);
/// The same at the end of a run that a signal has ended; what the consumers have not taken yet stays in their queues.
const ABANDONED_LIMIT: Duration = Duration::from_millis(500);

impl Runner<'_> {
    /// Publishes the initial state until everybody has answered it, or the run is to end.
    pub(super) fn connect(&mut self) -> Result<(), PhysicsError> {
        let predrilled = self.simulation.predrilled().to_vec();
        let mut consumers = Patience::new(CONNECT_LIMIT);
        // A controller is measured from when there is a state to answer.
        let mut controllers = Vec::new();
        loop {
            self.ports.consumers.update()?;
            let missing = self.ports.consumers.missing().map(|consumer| consumer.part);
            if missing.is_none() && !self.shown {
                // Only now, so that no consumer misses the first messages.
                self.ports.publish_predrilled(&predrilled)?;
                self.publish_state()?;
                self.shown = true;
                controllers
                    .extend(self.ports.controllers.iter().map(|port| Patience::new(port.connect_limit)));
            }
            self.collect_commands()?;
            if self.ends() {
                return Ok(());
            }
            if let Some(part) = missing.filter(|_| consumers.is_over()) {
                let (part, limit_s) = (part.to_owned(), CONNECT_LIMIT.as_secs());
                return Err(PhysicsError::NotConnected { part, limit_s, hint: String::new() });
            }
            if missing.is_none() {
                let over: Vec<bool> = controllers.iter_mut().map(Patience::is_over).collect();
                match self.awaited_controller() {
                    None => break,
                    Some(index) if over[index] => return Err(self.not_connected(index)),
                    Some(_) => {}
                }
            }
            self.obey()?;
            self.send_status(PHASE_CONNECTING, false)?;
            self.ports.state.deliver_history()?;
            std::thread::sleep(Duration::from_millis(1));
        }
        let text = "every part has connected";
        self.ports.events.inform(self.tick, EVENT_RUN, text)?;
        self.connected = true;
        self.send_status(self.phase(), true)?;
        Ok(())
    }

    /// A controller that the run does not begin without and that has not commanded yet.
    fn awaited_controller(&self) -> Option<usize> {
        let mut all = self.ports.controllers.iter().enumerate();
        all.find(|(index, port)| !port.optional && !self.latch.has_command(*index)).map(|(index, _)| index)
    }

    fn not_connected(&self, index: usize) -> PhysicsError {
        let port = &self.ports.controllers[index];
        PhysicsError::NotConnected {
            part: format!("controller `{}`", port.name),
            limit_s: port.connect_limit.as_secs(),
            hint: port.how_to_connect.clone(),
        }
    }

    /// Whether lockstep need not wait for a controller: it has answered, or may stay away and is not here.
    fn is_settled(&self, index: usize) -> bool {
        let away = !self.latch.has_command(index) || self.latch.is_released(index);
        (away && self.ports.controllers[index].optional) || self.latch.has_answer(index, self.tick)
    }

    pub(super) fn await_answers(&mut self) -> Result<(), PhysicsError> {
        let mut patience = Patience::new(self.controller_limit);
        loop {
            self.collect_commands()?;
            let Some(silent) = (0..self.ports.controllers.len()).find(|index| !self.is_settled(*index))
            else {
                return Ok(());
            };
            // At every turn, also when messages come that are no answer.
            if patience.is_over() {
                self.give_up(silent)?;
                continue;
            }
            let commands = &self.ports.controllers[silent].commands;
            let came = self.ports.waiter.wait_until(patience.next_look(), || commands.has_message());
            self.obey()?;
            if self.ends() || self.rests() {
                return Ok(());
            }
            self.send_status(self.phase(), false)?;
            if !came {
                // A controller that has come back needs the state that it is to answer.
                self.ports.state.deliver_history()?;
            }
        }
    }

    /// A controller has not answered within its limit in lockstep: without an optional one the run goes on.
    fn give_up(&mut self, silent: usize) -> Result<(), PhysicsError> {
        let limit_ms = self.controller_limit.as_secs_f64() * 1e3;
        let port = &self.ports.controllers[silent];
        if !port.optional {
            let name = port.name.clone();
            return Err(PhysicsError::ControllerSilent { name, tick: self.tick, limit_ms });
        }
        self.latch.release(silent);
        let text = format!(
            "no answer to tick {} within {limit_ms} ms (`run.controller_limit_ms`); it is optional: burr off, arm stopped, \
             and the run goes on without it until it commands again",
            self.tick
        );
        Ok(self.warn(silent, EVENT_SAFE_COMMAND, &text)?)
    }

    /// In real time with `recording.on_full = "wait"`: waits while the recorder is so far behind that its queues might overflow.
    pub(super) fn await_recorder(&mut self, deadline_ns: u64) -> Result<(), PhysicsError> {
        self.timing.recorder_wait_ns = 0;
        let Some(lead_ticks) = self.recorder_lead_ticks else { return Ok(()) };
        let tick = self.tick.saturating_sub(lead_ticks);
        if self.ports.consumers.behind(tick, Consumer::is_recorder).is_none() {
            return Ok(());
        }
        let began_ns = now_ns().max(deadline_ns);
        self.await_consumers(tick, Consumer::is_recorder)?;
        self.timing.recorder_wait_ns = now_ns().saturating_sub(began_ns);
        Ok(())
    }

    /// Waits until every consumer of these has taken the state of `tick`, or the run ends or rests.
    pub(super) fn await_consumers(
        &mut self,
        tick: u64,
        of: fn(&Consumer) -> bool,
    ) -> Result<(), PhysicsError> {
        let mut patience = Patience::new(CONSUMER_LIMIT);
        loop {
            if self.ports.consumers.behind(tick, of).is_none() {
                return Ok(());
            }
            self.ports.consumers.update()?;
            let Some(part) = self.ports.consumers.behind(tick, of).map(|consumer| consumer.part) else {
                return Ok(());
            };
            self.obey()?;
            if self.ends() || self.rests() {
                return Ok(());
            }
            if patience.is_over() {
                return Err(PhysicsError::ConsumerStuck {
                    part,
                    tick: self.tick,
                    limit_s: CONSUMER_LIMIT.as_secs(),
                });
            }
            self.send_status(self.phase(), false)?;
            self.ports.consumers.wake();
            let slice = Instant::now() + Duration::from_millis(2);
            self.ports.waiter.wait_until(slice, || self.ports.consumers.has_report());
        }
    }

    /// Says that the run is over, and stays until the consumers have everything.
    pub(super) fn finish(mut self) -> Result<(), PhysicsError> {
        let text = format!("the run ended at tick {} of {}", self.tick, self.tick_count);
        self.ports.events.inform(self.tick, EVENT_RUN, &text)?;
        self.send_status(PHASE_ENDED, true)?;
        self.ports.controllers.iter().for_each(|port| port.waker.wake());
        let (mut patience, mut abandoned) = (Patience::new(CONSUMER_LIMIT), Patience::new(ABANDONED_LIMIT));
        loop {
            self.ports.consumers.update()?;
            let Some(part) = self.ports.consumers.behind(self.tick, |_| true).map(|consumer| consumer.part)
            else {
                return Ok(());
            };
            // Asked to end by a signal, somebody is in a hurry, or dead: nobody may be there to take the last state.
            if self.end.is_set() && (!self.shown || abandoned.is_over()) {
                return Ok(());
            }
            if patience.is_over() {
                return Err(PhysicsError::ConsumerStuck {
                    part,
                    tick: self.tick,
                    limit_s: CONSUMER_LIMIT.as_secs(),
                });
            }
            self.ports.consumers.wake();
            self.ports.status.deliver_history()?;
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}
