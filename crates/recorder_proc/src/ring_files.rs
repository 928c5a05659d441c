//! The files of a flight recorder: a thread that creates, closes, names and removes them, so that a stalled
//! disk does not stall the recorder.
//!
//! An open log is a folder `ring-N` with both lanes. When it is saved, it is renamed `saved-N`; the log of
//! the end of the run moves to `run.mcap` and `timing.mcap`. So a log under its final name is complete.
//! Names that other programs have taken meanwhile are skipped.

use std::fs::{self, DirEntry};
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, Sender, TryRecvError, channel};
use std::thread::JoinHandle;

use run_log::LogError;
use rustix::fs::{CWD, RenameFlags, renameat_with};
use rustix::io::Errno;

use crate::background::{BackgroundFile, BackgroundOptions};

/// The files of the two lanes, by name.
pub const LANES: [&str; 2] = ["run.mcap", "timing.mcap"];

/// Name of the folder of an open log, before its number.
pub const OPEN_PREFIX: &str = "ring-";
/// Name of the folder of a saved log, before its number.
pub const SAVED_PREFIX: &str = "saved-";

/// The two lanes of an open log.
pub struct LogFiles {
    /// The folder.
    pub folder: PathBuf,
    /// `run.mcap`.
    pub run: BackgroundFile,
    /// `timing.mcap`.
    pub timing: BackgroundFile,
}

/// What to do with the files of a log that is no longer written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Disposal {
    /// Name it `saved-N`; if this is taken, by the first free number that the run does not announce.
    Save(u64),
    /// Move it into the run's folder.
    MoveUp,
    /// Remove it.
    Remove,
}

enum Job {
    Create(u64),
    Dispose(LogFiles, Disposal),
}

/// Hands jobs to the thread. Its first error is returned by the next call.
pub struct RingFiles {
    jobs: Option<Sender<Job>>,
    created: Receiver<Result<LogFiles, LogError>>,
    failures: Receiver<LogError>,
    thread: Option<JoinHandle<()>>,
}

impl RingFiles {
    /// Starts the thread for the logs of a run's folder, which announces at most `saved_at_most` of them.
    ///
    /// # Errors
    /// The system refuses the thread.
    pub fn start(output: &Path, saved_at_most: u64) -> io::Result<RingFiles> {
        let (jobs, wanted) = channel();
        let (give, created) = channel();
        let (fail, failures) = channel();
        let output = output.to_owned();
        let work = move || {
            for job in wanted {
                match job {
                    Job::Create(number) => drop(give.send(create(&output, number))),
                    Job::Dispose(files, disposal) => {
                        if let Err(error) = dispose(&output, files, disposal, saved_at_most) {
                            let _ = fail.send(error);
                        }
                    }
                }
            }
        };
        let thread = std::thread::Builder::new().name("ring files".to_owned()).spawn(work)?;
        Ok(RingFiles { jobs: Some(jobs), created, failures, thread: Some(thread) })
    }

    /// Asks for the files of another log.
    pub fn ask(&self, number: u64) {
        self.send(Job::Create(number));
    }

    /// Returns the files asked for, if they have been created.
    ///
    /// # Errors
    /// They cannot be created, or an earlier log could not be finished.
    pub fn asked(&self) -> Result<Option<LogFiles>, LogError> {
        self.check()?;
        match self.created.try_recv() {
            Ok(files) => files.map(Some),
            Err(TryRecvError::Empty | TryRecvError::Disconnected) => Ok(None),
        }
    }

    /// Waits for the files asked for.
    ///
    /// # Errors
    /// As [`asked`](Self::asked).
    pub fn wait(&self) -> Result<Option<LogFiles>, LogError> {
        self.check()?;
        self.created.recv().ok().transpose()
    }

    /// Hands over the files of a log that is no longer written.
    pub fn dispose(&self, files: LogFiles, disposal: Disposal) {
        self.send(Job::Dispose(files, disposal));
    }

    /// Waits until all files are closed, named and removed.
    ///
    /// # Errors
    /// The first error since the last call.
    pub fn finish(mut self) -> Result<(), LogError> {
        self.join();
        // Files that were created and never used.
        for files in self.created.try_iter().flatten() {
            remove(files)?;
        }
        self.check()
    }

    fn check(&self) -> Result<(), LogError> {
        self.failures.try_recv().map_or(Ok(()), Err)
    }

    fn send(&self, job: Job) {
        if let Some(jobs) = &self.jobs {
            // Fails only if the thread has panicked.
            let _ = jobs.send(job);
        }
    }

