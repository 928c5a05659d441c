//! The services of a session: name, message, lane, and the limits of each queue.
//!
//! All services are publish-subscribe over byte slices; the layout hash of the message travels as an
//! attribute. Every queue is bounded and overwrites its oldest entry, so nothing ever blocks the physics.
//! Each message carries a sequence number or tick, so a reader can detect what it lost.

use crate::layout::{Description, Message};
use crate::part::Part;
use crate::{
    Command, DrrReply, DrrRequest, Event, Frame, FrameTiming, ImagePrefix, Keyframe, Latched,
    MAX_CONTROLLERS, Progress, Removed, RunControl, RunControlReply, RunStatus, SensorReading, State,
    TickTiming, TipJacobian, Volume,
};

/// The log that a service is recorded to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Lane {
    /// `run.mcap`: a function of the scene and the latched commands alone.
    Run,
    /// `timing.mcap`: wall-clock facts and everything that depends on them.
    Timing,
    /// Not recorded as messages (the volume: the log's metadata holds its hash; the tip's Jacobian follows
    /// from the state).
    None,
}

/// One service and its limits.
#[derive(Debug, Clone, Copy)]
pub struct Service {
    /// Name within the session; a command service adds `/<controller>`.
    pub name: &'static str,
    /// Its message.
    pub description: &'static Description,
    /// Where it is recorded.
    pub lane: Lane,
    /// The only parts that may write to it; empty if every client may.
    pub writers: &'static [Part],
    /// How many entries a slow subscriber may lag before its oldest are overwritten.
    pub queue_length: usize,
    /// As above, for subscribers that must not lose any: the recorder, and the DRR process for removed
    /// voxels.
    pub lossless_length: usize,
    /// Number of newest messages delivered to a late joiner.
    pub history: usize,
    /// Maximum number of publishers at a time.
    pub max_publishers: usize,
    /// Maximum number of subscribers at a time.
    pub max_subscribers: usize,
    /// Largest message, bytes, if independent of the scene; the sender splits or refuses longer ones.
    pub max_bytes: usize,
}

/// Maximum number of voxels in one `Removed` message; further voxels of a tick follow in further messages of
/// that tick.
pub const MAX_REMOVED_PER_MESSAGE: usize = 4096;
/// Largest keyframe, bytes. A larger state is not saved, which an event reports. A hole of 36 mm in voxels of
/// 0.06 mm needs 3.5 MB.
pub const MAX_KEYFRAME_BYTES: usize = 8 << 20;
/// Maximum number of a keyframe's bytes in one message.
pub const KEYFRAME_PART_BYTES: usize = 32 << 10;
/// Bytes of an event's text, including its NUL.
pub const MAX_EVENT_TEXT: usize = 1024;

/// Maximum number of subscribers. A complete session has nine subscribers of the run's status: four
/// controllers, DRR, recorder, launcher and the viewer's two. The rest are for clients that only watch. Each
/// costs two samples of every publisher.
const MAX_SUBSCRIBERS: usize = 16;

const fn fixed<M: Message>(
    name: &'static str,
    lane: Lane,
    writers: &'static [Part],
    queue_length: usize,
) -> Service {
    Service {
        name,
        description: M::DESCRIPTION,
        lane,
        writers,
        queue_length,
        lossless_length: 8 * queue_length,
        history: 1,
        max_publishers: 1,
        max_subscribers: MAX_SUBSCRIBERS,
        max_bytes: M::DESCRIPTION.size,
    }
}

const ANYBODY: &[Part] = &[];
const PHYSICS_ONLY: &[Part] = &[Part::Physics];
const DRR_ONLY: &[Part] = &[Part::Drr];

