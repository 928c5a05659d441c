//! Which X-ray frames are rendered at which tick, and which removed voxels they show.
//!
//! **Boundary:** as in the rest of this crate, it only decides; the DRR process takes the messages, renders and publishes.
//!
//! **Invariants:** in lockstep the frames depend only on ticks and requests, never on how long rendering takes; one program's requests
//! never displace another's; a frame shows exactly the voxels removed up to its tick, or the run fails.
//!
//! ```
//! use hub::x_ray::{Due, Renderer, Schedule, ScheduleSettings};
//! use scene::Mode;
//!
//! let settings = ScheduleSettings { mode: Mode::Realtime, period_ticks: Some(40), end_tick: 1000, c_arm_driver: None };
//! let mut schedule = Schedule::new(settings);
//! assert_eq!(schedule.due(0, Renderer::Idle), Some(Due::Scheduled));
//! // A busy renderer delays the next frame; the one after it is on time again.
//! assert_eq!(schedule.due(40, Renderer::Busy), None);
//! assert_eq!(schedule.due(47, Renderer::Idle), Some(Due::Scheduled));
//! assert_eq!(schedule.due(80, Renderer::Idle), Some(Due::Scheduled));
//! ```

mod removals;
mod schedule;

pub use removals::{Removals, RemovedBatch, RemovedLost, RemovedSince};
pub use schedule::{Due, Refusal, Renderer, Schedule, ScheduleSettings};
