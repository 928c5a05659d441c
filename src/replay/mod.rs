//! Replays a log: opens it, checks that this build can replay it, and implements the kinds of replay.

mod frames;
mod gone;
mod live;
mod recording;
mod replies;
mod step;

pub use frames::{ComparedFrames, FrameReplay, compare, verify_frames};
pub use gone::RemovedBone;
pub use inputs::log::{OpenedLog, Overrides};
pub use live::{LivePlan, run as run_live};
pub use recording::{ReplayRecording, record};
pub use step::{step, timed_verification};