/// `State`, once per tick. A queue holds half a second of states at 1 kHz, the recorder's queue
/// [`RECORDER_QUEUE_TICKS`].
pub const STATE: Service = fixed::<State>("state", Lane::Run, PHYSICS_ONLY, 512);
/// Ticks for which the recorder can stall without losing anything: 4.096 s at 1 kHz. All per-tick queues have
/// this length.
pub const RECORDER_QUEUE_TICKS: u64 = STATE.lossless_length as u64;
/// `Latched`, once per tick, before the state that it leads to.
pub const LATCHED: Service = fixed::<Latched>("latched", Lane::Run, PHYSICS_ONLY, 512);
/// `Removed`, for ticks that removed voxels.
pub const REMOVED: Service = Service {
    history: 0,
    max_bytes: Removed::DESCRIPTION.size + MAX_REMOVED_PER_MESSAGE * 4,
    ..fixed::<Removed>("removed", Lane::Run, PHYSICS_ONLY, 512)
};
/// `SensorReading`, for scenes with sensors. The recorder's queue holds what eight sensors send at 250 Hz in
/// the 4.096 s for which it can stall.
pub const SENSOR: Service =
    Service { history: 0, ..fixed::<SensorReading>("sensor", Lane::Run, PHYSICS_ONLY, 1024) };
/// `TipJacobian`, once per tick, for scenes with `manipulator.tip_jacobian`.
pub const TIP_JACOBIAN: Service =
    Service { lossless_length: 8, ..fixed::<TipJacobian>("tip_jacobian", Lane::None, PHYSICS_ONLY, 8) };
/// `Keyframe`, in parts, every `recording.keyframe_interval_s`. The queue holds one keyframe of the largest
/// size, the recorder's queue two.
pub const KEYFRAME: Service = Service {
    history: 0,
    lossless_length: 2 * MAX_KEYFRAME_BYTES / KEYFRAME_PART_BYTES,
    max_subscribers: 2,
    max_bytes: Keyframe::DESCRIPTION.size + KEYFRAME_PART_BYTES,
    ..fixed::<Keyframe>("keyframe", Lane::Run, PHYSICS_ONLY, MAX_KEYFRAME_BYTES / KEYFRAME_PART_BYTES)
};
/// `Command`, one service per controller, so that the service identifies the writer. A recorder may lag as
/// far behind on commands as on states.
pub const COMMAND: Service =
    Service { history: 0, ..fixed::<Command>("command", Lane::Timing, ANYBODY, 512) };
/// `Volume`, once; `max_bytes` depends on the scene's volume.
pub const VOLUME: Service =
    Service { lossless_length: 1, max_bytes: 0, ..fixed::<Volume>("volume", Lane::None, &[Part::Host], 1) };
/// `Frame` with its image; `max_bytes` depends on the scene's detector.
pub const FRAME: Service = Service { max_bytes: 0, ..fixed::<Frame>("frame", Lane::Run, DRR_ONLY, 8) };
/// `DrrRequest`.
pub const DRR_REQUEST: Service = Service {
    // A client may join before the DRR process listens.
    history: 64,
    max_publishers: 8,
    ..fixed::<DrrRequest>("drr_request", Lane::Timing, ANYBODY, 64)
};
/// `DrrReply`.
pub const DRR_REPLY: Service =
    Service { history: 0, ..fixed::<DrrReply>("drr_reply", Lane::Run, DRR_ONLY, 64) };
/// `RunControl`.
pub const RUN_CONTROL: Service = Service {
    history: 0,
    max_publishers: 8,
    ..fixed::<RunControl>("run_control", Lane::Timing, ANYBODY, 16)
};
/// `RunControlReply`.
pub const RUN_CONTROL_REPLY: Service =
    Service { history: 0, ..fixed::<RunControlReply>("run_control_reply", Lane::Timing, PHYSICS_ONLY, 16) };
/// `RunStatus`.
pub const RUN_STATUS: Service = fixed::<RunStatus>("run_status", Lane::Timing, PHYSICS_ONLY, 16);
/// `Event`.
pub const EVENT: Service = Service {
    history: 0,
    max_publishers: 16,
    max_bytes: Event::DESCRIPTION.size + MAX_EVENT_TEXT,
    ..fixed::<Event>("event", Lane::Timing, ANYBODY, 256)
};
/// `Progress` of the consumers of lossless streams.
pub const PROGRESS: Service = Service {
    max_publishers: 4,
    ..fixed::<Progress>("progress", Lane::None, &[Part::Drr, Part::Recorder], 16)
};
/// `TickTiming`.
pub const TICK_TIMING: Service =
    Service { history: 0, ..fixed::<TickTiming>("tick_timing", Lane::Timing, PHYSICS_ONLY, 512) };
