//! What the hub needs from outside: ports, a clock, and whoever asks the run to end.

use messages::{
    Command, Keyframe, Latched, Part, Removed, RunControl, RunControlReply, RunStatus, State, TickTiming,
};

use crate::pacing::Start;
use crate::rate_limit::Connection;

/// Where the messages go that are a function of the scene and the latched commands alone: ports, a log, nowhere.
pub trait Outputs {
    /// Why a message cannot be sent.
    type Error;

    /// u_k, before the state that it leads to.
    ///
    /// # Errors
    /// It cannot be sent; the run ends.
    fn send_latched(&mut self, latched: &Latched) -> Result<(), Self::Error>;

    /// Voxels that a tick removed, by linear index.
    ///
    /// # Errors
    /// As [`Outputs::send_latched`].
    fn send_removed(&mut self, removed: &Removed, voxels: &[u32]) -> Result<(), Self::Error>;

    /// x_k.
    ///
    /// # Errors
    /// As [`Outputs::send_latched`].
    fn send_state(&mut self, state: &State) -> Result<(), Self::Error>;

    /// One part of a keyframe.
    ///
    /// # Errors
    /// As [`Outputs::send_latched`].
    fn send_keyframe(&mut self, keyframe: &Keyframe, part: &[u8]) -> Result<(), Self::Error>;
}

/// A message that has arrived.
#[derive(Debug, Clone, PartialEq)]
pub enum Incoming<M> {
    /// A copy of it, so that what is checked is what is used, whatever its writer does meanwhile; and who sent it.
    Message(M, Connection),
    /// Bytes that are no such message, and why.
    Malformed(String),
}

/// How far a consumer says that it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Report {
    /// Who; as the transport knows it, not as the message says.
    pub part: Part,
    /// Every state up to this tick has been taken.
    pub tick: u64,
}

/// An event for people, by one of the `EVENT_` and `SEVERITY_` constants.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Note<'t> {
    /// Tick at which it was noticed.
    pub tick: u64,
    /// One of the `SEVERITY_` constants.
    pub severity: u32,
    /// One of the `EVENT_` constants.
    pub code: u32,
    /// Text.
    pub text: &'t str,
}

/// The hub's surroundings. No call waits: what is to be waited for, [`Hub::advance`](crate::Hub::advance) returns.
pub trait Environment: Outputs {
    /// Monotonic clock, ns.
    fn now_ns(&self) -> u64;

    /// Whether the process has been asked to end.
    fn end_requested(&self) -> bool;

    /// The oldest command of a controller that has not been taken.
    ///
    /// # Errors
    /// The queue cannot be read; the run ends.
    fn receive_command(&mut self, controller: usize) -> Result<Option<Incoming<Command>>, Self::Error>;

    /// Whether a command of a controller waits.
    fn has_command(&self, controller: usize) -> bool;

    /// The oldest request to run control that has not been taken.
    ///
    /// # Errors
    /// As [`Environment::receive_command`].
    fn receive_control(&mut self) -> Result<Option<Incoming<RunControl>>, Self::Error>;

    /// The oldest report of a consumer that has not been taken.
    ///
    /// # Errors
    /// As [`Environment::receive_command`].
    fn receive_report(&mut self) -> Result<Option<Report>, Self::Error>;

    /// Reports so far from programs that are not a consumer.
    fn foreign_reports(&self) -> u64;

    /// Where the run stands.
    ///
    /// # Errors
    /// As [`Outputs::send_latched`].
    fn send_status(&mut self, status: &RunStatus) -> Result<(), Self::Error>;

    /// Wall-clock facts of a tick.
    ///
    /// # Errors
    /// As [`Outputs::send_latched`].
    fn send_timing(&mut self, timing: &TickTiming) -> Result<(), Self::Error>;

    /// The answer to a request to run control.
    ///
    /// # Errors
    /// As [`Outputs::send_latched`].
    fn send_control_reply(&mut self, reply: &RunControlReply) -> Result<(), Self::Error>;

    /// An event.
    ///
    /// # Errors
    /// As [`Outputs::send_latched`].
    fn send_event(&mut self, note: &Note<'_>) -> Result<(), Self::Error>;

    /// Wakes the controllers that sleep.
    fn wake_controllers(&mut self);

    /// Wakes the consumers that sleep.
    fn wake_consumers(&mut self);

    /// Hands the newest state to subscribers that have come since the last one was sent.
    ///
    /// # Errors
    /// As [`Outputs::send_latched`].
    fn deliver_state_history(&mut self) -> Result<(), Self::Error>;

    /// The same for the run's status.
    ///
    /// # Errors
    /// As [`Outputs::send_latched`].
    fn deliver_status_history(&mut self) -> Result<(), Self::Error>;

    /// The work of a tick is done, and the thread is about to wait for the next one (real time).
    fn work_ends(&mut self) {}

    /// A tick has begun. Fills in what the kernel says was done to the thread since the last one; `start` is none in lockstep.
    fn tick_begins(&mut self, start: Option<(u64, Start)>, timing: &mut TickTiming) {
        let _ = (start, timing);
    }

    /// A status is about to be sent: ten times a second and at each change.
    fn status_is_due(&mut self) {}
}
