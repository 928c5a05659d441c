//! Handles signals to the launcher at each stage of a run, in a dedicated thread, so that the launcher
//! responds even while it reads a volume or draws a figure.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use ipc_types::process::{EndRequest, EndSignal};

use super::part;
use crate::failure::EXIT_INTERRUPTED;
use crate::printer;

/// Timeout for the launcher to exit once all its parts have been killed.
const EXIT_LIMIT: Duration = Duration::from_secs(2);

#[derive(Debug)]
enum Stage {
    /// No part runs yet and nothing can be lost: a signal ends the process and removes these folders if
    /// empty.
    Before(Vec<PathBuf>),
    /// Parts are running or ending.
    Running,
    /// The logs are complete; the report is being written.
    Reporting,
    /// Everything is written; the viewer still shows the log. Holds the run's exit code.
    Shown(u8),
}

/// Handles the signals of a run.
#[derive(Debug)]
pub struct Interrupts {
    /// The end request, for the code that drives the run.
    pub end: EndRequest,
    stage: Arc<Mutex<Stage>>,
}

impl Interrupts {
    /// Starts handling signals.
    ///
    /// # Errors
    /// The handler cannot be installed, or the thread cannot be started.
    pub fn install() -> std::io::Result<Interrupts> {
        let stage = Arc::new(Mutex::new(Stage::Before(Vec::new())));
        let seen = Arc::clone(&stage);
        // The thread holds the lock until the process ends, so that no new stage begins once it has decided
        // to exit.
        let end = EndRequest::answered(move |signal| answer(&lock(&seen), signal))?;
        Ok(Interrupts { end, stage })
    }

    /// Creates the run's folder. A signal before the run starts removes it, with any parent folders created
    /// for it.
    pub fn make_folder(
        &self,
        parent: &Path,
        make: impl FnOnce(&Path) -> std::io::Result<PathBuf>,
    ) -> std::io::Result<PathBuf> {
        let mut stage = lock(&self.stage);
        // Folders that existed before this run stay.
        let made: Vec<PathBuf> =
            parent.ancestors().take_while(|folder| !folder.exists()).map(Path::to_owned).collect();
        let folder = make(parent)?;
        *stage = Stage::Before(std::iter::once(folder.clone()).chain(made).collect());
        Ok(folder)
    }

    /// Marks the run as started, so that data can be lost from now on. Returns the folders that are still
    /// empty.
    pub fn run_begins(&self) -> Vec<PathBuf> {
        match std::mem::replace(&mut *lock(&self.stage), Stage::Running) {
            Stage::Before(folders) => folders,
            Stage::Running | Stage::Reporting | Stage::Shown(_) => Vec::new(),
        }
    }

    /// Marks the logs as finished and all parts as ended.
    pub fn report_begins(&self) {
        *lock(&self.stage) = Stage::Reporting;
    }

    /// Marks everything as written, with the exit code to use on a signal.
    pub fn showing_begins(&self, code: u8) {
        *lock(&self.stage) = Stage::Shown(code);
    }
}

fn lock(stage: &Mutex<Stage>) -> MutexGuard<'_, Stage> {
    stage.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Removes empty folders, innermost first.
pub fn remove_empty(folders: &[PathBuf]) {
    for folder in folders {
        let _ = std::fs::remove_dir(folder);
    }
}

fn answer(stage: &Stage, signal: EndSignal) {
    // Do not wait for a stopped terminal.
    printer::hurry();
    let (EndSignal::First(name) | EndSignal::Repeated(name)) = signal;
    match (stage, signal) {
        (Stage::Before(folders), _) => {
            remove_empty(folders);
            tell!("trabecula: {name}: stopped before the run started");
            printer::leave(EXIT_INTERRUPTED);
        }
        (Stage::Reporting, _) => {
            tell!("trabecula: {name}: the logs are complete, but figures and summary.json may be missing");
            printer::leave(EXIT_INTERRUPTED);
        }
        (Stage::Shown(code), _) => printer::leave(*code),
        (Stage::Running, EndSignal::First(_)) => {
            tell!(
                "trabecula: {name}: stopping the run and finishing its log; a second signal kills \
                 everything at once"
            );
        }
        (Stage::Running, EndSignal::Repeated(_)) => {
            part::end_all_at_once();
            // The launcher cleans up after its parts; if it hangs, the next run cleans up.
            // Without a thread there is no limit.
            let _ = std::thread::Builder::new().spawn(|| {
                std::thread::sleep(EXIT_LIMIT);
                std::process::exit(EXIT_INTERRUPTED.into());
            });
            tell!("trabecula: {name}: killing everything; use `trabecula log repair` on the log");
        }
    }
}
