//! The interface to the hub's surroundings: ports, a clock, and the request to end the run.

use messages::{
    Blame, Command, ControllerIndex, EventCode, Keyframe, Latched, Part, Removed, RunControl,
    RunControlReply, RunStatus, SensorReading, Severity, State, Tick, TickTiming, TipJacobian,
};

use crate::pacing::Start;
use crate::rate_limit::Connection;

/// Sink for the messages that depend only on the scene and the latched commands: ports, a log, or nothing.
pub trait Outputs {
    /// Why a message could not be sent.
    type Error;

    /// Sends u_k, before the state it leads to.
    ///
    /// # Errors
    /// If the message could not be sent; the run ends.
    fn send_latched(&mut self, latched: &Latched) -> Result<(), Self::Error>;

    /// Sends the voxels that a tick removed, by linear index.
    ///
    /// # Errors
    /// As [`Outputs::send_latched`].
    fn send_removed(&mut self, removed: &Removed, voxels: &[u32]) -> Result<(), Self::Error>;

    /// Sends a reading that arrives with the next state sent.
    ///
    /// # Errors
    /// As [`Outputs::send_latched`].
    fn send_reading(&mut self, reading: &SensorReading) -> Result<(), Self::Error>;

    /// Sends the tip's Jacobian at the next state sent. No log needs it, and it is computed only if it is
    /// sent.
    ///
    /// # Errors
    /// As [`Outputs::send_latched`].
    fn send_tip_jacobian(
        &mut self,
        _jacobian: impl FnOnce() -> Option<TipJacobian>,
    ) -> Result<(), Self::Error> {
        Ok(())
    }

    /// Sends x_k.
    ///
    /// # Errors
    /// As [`Outputs::send_latched`].
    fn send_state(&mut self, state: &State) -> Result<(), Self::Error>;

    /// Sends one part of a keyframe.
    ///
    /// # Errors
    /// As [`Outputs::send_latched`].
    fn send_keyframe(&mut self, keyframe: &Keyframe, part: &[u8]) -> Result<(), Self::Error>;
}

/// A received message.
#[derive(Debug, Clone, PartialEq)]
pub enum IncomingMessage<M> {
    /// A copy of the message and its sender. A copy, because the sender could change shared memory between
    /// the check and the use.
    Message(M, Connection),
    /// Not a valid message; holds the reason.
    Malformed(String),
}

/// A consumer's progress report.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Report {
    /// The sender, identified by the transport rather than by the message.
    pub part: Part,
    /// The consumer has taken every state up to this tick.
    pub tick: Tick,
}

/// An event described for the operator.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Note<'t> {
    /// Tick at which the hub noticed it.
    pub tick: Tick,
    /// Its severity.
    pub severity: Severity,
    /// The kind of event.
    pub code: EventCode,
    /// Description.
    pub text: &'t str,
}

/// The hub's surroundings. No call blocks; [`Hub::advance`](crate::Hub::advance) returns what to wait for.
pub trait Environment: Outputs {
    /// Reads the monotonic clock, ns.
    fn now_ns(&self) -> u64;

    /// Returns whether the process has been asked to end.
    fn end_requested(&self) -> bool;

    /// Takes the oldest command in a controller's queue.
    ///
    /// # Errors
    /// If the queue cannot be read; the run ends.
    fn receive_command(
        &mut self,
        controller: ControllerIndex,
    ) -> Result<Option<IncomingMessage<Command>>, Self::Error>;

    /// Takes the oldest run-control request in the queue.
    ///
    /// # Errors
    /// As [`Environment::receive_command`].
    fn receive_control(&mut self) -> Result<Option<IncomingMessage<RunControl>>, Self::Error>;

    /// Takes the oldest consumer report in the queue.
    ///
    /// # Errors
    /// As [`Environment::receive_command`].
    fn receive_report(&mut self) -> Result<Option<Report>, Self::Error>;

    /// Returns the number of reports so far from programs that are not consumers.
    fn foreign_reports(&self) -> u64;

    /// Sends the run's status.
    ///
    /// # Errors
    /// As [`Outputs::send_latched`].
    fn send_status(&mut self, status: &RunStatus) -> Result<(), Self::Error>;

    /// Sends a tick's wall-clock timing.
    ///
    /// # Errors
    /// As [`Outputs::send_latched`].
    fn send_timing(&mut self, timing: &TickTiming) -> Result<(), Self::Error>;

    /// Sends the reply to a run-control request.
    ///
    /// # Errors
    /// As [`Outputs::send_latched`].
    fn send_control_reply(&mut self, reply: &RunControlReply) -> Result<(), Self::Error>;

    /// Sends an event.
    ///
    /// # Errors
    /// As [`Outputs::send_latched`].
    fn send_event(&mut self, note: &Note<'_>) -> Result<(), Self::Error>;

    /// Stores why the run ends early before announcing the end, so that a client that sees the end can read
    /// the reason.
    fn leave_blame(&mut self, blame: &Blame);

    /// Wakes sleeping controllers.
    fn wake_controllers(&mut self);

    /// Wakes sleeping consumers.
    fn wake_consumers(&mut self);

    /// Delivers the newest state to subscribers that connected after it was sent.
    ///
    /// # Errors
    /// As [`Outputs::send_latched`].
    fn deliver_state_history(&mut self) -> Result<(), Self::Error>;

    /// Delivers the newest run status to subscribers that connected after it was sent.
    ///
    /// # Errors
    /// As [`Outputs::send_latched`].
    fn deliver_status_history(&mut self) -> Result<(), Self::Error>;

    /// Called in real time when a tick's work is done and the thread is about to wait for the next deadline.
    fn work_ends(&mut self) {}

    /// Called in real time when a tick begins. Fills in what the kernel reports about the thread since the
    /// last tick began.
    fn tick_begins(&mut self, start_ns: u64, start: Start, timing: &mut TickTiming) {
        let _ = (start_ns, start, timing);
    }

    /// Called in lockstep when a tick's state has been published. Fills in what the kernel reports about the
    /// thread since the last state was published.
    fn tick_made(&mut self, timing: &mut TickTiming) {
        let _ = timing;
    }

    /// Called before a status is sent: ten times a second and at each change.
    fn status_is_due(&mut self) {}
}
