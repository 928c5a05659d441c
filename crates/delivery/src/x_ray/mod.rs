//! X-ray frame decisions: which frames are rendered at which tick, which removed voxels they show, and when a
//! controller sees them.
//!
//! **Boundary:** as in the rest of this crate, decisions only; the DRR process takes the messages, renders
//! and publishes, and the controller's process takes the frames.
//!
//! **Invariants:** in lockstep the frames depend only on ticks and requests, never on how long rendering
//! takes; one program's requests never displace another's; each accepted request gets its frame or a refusal
//! by the end of the run; a frame shows exactly the voxels removed up to its tick, or the run fails; in
//! lockstep a controller sees each scheduled frame at the same tick in every run.
//!
//! ```
//! use delivery::x_ray::{DueFrame, Renderer, Schedule, ScheduleSettings};
//! use messages::Tick;
//! use scene::Mode;
//!
//! let settings = ScheduleSettings { mode: Mode::Realtime, period_ticks: Some(40), end_tick: Tick(1000), c_arm_driver: None };
//! let mut schedule = Schedule::new(settings);
//! assert_eq!(schedule.due(Tick(0), Renderer::Idle), Some(DueFrame::Scheduled));
//! // A busy renderer delays the next frame; the one after it is on time again.
//! assert_eq!(schedule.due(Tick(40), Renderer::Busy), None);
//! assert_eq!(schedule.due(Tick(47), Renderer::Idle), Some(DueFrame::Scheduled));
//! assert_eq!(schedule.due(Tick(80), Renderer::Idle), Some(DueFrame::Scheduled));
//! ```

mod controller_frames;
mod removals;
mod schedule;

pub use controller_frames::{ControllerFrames, FrameMark, FrameStep, FrameTimeout};
pub use removals::{RemovalDelta, RemovalLoss, Removals, RemovedBatch};
pub use schedule::{DueFrame, Refusal, Renderer, Schedule, ScheduleSettings};
