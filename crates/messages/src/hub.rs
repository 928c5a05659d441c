use crate::{EventCode, message};

message! {
    /// Controls the run. Sent by the launcher, a viewer or a client.
    pub struct RunControl = "trabecula_msgs/msg/RunControl" {
        /// Chosen by the sender and returned in the reply.
        request_id: u64,
        /// Number of ticks of a step, or after a save.
        ticks: u64,
        /// 1 pause, 2 resume, 3 step, 4 reset, 5 stop, 6 save.
        action: u32,
        /// Always 0.
        reserved: u32,
    }
}

message! {
    /// Answers a [`RunControl`].
    pub struct RunControlReply = "trabecula_msgs/msg/RunControlReply" {
        /// The request's id.
        request_id: u64,
        /// Tick at which the action took effect.
        tick: u64,
        /// The request's action.
        action: u32,
        /// 0 done, 1 refused.
        status: u32,
    }
}

message! {
    /// Status of the run. Published on each change and ten times a second; late joiners receive the newest
    /// one.
    pub struct RunStatus = "trabecula_msgs/msg/RunStatus" {
        /// Number of ticks done.
        tick: u64,
        /// Number of ticks of the whole run; 0 if it has no end.
        tick_count: u64,
        /// Ticks that began more than one period after their deadline (real time only).
        missed_ticks: u64,
        /// Commands that were refused.
        refused_commands: u64,
        /// `Removed` messages sent so far.
        removed_messages: u64,
        /// 0 connecting, 1 running, 2 paused, 3 ended.
        phase: u32,
        /// 0 lockstep, 1 real time.
        mode: u32,
    }
}

message! {
    /// An event, described for human readers.
    pub struct Event = "trabecula_msgs/msg/Event" {
        /// Tick at which it was noticed.
        tick: u64,
        /// Sequence number of the sender's events, from 1.
        sequence: u64,
        /// 0 information, 1 warning, 2 error.
        severity: u32,
        /// Kind of event; see the constants.
        code: u32,
        /// Sender: 0 launcher, 1 physics, 2 DRR, 3 recorder, 16 + i the scene's controller i.
        sender: u32,
        /// Length of `text` with its final NUL.
        text_length: u32,
    }
    tail text: [u8] = "string"
}

message! {
    /// Progress of a consumer of the lossless streams. In lockstep the physics never runs further ahead than
    /// the queues can hold. The first message also announces the consumer.
    pub struct Progress = "trabecula_msgs/msg/Progress" {
        /// Every state up to this tick has been received.
        tick: u64,
        /// Messages that this consumer missed, on all services together.
        lost_messages: u64,
        /// 2 DRR, 3 recorder.
        consumer: u32,
        /// Always 0.
        reserved: u32,
    }
}

/// Why the physics ends a run early.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Blame {
    /// The kind of event: a controller is missing or late, or the simulation failed.
    pub code: EventCode,
    /// The controller's name; `None` if the simulation failed.
    pub controller: Option<String>,
    /// The event's text.
    pub text: String,
}