/// `FrameTiming`.
pub const FRAME_TIMING: Service =
    Service { history: 0, ..fixed::<FrameTiming>("frame_timing", Lane::Timing, DRR_ONLY, 64) };

// The recorder may lag equally far behind on everything that is sent once a tick.
const _: () = assert!(
    LATCHED.lossless_length == STATE.lossless_length
        && REMOVED.lossless_length == STATE.lossless_length
        && COMMAND.lossless_length == STATE.lossless_length
        && TICK_TIMING.lossless_length == STATE.lossless_length
);
const _: () =
    assert!(KEYFRAME.queue_length * KEYFRAME_PART_BYTES == MAX_KEYFRAME_BYTES, "the longest keyframe fits");
const _: () = assert!(
    MAX_CONTROLLERS + 5 <= MAX_SUBSCRIBERS,
    "DRR, recorder, launcher and the viewer's two beside them"
);
const _: () = assert!(
    MAX_CONTROLLERS < DRR_REQUEST.max_publishers
        && MAX_CONTROLLERS < RUN_CONTROL.max_publishers
        && Part::ALL.len() + MAX_CONTROLLERS < EVENT.max_publishers,
    "a complete session leaves room for clients"
);

impl Service {
    /// Returns the number of samples per publisher, including its own loan. Queues hold the newest messages,
    /// so all queues together hold no more than the longest one; in addition every subscriber may hold two.
    /// The volume is published once: one copy of a CT in memory, not one per possible reader.
    pub fn samples(&self) -> usize {
        if self.name == VOLUME.name {
            return 1;
        }
        self.lossless_length.max(self.history) + SAMPLES_HELD * (self.max_subscribers + 1)
    }

    /// Returns an upper bound of the shared memory that a publisher reserves, bytes.
    pub fn reserved_bytes(&self) -> u64 {
        let sample = self.max_bytes + SAMPLE_HEADER;
        SEGMENT_HEADER + (self.samples() * (sample + SAMPLE_INDEX)) as u64
    }
}

/// Upper bound of a sample's overhead besides its payload, bytes.
const SAMPLE_HEADER: usize = 64;
/// Upper bound of the segment allocator's overhead per sample, bytes.
const SAMPLE_INDEX: usize = 8;
/// Upper bound of a segment's overhead besides its samples, bytes.
const SEGMENT_HEADER: u64 = 4096;
/// A port's overhead besides its samples, bytes: its connections, and what other ports allocate at the same
/// time.
pub const CONNECTIONS_BYTES: u64 = 2 << 20;

/// Maximum number of samples that a subscriber may hold at a time.
pub const SAMPLES_HELD: usize = 2;

/// Every service except the commands, which have one per controller.
pub const ALL: &[Service] = &[
    STATE,
    LATCHED,
    REMOVED,
    SENSOR,
    TIP_JACOBIAN,
    KEYFRAME,
    VOLUME,
    FRAME,
    DRR_REQUEST,
    DRR_REPLY,
    RUN_CONTROL,
    RUN_CONTROL_REPLY,
    RUN_STATUS,
    EVENT,
    PROGRESS,
    TICK_TIMING,
    FRAME_TIMING,
];

/// Returns the name of a controller's command service.
pub fn command_name(controller: &str) -> String {
    format!("{}/{controller}", COMMAND.name)
}

/// Returns the length of a frame message, bytes: [`Frame`], [`ImagePrefix`], pixels.
pub fn frame_bytes(columns: u32, rows: u32) -> usize {
    Frame::DESCRIPTION.size + ImagePrefix::DESCRIPTION.size + columns as usize * rows as usize * 2
}