    fn join(&mut self) {
        self.jobs = None;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

impl Drop for RingFiles {
    fn drop(&mut self) {
        self.join();
    }
}

/// Returns the names of the saved logs in a run's folder, in order.
pub fn saved_logs(run: &Path) -> Vec<String> {
    logs_in(run, SAVED_PREFIX)
}

/// Returns the names of the open logs in a run's folder that have begun, in order.
pub fn open_logs(run: &Path) -> Vec<String> {
    let mut open = logs_in(run, OPEN_PREFIX);
    // The files of a log that has not begun are empty.
    open.retain(|name| run.join(name).join(LANES[0]).metadata().is_ok_and(|file| file.len() > 0));
    open
}

fn logs_in(run: &Path, prefix: &str) -> Vec<String> {
    let number = |entry: io::Result<DirEntry>| {
        entry.ok()?.file_name().to_str()?.strip_prefix(prefix)?.parse::<u64>().ok()
    };
    let mut numbers: Vec<u64> = run.read_dir().into_iter().flatten().filter_map(number).collect();
    numbers.sort_unstable();
    numbers.into_iter().map(|number| format!("{prefix}{number}")).collect()
}

/// Creates the folder and the files of an open log, under the first free name from `number` on.
///
/// # Errors
/// [`LogError::Create`], [`LogError::Exists`].
pub fn create(output: &Path, number: u64) -> Result<LogFiles, LogError> {
    let folder = first_free(output, OPEN_PREFIX, number.., |folder| fs::create_dir(folder))?;
    let open = |lane: &str, options| create_file(&folder.join(lane), options);
    let run = open(LANES[0], BackgroundOptions::RUN)?;
    let timing = open(LANES[1], BackgroundOptions::TIMING)?;
    sync(&folder)?;
    sync(output)?;
    Ok(LogFiles { folder, run, timing })
}

/// Creates a log file.
///
/// # Errors
/// [`LogError::Create`], [`LogError::Exists`].
pub fn create_file(path: &Path, options: BackgroundOptions) -> Result<BackgroundFile, LogError> {
    BackgroundFile::create(path, options).map_err(|source| create_error(path, source))
}

fn create_error(path: &Path, source: io::Error) -> LogError {
    match source.kind() {
        ErrorKind::AlreadyExists => LogError::Exists { path: path.into() },
        _ => LogError::Create { path: path.into(), source },
    }
}

fn dispose(output: &Path, files: LogFiles, disposal: Disposal, saved_at_most: u64) -> Result<(), LogError> {
    if disposal == Disposal::Remove {
        return remove(files);
    }
    let LogFiles { folder, run, timing } = files;
    for (file, lane) in [(run, LANES[0]), (timing, LANES[1])] {
        file.close().map_err(write_error(&folder.join(lane)))?;
    }
    match disposal {
        Disposal::Save(number) => {
            let numbers = std::iter::once(number).chain(saved_at_most + 1..);
            first_free(output, SAVED_PREFIX, numbers, |saved| name(&folder, saved))?;
        }
        _ => {
            for lane in LANES {
                let to = output.join(lane);
                name(&folder.join(lane), &to).map_err(|source| create_error(&to, source))?;
            }
            fs::remove_dir(&folder).map_err(write_error(&folder))?;
        }
    }
    sync(output)
}

/// Removes a log before it is closed, so that the disk need not write the rest.
fn remove(files: LogFiles) -> Result<(), LogError> {
    for lane in LANES {
        let path = files.folder.join(lane);
        fs::remove_file(&path).map_err(write_error(&path))?;
    }
    fs::remove_dir(&files.folder).map_err(write_error(&files.folder))
}

/// Gives the first free name to what `create` creates under it; returns its path.
fn first_free(
    output: &Path,
    prefix: &str,
    numbers: impl Iterator<Item = u64>,
    create: impl Fn(&Path) -> io::Result<()>,
) -> Result<PathBuf, LogError> {
    let mut path = PathBuf::new();
    for number in numbers {
        path = output.join(format!("{prefix}{number}"));
        match create(&path) {
            Err(source) if source.kind() == ErrorKind::AlreadyExists => {}
            done => return done.map_err(|source| create_error(&path, source)).map(|()| path),
        }
    }
    Err(LogError::Exists { path })
}

/// Renames, without replacing anything.
fn name(from: &Path, to: &Path) -> io::Result<()> {
    match renameat_with(CWD, from, CWD, to, RenameFlags::NOREPLACE) {
        // File systems without this flag.
        Err(Errno::INVAL | Errno::NOSYS) if to.symlink_metadata().is_ok() => Err(Errno::EXIST.into()),
        Err(Errno::INVAL | Errno::NOSYS) => fs::rename(from, to),
        other => Ok(other?),
    }
}

fn sync(folder: &Path) -> Result<(), LogError> {
    output_file::sync_folder(folder).map_err(write_error(folder))
}

fn write_error(path: &Path) -> impl FnOnce(io::Error) -> LogError + use<'_> {
    move |source| LogError::Write { path: path.into(), source }
}
