//! MCAP logs: writing, reading, comparing and replaying them, and the recorder process.
//!
//! A run leaves two files. `run.mcap`, the deterministic lane, is a function of the scene and the latched commands:
//! its bytes depend on nothing but the sequence of messages written to it. `timing.mcap` holds wall-clock facts and
//! everything that depends on them.
//!
//! A record is the raw message behind [`CDR_LITTLE_ENDIAN`](ipc_types::layout::CDR_LITTLE_ENDIAN), so any reader of
//! `cdr` with `ros2msg` schemas shows it. Chunks are closed every 100 ms of simulated time and checked by CRC when
//! they are read; a log cut at any byte is read up to the last complete tick.
//!
//! **Boundary:** it knows messages and files, and no simulation: a log is verified against any [`Plant`](ipc_types::messages::Plant).
//!
//! **Invariants:** the bytes of `run.mcap` do not depend on when the messages came; a reader believes no length and no count that it has not
//! checked; no single record makes a log unreadable; what is read over is said.
//!
//! | module | what it holds |
//! |---|---|
//! | [`run_log`], [`timing_log`] | the writers |
//! | [`reader`], [`frames`](mod@frames), [`stream`] | ticks, frames, single messages of a log |
//! | [`verdict`](mod@verdict), [`continuity`], [`opening`] | what is wrong with a log: one answer for every command |
//! | [`verify`](mod@verify), [`segments`] | re-execution of a log, compared tick by tick, and its parallel form |
//! | [`info`](mod@info), [`cat`](mod@cat), [`diff`](mod@diff) | what people ask of a log, as text |
//! | [`misses`] | why ticks began late |
//! | [`repair`](mod@repair), [`join`] | logs made of logs: repaired, packed, joined, split |
//! | [`columns`], [`export`] | a topic as a table: CSV and Parquet |
//! | [`background`] | the thread that writes |

pub mod background;
pub mod cat;
pub mod columns;
pub mod continuity;
pub mod diff;
pub mod difference;
pub mod end;
pub mod error;
pub mod export;
pub mod fields;
pub mod frame_order;
pub mod frames;
mod gaps;
pub mod header;
mod index;
pub mod info;
pub mod join;
mod lengths;
mod limits;
mod mcap_writer;
pub mod misses;
pub mod opening;
mod order;
pub mod process;
pub mod reader;
pub mod reason_file;
mod records;
pub mod repair;
pub mod rewrite;
pub mod run_log;
mod seal;
pub mod segments;
mod sink;
pub mod stream;
pub mod timing_log;
pub mod topics;
pub mod verdict;
pub mod verify;
mod walk;

pub use cat::{CatOptions, cat};
pub use continuity::{Gap, Stretch};
pub use diff::{DiffReport, diff};
pub use difference::{Divergence, FieldDifference};
pub use end::{EndMarker, EndReason, Ending};
pub use error::LogError;
pub use frames::{FrameReader, FrameRecord, frames};
pub use header::{BuildInfo, LogHeader, RunMode};
pub use info::{LogInfo, info};
pub use join::{cat_files, compress, split};
pub use misses::{Cause, LostTime, Misses};
pub use opening::{HeaderCopy, log_path};
pub use reader::{LogReader, ReadOptions, SavedState, TickRecord};
pub use repair::{RepairReport, repair};
pub use rewrite::Packing;
pub use run_log::RunLog;
pub use segments::{SegmentOptions, SegmentReport, keyframe_before, verify_segments};
pub use stream::{LogMessage, MessageStream};
pub use timing_log::TimingLog;
pub use verdict::{Fault, Verdict, verdict};
pub use verify::{ReplayReport, VerifyOptions, verify};
