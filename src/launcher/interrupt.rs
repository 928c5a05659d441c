//! What a signal to the launcher does at each stage of a run. It is answered by a thread of its own, so that it is heard
//! while a volume is read or a picture drawn.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use ipc_types::signals::{Ask, EndRequest};

use super::part;
use crate::failure::EXIT_INTERRUPTED;
use crate::printer;

/// How long the launcher may take to go when all its parts have been killed.
const URGENT_LIMIT: Duration = Duration::from_secs(2);

#[derive(Debug)]
enum Stage {
    /// Nothing runs, nothing is to be lost: a signal ends the process, and these folders, if they are empty, go with it.
    Before(Vec<PathBuf>),
    /// Parts run, or end.
    Running,
    /// The logs are whole; their report is being made.
    Reporting,
}

/// Hears the signals of a run.
#[derive(Debug)]
pub struct Interrupts {
    /// For whoever makes the run.
    pub end: EndRequest,
    stage: Arc<Mutex<Stage>>,
}

impl Interrupts {
    /// From now on signals are answered.
    ///
    /// # Errors
    /// The system refuses to install a handler, or to start the thread.
    pub fn hear() -> std::io::Result<Interrupts> {
        let stage = Arc::new(Mutex::new(Stage::Before(Vec::new())));
        let seen = Arc::clone(&stage);
        // The lock is held to the end of the process: no stage begins behind the decision to leave.
        let end = EndRequest::answered(move |ask| answer(&lock(&seen), ask))?;
        Ok(Interrupts { end, stage })
    }

    /// Makes the run's folder; a signal that comes before the run begins removes it and what was made above it.
    ///
    /// # Errors
    /// What `make` says.
    pub fn make_folder(
        &self,
        parent: &Path,
        make: impl FnOnce(&Path) -> std::io::Result<PathBuf>,
    ) -> std::io::Result<PathBuf> {
        let mut stage = lock(&self.stage);
        // What is there before this run stays.
        let made: Vec<PathBuf> =
            parent.ancestors().take_while(|folder| !folder.exists()).map(Path::to_owned).collect();
        let folder = make(parent)?;
        *stage = Stage::Before(std::iter::once(folder.clone()).chain(made).collect());
        Ok(folder)
    }

    /// From now on there is something to lose. Returns the folders that hold nothing yet.
    pub fn run_begins(&self) -> Vec<PathBuf> {
        match std::mem::replace(&mut *lock(&self.stage), Stage::Running) {
            Stage::Before(folders) => folders,
            Stage::Running | Stage::Reporting => Vec::new(),
        }
    }

    /// The logs are finished, and everything has ended.
    pub fn report_begins(&self) {
        *lock(&self.stage) = Stage::Reporting;
    }
}

fn lock(stage: &Mutex<Stage>) -> MutexGuard<'_, Stage> {
    stage.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Removes folders as far as they are empty, the innermost first.
pub fn remove_empty(folders: &[PathBuf]) {
    for folder in folders {
        let _ = std::fs::remove_dir(folder);
    }
}

fn answer(stage: &Stage, ask: Ask) {
    // Whoever signals does not wait for a terminal that is stopped.
    printer::hurry();
    let (Ask::First(signal) | Ask::Again(signal)) = ask;
    match (stage, ask) {
        (Stage::Before(folders), _) => {
            remove_empty(folders);
            tell!("trabecula: {signal}: ended before anything had begun");
            printer::leave(EXIT_INTERRUPTED);
        }
        (Stage::Reporting, _) => {
            tell!("trabecula: {signal}: the logs are whole, pictures and summary.json may be missing");
            printer::leave(EXIT_INTERRUPTED);
        }
        (Stage::Running, Ask::First(_)) => {
            tell!(
                "trabecula: {signal}: the run ends and its log is finished; a second signal ends all at once"
            );
        }
        (Stage::Running, Ask::Again(_)) => {
            part::end_all_at_once();
            // The launcher clears up what the parts leave; should it hang, the next run does.
            std::thread::spawn(|| {
                std::thread::sleep(URGENT_LIMIT);
                std::process::exit(EXIT_INTERRUPTED.into());
            });
            tell!("trabecula: {signal}: everything ends at once; `trabecula log repair` finishes the log");
        }
    }
}
