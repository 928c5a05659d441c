//! Logs of a run as MCAP: writing, reading, repairing, comparing, replaying and tabulating them.
//!
//! A run produces two logs. `run.mcap`, the deterministic lane, is a function of the scene and the latched
//! commands: its bytes depend only on the sequence of messages written to it. `timing.mcap` holds wall-clock
//! times and everything that depends on them.
//!
//! A record is the raw message after a [`CDR_LITTLE_ENDIAN`](messages::layout::CDR_LITTLE_ENDIAN) header, so
//! any reader of `cdr` with `ros2msg` schemas can show it. Chunks are closed every 100 ms of simulated time,
//! and their CRCs are checked on reading. A log truncated at any byte can be read up to its last complete
//! tick.
//!
//! **Boundary:** bytes in, bytes out. It writes to any `Write` and reads any `Read + Seek` ([`LogSource`]);
//! it opens no files, reads no clock and starts no thread that outlives the call. Log files, the recorder and
//! the build's identity are in `recorder_proc`. It does not depend on the simulation either: a log is
//! verified against any [`Plant`](messages::Plant).
//!
//! **Invariants:** the bytes of `run.mcap` do not depend on when messages arrive. A reader checks every
//! length and count before it trusts it. No single damaged record makes a log unreadable, and everything
//! skipped is reported.
//!
//! Writing a log into memory and reading it back:
//! ```
//! use std::collections::BTreeMap;
//!
//! use messages::{Latched, State, Tick};
//! use run_log::{BuildInfo, EndReason, LogBytes, LogHeader, LogReader, RunLog, RunMode};
//!
//! # fn main() -> Result<(), run_log::LogError> {
//! let header = LogHeader {
//!     scene_toml: "name = \"example\"".to_owned(),
//!     calibration_json: None,
//!     scene_name: "example".to_owned(),
//!     volume_sha256: None,
//!     volume_dimensions: [0; 3],
//!     dt_ns: 1_000_000,
//!     mode: RunMode::Lockstep,
//!     controllers: vec!["me".to_owned()],
//!     build: BuildInfo { version: "0.1.0".to_owned(), target: "any".to_owned(), rustc: None },
//!     first_tick: Tick::START,
//! };
//! let mut log = RunLog::create(Vec::new(), &header)?;
//! log.state(&State::zeroed())?;
//! // The command of tick 1 arrives after its effect; the log puts them in order.
//! log.state(&State { tick: 1, ..State::zeroed() })?;
//! log.latched(&Latched { tick: 0, ..Latched::zeroed() })?;
//! let (_, bytes) = log.finish(EndReason::Completed, &BTreeMap::new())?;
//!
//! // Truncated anywhere after its ticks, the log still returns them.
//! let cut = bytes.len() - 40;
//! let mut reader = LogReader::open(&LogBytes::new("example.mcap", &bytes[..cut]))?;
//! let ticks: Vec<u64> = reader.by_ref().map(|tick| Ok(tick?.state.tick)).collect::<Result<_, run_log::LogError>>()?;
//! assert_eq!(ticks, [1]);
//! assert!(!reader.stream().verdict().is_intact());
//! # Ok(())
//! # }
//! ```
//!
//! Besides the crate's own items (writers, readers and verdicts of logs):
//!
//! | module | contents |
//! |---|---|
//! | [`verify`], [`segments`] | replaying a log and comparing tick by tick, in one pass or in parallel |
//! | [`cat`], [`diff`], [`difference`] | printing and comparing logs and messages as text |
//! | [`ring`], [`triggers`] | which of the overlapping logs of a flight recorder are saved, and why |
//! | [`misses`], [`gaps`] | why ticks began late; messages that never arrived |
//! | [`repair`], [`join`] | logs derived from logs: repaired, recompressed, joined, split |
//! | [`columns`], [`csv`], [`fields`], [`timeline`] | a topic as a table, a field over time |
//! | [`foxglove`] | content for 3D panels, as a separate log |

mod bare;
pub mod cat;
pub mod columns;
mod continuity;
pub mod csv;
pub mod diff;
pub mod difference;
mod end;
mod error;
pub mod fields;
pub mod foxglove;
mod frame_order;
mod frames;
pub mod gaps;
mod header;
mod index;
mod info;
pub mod join;
mod lengths;
mod library;
mod limits;
mod mcap_writer;
pub mod misses;
mod opening;
mod order;
mod pending;
mod reader;
mod records;
pub mod repair;
mod rewrite;
pub mod ring;
mod run_lane;
mod seal;
pub mod segments;
mod sink;
mod source;
mod stream;
pub mod timeline;
mod times;
mod timing_lane;
mod topics;
pub mod triggers;
mod unpack;
mod verdict;
pub mod verify;
mod walk;

pub use continuity::{Gap, Stretch};
pub use end::{END_RECORD, EndMarker, EndReason, Ending, TruncationPoint, hash_text};
pub use error::LogError;
pub use frame_order::frame_lag_ticks;
pub use frames::{FrameReader, FrameRecord, frames};
pub use header::{BuildInfo, CALIBRATION_ATTACHMENT, LogHeader, RunMode, layout_hashes};
pub use info::{LogInfo, info};
pub use mcap_writer::IndexStore;
pub use opening::HeaderCopy;
pub use reader::{LogReader, RecordedFailure, Resumption, SavedState, TickRecord, voxel_indices, voxels_of};
pub use records::PADDING_BYTES;
pub use rewrite::Packing;
pub use run_lane::RunLog;
pub use source::{LogBytes, LogSource, ReadSeek};
pub use stream::{LogMessage, MessageStream, ReadOptions, TopicCount};
pub use timing_lane::TimingLog;
pub use topics::{Logged, RUN_TOPICS, Topic, command_topic, schema_of, unit_of};
pub use verdict::{Fault, Verdict, verdict};
