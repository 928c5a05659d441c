//! Log files: opening them for reading, creating them for writing.

use std::fs::File;
use std::io::{self, BufWriter};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use run_log::{IndexStore, LogError, LogHeader, LogSource, ReadSeek, RunLog, TimingLog};
use rustix::fs::OFlags;
use tempfile::spooled_tempfile_in;

/// Bytes of chunk indexes kept in memory before they spill to disk: about a minute's worth.
const INDEX_BYTES: usize = 256 << 10;

/// A log file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LogFile(PathBuf);

impl LogFile {
    /// Returns the log in this file, which is opened only when it is read.
    pub fn at(path: impl Into<PathBuf>) -> LogFile {
        LogFile(path.into())
    }
}

impl LogSource for LogFile {
    fn path(&self) -> &Path {
        &self.0
    }

    /// Rejects pipes and devices, which cannot be read from the end, without waiting for a writer.
    fn open(&self) -> Result<Box<dyn ReadSeek>, LogError> {
        let path = &self.0;
        let open = || {
            let file = File::options().read(true).custom_flags(OFlags::NONBLOCK.bits() as i32).open(path)?;
            match file.metadata()?.is_file() {
                true => Ok(file),
                false => Err(io::Error::new(io::ErrorKind::InvalidInput, "not a regular file")),
            }
        };
        let file = open().map_err(|source| LogError::Open { path: path.clone(), source })?;
        Ok(Box::new(file))
    }
}

/// Returns the log that a user names: a file, or a run's folder, which contains it as `run.mcap`.
pub fn log_path(given: &Path) -> PathBuf {
    if given.is_dir() { given.join("run.mcap") } else { given.to_owned() }
}

/// Returns the storage for a log's chunk indexes until the log ends: memory that spills to an unnamed file
/// beside the log.
pub fn index_beside(log: &Path) -> Box<dyn IndexStore> {
    Box::new(spooled_tempfile_in(INDEX_BYTES, output_file::folder_of(log)))
}

/// Creates the file of a deterministic lane and writes its header. Replaces an existing file.
///
/// # Errors
/// [`LogError::Create`], [`LogError::Write`].
pub fn create_run(path: &Path, header: &LogHeader) -> Result<RunLog<BufWriter<File>>, LogError> {
    RunLog::create_named(create(path)?, path, index_beside(path), header)
}

/// Creates the file of a timing lane and writes its header. Replaces an existing file.
///
/// # Errors
/// [`LogError::Create`], [`LogError::Write`].
pub fn create_timing(path: &Path, header: &LogHeader) -> Result<TimingLog<BufWriter<File>>, LogError> {
    TimingLog::create_named(create(path)?, path, index_beside(path), header)
}

fn create(path: &Path) -> Result<BufWriter<File>, LogError> {
    let file = File::create(path).map_err(|source| LogError::Create { path: path.into(), source })?;
    Ok(BufWriter::with_capacity(1 << 16, file))
}
