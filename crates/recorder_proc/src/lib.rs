//! The recorder process and log files: the I/O shell around `run_log`.
//!
//! The recorder receives every message of a session and passes it to the writers of [`run_log`], which decide
//! what the logs contain and in which order. This crate provides the transport, the clock, the threads and
//! the files: how a log is opened and created, how its bytes reach the disk during the run, and which build
//! it names.
//!
//! **Boundary:** it handles sessions and files, not MCAP. The content of a log, and the detection of damage,
//! are the job of `run_log`.
//!
//! **Invariants:** disk writes block the receiving of messages only when all buffers are full; neither the
//! recorder nor a tool ever replaces an existing file; a tool's output is complete or absent.
//! ```
//! use recorder_proc::log_file::{LogFile, create_run};
//! use run_log::{LogHeader, LogReader, EndReason, RunMode};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! # let folder = tempfile::tempdir()?;
//! let path = folder.path().join("run.mcap");
//! let header = LogHeader {
//!     scene_toml: "name = \"example\"".to_owned(),
//!     calibration_json: None,
//!     scene_name: "example".to_owned(),
//!     volume_sha256: None,
//!     volume_dimensions: [0; 3],
//!     dt_ns: 1_000_000,
//!     mode: RunMode::Lockstep,
//!     controllers: Vec::new(),
//!     build: recorder_proc::build_info::current(),
//!     first_tick: ipc_types::messages::Tick::START,
//! };
//! let mut log = create_run(&path, &header)?;
//! log.state(&ipc_types::messages::State::zeroed())?;
//! log.finish(EndReason::Completed, &Default::default())?;
//! assert_eq!(*LogReader::open(&LogFile::at(&path))?.header(), header);
//! # Ok(())
//! # }
//! ```
//!
//! | module | contents |
//! |---|---|
//! | [`process`], [`reason_file`] | the recorder; the end reason passed to it |
//! | [`background`], [`ring_files`] | the writer thread; the files of a flight recorder |
//! | [`log_file`], [`rewritten`] | log files; log files derived from log files |
//! | [`parquet_file`] | a topic as a Parquet file |
//! | [`build_info`], [`exit_code`](mod@exit_code) | this build; a verdict as an exit code |

pub mod background;
pub mod build_info;
pub mod exit_code;
pub mod log_file;
pub mod parquet_file;
pub mod parquet_table;
pub mod process;
pub mod reason_file;
pub mod rewritten;
pub mod ring_files;
