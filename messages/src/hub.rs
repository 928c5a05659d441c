use crate::message;

/// [`RunControl::action`]: stop before the next tick until resumed; steps that are not made yet are given up.
pub const CONTROL_PAUSE: u32 = 1;
/// Go on.
pub const CONTROL_RESUME: u32 = 2;
/// While paused, make `ticks` ticks.
pub const CONTROL_STEP: u32 = 3;
/// Set the simulation back to its initial state.
pub const CONTROL_RESET: u32 = 4;
/// End the run.
pub const CONTROL_STOP: u32 = 5;

message! {
    /// Steers the run. Sent by the launcher, a viewer or a client.
    pub struct RunControl = "trabecula_msgs/msg/RunControl" {
        /// Chosen by the sender; comes back in the reply.
        request_id: u64,
        /// Number of ticks of a step.
        ticks: u64,
        /// 1 pause, 2 resume, 3 step, 4 reset, 5 stop.
        action: u32,
        /// Always 0.
        reserved: u32,
    }
}

/// [`RunControlReply::status`]: done.
pub const CONTROL_DONE: u32 = 0;
/// [`RunControlReply::status`]: no such action, or not now (a step while running).
pub const CONTROL_REFUSED: u32 = 1;

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

/// [`RunStatus::phase`]: waiting for the parts to connect.
pub const PHASE_CONNECTING: u32 = 0;
/// Ticks are made.
pub const PHASE_RUNNING: u32 = 1;
/// No ticks until resumed.
pub const PHASE_PAUSED: u32 = 2;
/// The last tick has been made; every part ends.
pub const PHASE_ENDED: u32 = 3;

message! {
    /// Where the run stands. Published on each change and ten times a second; late joiners receive the newest.
    pub struct RunStatus = "trabecula_msgs/msg/RunStatus" {
        /// Ticks made.
        tick: u64,
        /// Ticks of the whole run; 0 if it has no end.
        tick_count: u64,
        /// Ticks that began later than one period after their deadline (real time only).
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

/// [`Event::severity`]: worth knowing.
pub const SEVERITY_INFO: u32 = 0;
/// Something was refused or lost, the run goes on.
pub const SEVERITY_WARNING: u32 = 1;
/// The run ends.
pub const SEVERITY_ERROR: u32 = 2;

/// [`Event::code`]: a command was refused; `text` says which field and why.
pub const EVENT_COMMAND_REFUSED: u32 = 1;
/// A controller was late; its last command is held.
pub const EVENT_COMMAND_HELD: u32 = 2;
/// A controller has been late for longer than the scene allows; the safe command applies.
pub const EVENT_SAFE_COMMAND: u32 = 3;
/// Messages were lost; `text` says which and how many.
pub const EVENT_MESSAGES_LOST: u32 = 4;
/// A part of the run connected, paused, resumed, was reset or stopped.
pub const EVENT_RUN: u32 = 5;
/// A message from a controller to whoever reads the log.
pub const EVENT_CONTROLLER: u32 = 6;
/// A request for a frame was refused.
pub const EVENT_REQUEST_REFUSED: u32 = 7;

message! {
    /// Something that happened, for people.
    pub struct Event = "trabecula_msgs/msg/Event" {
        /// Tick at which it was noticed.
        tick: u64,
        /// Counts the sender's events, from 1.
        sequence: u64,
        /// 0 information, 1 warning, 2 error.
        severity: u32,
        /// What kind of event; see the constants.
        code: u32,
        /// Sender: 0 launcher, 1 physics, 2 DRR, 3 recorder, 16 + i the scene's controller i.
        sender: u32,
        /// Length of `text` with its final NUL.
        text_length: u32,
    }
    tail text: [u8] = "string"
}

/// [`Event::sender`], [`Progress::consumer`]: the launcher.
pub const SENDER_LAUNCHER: u32 = 0;
/// The physics process.
pub const SENDER_PHYSICS: u32 = 1;
/// The DRR process.
pub const SENDER_DRR: u32 = 2;
/// The recorder process.
pub const SENDER_RECORDER: u32 = 3;
/// The scene's controller 0; controller i is `SENDER_CONTROLLER + i`.
pub const SENDER_CONTROLLER: u32 = 16;

message! {
    /// How far a consumer of the lossless streams has come. In lockstep the physics never runs further ahead than the
    /// queues hold; the first one also says that the consumer is there.
    pub struct Progress = "trabecula_msgs/msg/Progress" {
        /// Every state up to this tick has been taken.
        tick: u64,
        /// Messages that this consumer missed, over all services.
        lost_messages: u64,
        /// 2 DRR, 3 recorder.
        consumer: u32,
        /// Always 0.
        reserved: u32,
    }
}
