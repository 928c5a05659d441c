//! The tick as a state machine without I/O: latching, run control, pacing, and the order of publication.
//!
//! [`Hub`] owns the tick. It does not wait, read a clock or know the transport: [`Hub::advance`] does what
//! can be done now through an [`Environment`] and returns what to wait for. The physics process drives it
//! with shared memory and the machine's clock; the tests drive it with queues in memory and a simulated
//! clock.
//!
//! **Boundary:** the hub only decides. Shared memory, sleeping, rendering and writing belong to the
//! environment; computing a step belongs to the [`Plant`](messages::Plant). Times are nanoseconds of the
//! environment's clock.
//!
//! **Invariants**, tested against every schedule of `hub_schedules`: u_k is published before its effect and
//! x_{k+1} after it, each once and in order; a refused command changes nothing; no tick runs while the run is
//! paused or ending; no consumer falls too far behind; every ending has a reason; every wait has a limit.
//!
//! ```text
//! connect:  publish x_0 until every consumer and every controller has answered
//! tick k:   obey run control (pause, step, reset, stop)
//!           real time: wait for the deadline t_0 + k dt  lockstep: wait for every controller's answer to x_k
//!           u_k := latch                                 (validated; late commands held, then the safe one)
//!           publish u_k
//!           x_{k+1}, h_{k+1} := step(x_k, u_k)
//!           publish removed voxels, then x_{k+1}; wake sleeping readers
//! end:      publish the phase "ended", wait until the consumers have taken the last state
//! ```
//!
//! With a recorder, a keyframe follows the state every `recording.keyframe_interval_s`.
//!
//! A missed deadline is never made up silently: a tick that begins more than one period late counts as
//! missed, and the schedule shifts by the time lost, so ticks never bunch up.
//!
//! The latch on its own, in real time: a command is fresh in the tick that takes it, then held; once it is
//! too old, the safe command replaces it.
//!
//! ```
//! use std::path::Path;
//!
//! use hub::latch::Latch;
//! use messages::CommandSource::{Fresh, Held, Safe};
//! use messages::{Command, ControllerIndex, Reset, TendonMode, Tick};
//! use scene::Scene;
//!
//! let text = r#"
//! name = "late"
//! [run]
//! mode = "realtime"
//! duration_s = 1.0
//! hold_ticks = 2
//! [tool]
//! burr_start_mm = [0.0, 0.0, 0.0]
//! direction = [1.0, 0.0, 0.0]
//! bend_toward = [0.0, 0.0, 1.0]
//! [[controller]]
//! name = "me"
//! drives = ["tendon"]
//! [controller.hold]
//! tension_n = 5.0
//! "#;
//! let mut latch = Latch::new(&Scene::parse(text, Path::new("late.toml")).unwrap());
//! let mut command = Command { sequence: 1, tendon_mode: TendonMode::ServoJf.code(), ..Command::zeroed() };
//! command.tendon_force_n[0] = 5.0;
//! let me = ControllerIndex(0);
//! latch.offer(me, &command, Tick::START).unwrap();
//! let sources: Vec<_> = (0..4)
//!     .map(|tick| {
//!         latch.latch(Tick(tick), Reset::No);
//!         latch.source(me)
//!     })
//!     .collect();
//! assert_eq!(sources, [Fresh, Held, Held, Safe]);
//! // The same number again is refused.
//! assert!(latch.offer(me, &command, Tick(4)).is_err());
//! ```
//!
//! | module | what it holds |
//! |---|---|
//! | [`run_lane`] | one tick: what it steps, and what it publishes in which order; also for replays |
//! | [`in_process`] | the same tick with controllers in the same thread: benches, calibration, tests |
//! | [`latch`], [`command_check`] | u_k from the commands received |
//! | [`rate_limit`], [`patience`] | rate limits per sender; timeouts |

pub mod command_check;
mod consumers;
mod environment;
pub mod in_process;
pub mod latch;
mod late_notes;
mod lead;
mod machine;
mod pacing;
pub mod patience;
pub mod rate_limit;
pub mod run_lane;

pub use environment::{Environment, IncomingMessage, Note, Outputs, Report};
pub use machine::{ControllerFault, Hub, HubError, Next, Settings, Wait, WakeCondition};
pub use pacing::Start;
