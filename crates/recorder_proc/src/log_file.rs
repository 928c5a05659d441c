//! Log files: opening them for reading, creating them for writing.

use std::ffi::OsStr;
use std::fs::{DirEntry, File};
use std::io::{self, BufWriter, ErrorKind};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use run_log::{IndexStore, LogError, LogHeader, LogSource, ReadSeek, RunLog, TimingLog};
use rustix::fs::OFlags;
use tempfile::spooled_tempfile_in;

use crate::ring_files::open_logs;

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
                false => Err(io::Error::new(ErrorKind::InvalidInput, "not a regular file")),
            }
        };
        let file =
            open().map_err(|cause| LogError::Open { path: path.clone(), source: absent(path, cause) })?;
        Ok(Box::new(file))
    }
}

/// Says where the logs of a flight recorder are, if a file is missing because of that.
fn absent(path: &Path, cause: io::Error) -> io::Error {
    let folder = path.ancestors().skip(1).find(|folder| folder.is_dir());
    let open = folder.map(open_logs).unwrap_or_default();
    if cause.kind() != ErrorKind::NotFound || open.is_empty() {
        return cause;
    }
    let text = format!(
        "{cause}; the flight recorder has the last seconds in {} and removes the oldest as the run \
         continues: name one of them, or save one with `trabecula session save`",
        open.join(", ")
    );
    io::Error::new(ErrorKind::NotFound, text)
}

/// Returns the log that a user names: a file, or a run's folder, which contains it as `run.mcap`.
pub fn log_path(given: &Path) -> PathBuf {
    if given.is_dir() { given.join("run.mcap") } else { given.to_owned() }
}

/// Name of the newest run of a folder.
const LATEST: &str = "latest";
/// The folder of runs, unless a user names another one.
const RUNS: &str = "out";

/// Returns the path with `latest` replaced by the folder of the newest run in `out`, and `FOLDER/latest` by
/// that in FOLDER; any other path, and one that exists, as it is. The newest run is the one whose log changed
/// last.
pub fn or_latest(given: PathBuf) -> PathBuf {
    if given.file_name() != Some(OsStr::new(LATEST)) || given.symlink_metadata().is_ok() {
        return given;
    }
    let runs = given.parent().filter(|parent| *parent != Path::new("")).unwrap_or(Path::new(RUNS));
    let run = |entry: io::Result<DirEntry>| {
        let folder = entry.ok()?.path();
        let changed = log_path(&folder).metadata().ok().filter(|log| folder.is_dir() && log.is_file());
        Some((changed?.modified().ok()?, folder))
    };
    let newest = runs.read_dir().ok().and_then(|entries| entries.filter_map(run).max());
    newest.map_or(given, |(_, folder)| folder)
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

#[cfg(test)]
mod tests {
    use std::fs;
    use std::time::{Duration, SystemTime};

    use super::*;
    use crate::ring_files::{LANES, create};

    #[test]
    fn a_log_that_the_flight_recorder_has_yet_to_write_is_pointed_to() {
        let run = tempfile::tempdir().unwrap();
        let error = |name: &str| {
            let path = log_path(&run.path().join(name));
            LogFile::at(path).open().err().unwrap().to_string()
        };
        assert!(error("").ends_with("cannot open the log: No such file or directory (os error 2)"));
        for number in [2, 10, 11] {
            create(run.path(), number).unwrap().run.close().unwrap();
        }
        for name in ["ring-2", "ring-10"] {
            fs::write(run.path().join(name).join(LANES[0]), "begun").unwrap();
        }
        // The log of the run, and an open log that has been removed.
        for name in ["", "ring-1"] {
            assert!(error(name).contains("the last seconds in ring-2, ring-10 and"), "{}", error(name));
        }
    }

    #[test]
    fn the_latest_run_is_the_one_whose_log_changed_last() {
        let place = tempfile::tempdir().unwrap();
        let runs = place.path().join("runs");
        let run = |name: &str, age_s| {
            fs::create_dir_all(runs.join(name)).unwrap();
            let log = File::create(runs.join(name).join("run.mcap")).unwrap();
            log.set_modified(SystemTime::now() - Duration::from_secs(age_s)).unwrap();
        };
        let latest = runs.join(LATEST);
        assert_eq!(or_latest(latest.clone()), latest, "no such folder");
        run("z-20260101", 20);
        run("a-20260102", 10);
        run("b-20260101", 30);
        fs::create_dir(runs.join("without_log")).unwrap();
        fs::write(runs.join("file"), "").unwrap();
        assert_eq!(or_latest(latest.clone()), runs.join("a-20260102"));
        assert_eq!(or_latest(runs.join("b-20260101")), runs.join("b-20260101"));
        run(LATEST, 40);
        assert_eq!(or_latest(latest.clone()), latest, "a folder of this name");
    }
}
