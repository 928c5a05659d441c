//! Errors of reading and writing logs.

use std::io;
use std::path::PathBuf;

use foreign_text::{foreign, foreign_line};
use messages::Tick;

use crate::topics::Topic;

/// An error of reading or writing a log: the cause, the file, and what to do about it.
#[derive(Debug, thiserror::Error)]
pub enum LogError {
    /// The file could not be created.
    #[error("{}: cannot create the log: {source}; choose a writable folder for the run", path.display())]
    Create {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// Bytes could not be written: disk full, quota, device gone.
    #[error("{}: cannot write the log: {source}; free space or choose another folder", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// The MCAP writer failed.
    #[error("{}: cannot encode the log: {source}", path.display())]
    Encode {
        /// The file.
        path: PathBuf,
        /// The writer's reason.
        source: mcap::McapError,
    },
    /// The message does not match the topic's schema.
    #[error("{}: message for {topic} refused: got {given}, expected {expected}", path.display())]
    Message {
        /// The file.
        path: PathBuf,
        /// The topic.
        topic: String,
        /// What was passed.
        given: String,
        /// What was expected.
        expected: String,
    },
    /// The file could not be opened.
    #[error("{}: cannot open the log: {source}", path.display())]
    Open {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// The device failed to read; the content may be intact.
    #[error("{}: cannot read the log at byte {offset}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Offset of the failed read, in bytes.
        offset: u64,
        /// The system's reason.
        source: io::Error,
    },
    /// Not an MCAP file.
    #[error("{}: not an MCAP file: it begins with {found}, expected 89 4d 43 41 50 30 0d 0a", path.display())]
    NotMcap {
        /// The file.
        path: PathBuf,
        /// Its first bytes in hexadecimal.
        found: String,
    },
    /// The file ends before its header, or another program wrote it.
    #[error(
        "{}: no Trabecula header before byte {offset}: the file is truncated or is not a Trabecula log",
        path.display()
    )]
    NoHeader {
        /// The file.
        path: PathBuf,
        /// Where the search ended.
        offset: u64,
    },
    /// The file holds several runs.
    #[error(
        "{}: contains {} runs; split it with `trabecula log split` first",
        path.display(),
        foreign(.runs)
    )]
    SeveralRuns {
        /// The file.
        path: PathBuf,
        /// How many.
        runs: String,
    },
    /// The operation needs a file of several runs.
    #[error(
        "{}: contains a single run; expected several, as written by `trabecula log cat-files`",
        path.display()
    )]
    OneRun {
        /// The file.
        path: PathBuf,
    },
    /// The output file already exists.
    #[error("{}: already exists; choose another name", path.display())]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// The operation needs a whole log.
    #[error("{}: {}; run `trabecula log repair` first", path.display(), foreign_line(.cause))]
    NotWhole {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        cause: String,
    },
    /// A value in the header or end marker cannot be read.
    #[error("{}: {record}.{} is '{}', expected {expected}", path.display(), foreign(.key), foreign(.value))]
    Metadata {
        /// The file.
        path: PathBuf,
        /// `trabecula` or `end`.
        record: &'static str,
        /// Name of the entry.
        key: String,
        /// The value found; empty if the entry is missing.
        value: String,
        /// The value expected.
        expected: &'static str,
    },
    /// A message's layout differs from this build's.
    #[error(
        "{}: layout of {} is {} in the log and {build} in this build; use the build that wrote \
         the log ({}), or allow other layouts",
        path.display(),
        foreign(.message),
        foreign(.log),
        foreign(.version)
    )]
    Layout {
        /// The file.
        path: PathBuf,
        /// The message.
        message: String,
        /// Layout hash in the log.
        log: String,
        /// Layout hash in this build; empty if it has no such message.
        build: String,
        /// Version that wrote the log.
        version: String,
    },
    /// The log exceeds a limit on what a reader keeps in memory.
    #[error(
        "{}: {found} {what}, at most {most} allowed; no Trabecula log exceeds this limit",
        path.display()
    )]
    TooMuch {
        /// The file.
        path: PathBuf,
        /// What exceeds the limit.
        what: &'static str,
        /// Amount found before reading stopped.
        found: usize,
        /// The limit.
        most: usize,
    },
    /// Content that our writer never produces: a flipped bit, a lost block, an edited file.
    #[error(
        "{}: damaged at byte {offset}: {}; everything before is readable",
        path.display(),
        foreign_line(.cause)
    )]
    Damaged {
        /// The file.
        path: PathBuf,
        /// Start of the damaged record.
        offset: u64,
        /// What is wrong.
        cause: String,
    },
    /// A message is missing between two others.
    #[error(
        "{}: gap in {topic} at tick {tick}: {}; ticks before it are complete",
        path.display(),
        foreign(.found)
    )]
    Gap {
        /// The file.
        path: PathBuf,
        /// Topic of the missing message.
        topic: Topic,
        /// `tick` that the missing message carries.
        tick: Tick,
        /// What was found in its place.
        found: String,
    },
    /// The file ends before the initial state.
    #[error("{}: no initial state on /state: the log ends before its first complete chunk", path.display())]
    NoInitialState {
        /// The file.
        path: PathBuf,
    },
    /// A complete log without states: there is nothing to replay.
    #[error(
        "{}: complete, but contains no states: not a `run.mcap`, or the run ended before its first state",
        path.display()
    )]
    NoStates {
        /// The file.
        path: PathBuf,
    },
    /// The log has no such topic.
    #[error("{}: no topic {topic}; available: {}", path.display(), foreign_line(.topics))]
    NoSuchTopic {
        /// The file.
        path: PathBuf,
        /// The topic requested.
        topic: String,
        /// The topics in the log.
        topics: String,
    },
    /// The field path does not match any field.
    #[error("no field '{field}' in any selected topic; {reason}")]
    NoSuchField {
        /// The path as given.
        field: String,
        /// Where it stops matching.
        reason: String,
    },
    /// The text output failed (a closed pipe, a full disk).
    #[error("cannot write the output: {source}")]
    Output {
        /// The system's reason.
        #[from]
        source: io::Error,
    },
}

impl LogError {
    /// Returns whether other arguments could fix this; they cannot fix damage or a full disk.
    pub fn is_bad_input(&self) -> bool {
        !matches!(
            self,
            LogError::Damaged { .. }
                | LogError::Gap { .. }
                | LogError::NotWhole { .. }
                | LogError::NoInitialState { .. }
                | LogError::Write { .. }
                | LogError::Encode { .. }
                | LogError::Read { .. }
                | LogError::Output { .. }
        )
    }

    /// The error without the file's path, for callers that already show it.
    pub fn without_path(&self) -> String {
        let text = self.to_string();
        let path = match self {
            LogError::Metadata { path, .. }
            | LogError::TooMuch { path, .. }
            | LogError::Read { path, .. }
            | LogError::NotMcap { path, .. }
            | LogError::NoHeader { path, .. } => path,
            _ => return text,
        };
        text.strip_prefix(&format!("{}: ", path.display())).map_or(text.clone(), str::to_owned)
    }
}
