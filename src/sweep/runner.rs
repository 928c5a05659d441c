//! Runs the points of a sweep that have no row yet, several concurrently.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use ipc_types::process::EXIT_BAD_INPUT;
use ipc_types::scene::Controller;
use serde_json::Value;
use sim::{SharedScene, SimError};
use sweep::{Point, Record};

use super::folder::{Folder, OpenedStudy, refuse_external};
use super::in_process::{self, PointOutcome};
use super::launched;
use super::row::{Ending, Row};
use crate::failure::Failure;

/// The points of a study that a process runs: all whose number modulo `of` is `index`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shard {
    /// Index of the shard, from 0.
    pub index: u64,
    /// Number of shards.
    pub of: u64,
}

impl Shard {
    /// Returns the name of its table.
    pub fn table(self) -> String {
        format!("shard-{}-of-{}.parquet", self.index, self.of)
    }

    /// Returns the numbers of its points.
    pub fn points(self, count: u64) -> impl Iterator<Item = u64> {
        (self.index..count).step_by(usize::try_from(self.of).unwrap_or(usize::MAX))
    }
}

/// Progress of a sweep.
#[derive(Debug, Clone, Copy)]
pub struct Progress {
    /// Requested points that have a row.
    pub done: u64,
    pub of: u64,
    pub made: u64,
    pub elapsed_s: f64,
}

/// Points to run and number of jobs.
#[derive(Debug, Clone)]
pub struct Work {
    pub points: Vec<u64>,
    pub jobs: usize,
}

/// Runs the points without a row and reports each new row. Ends early when `is_to_end` returns true,
/// abandoning the runs in progress.
///
/// # Errors
/// The study's scene is invalid without any setting; a row or a log cannot be written; a run is out of memory
/// or threads.
pub fn run(
    study: &OpenedStudy,
    folder: &Folder,
    work: &Work,
    is_to_end: &(dyn Fn() -> bool + Sync),
    tell: &(dyn Fn(&Row, Progress) + Sync),
) -> Result<(), Failure> {
    let began = Instant::now();
    let mut left = Vec::new();
    let mut progress = Progress { done: 0, of: work.points.len() as u64, made: 0, elapsed_s: 0.0 };
    for &point in &work.points {
        match folder.row(point)? {
            Some(_) => progress.done += 1,
            None => left.push(point),
        }
    }
    let next = AtomicU64::new(0);
    let first = Mutex::new(None);
    let progress = Mutex::new(progress);
    let failure: Mutex<Option<Failure>> = Mutex::new(None);
    let worker = || -> Result<(), Failure> {
        let mut volumes = Volumes { own: None, first: &first };
        loop {
            let has_failed = failure.lock().unwrap_or_else(PoisonError::into_inner).is_some();
            let Some(&index) = left.get(next.fetch_add(1, Ordering::Relaxed) as usize) else { return Ok(()) };
            if has_failed || is_to_end() {
                return Ok(());
            }
            let PointOutcome::Ended(row) = one(study, folder, index, &mut volumes, is_to_end)? else {
                return Ok(());
            };
            folder.keep(&row)?;
            let mut progress = progress.lock().unwrap_or_else(PoisonError::into_inner);
            progress.done += 1;
            progress.made += 1;
            progress.elapsed_s = began.elapsed().as_secs_f64();
            tell(&row, *progress);
        }
    };
    let note = |result: Result<(), Failure>| {
        if let Err(error) = result {
            failure.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
        }
    };
    std::thread::scope(|scope| {
        for number in 0..work.jobs.min(left.len()) {
            let thread = std::thread::Builder::new().name(format!("sweep-{number}"));
            if let Err(cause) = thread.spawn_scoped(scope, || note(worker())) {
                note(Err(Failure::failed(format!(
                    "thread {} of {} cannot be started: {cause}",
                    number + 1,
                    work.jobs
                ))));
                return;
            }
        }
    });
    failure.into_inner().unwrap_or_else(PoisonError::into_inner).map_or(Ok(()), Err)
}

/// Caches a worker's scene so that its next one can share the volume. The first scene is shared by all
/// workers, so that only one reads the volume.
struct Volumes<'a> {
    own: Option<Arc<SharedScene>>,
    first: &'a Mutex<Option<Arc<SharedScene>>>,
}

impl Volumes<'_> {
    /// Loads the scene with these settings.
    fn load(&mut self, study: &OpenedStudy, settings: &[String]) -> Result<Arc<SharedScene>, SimError> {
        let beside = |other: Option<&SharedScene>| {
            SharedScene::load_beside(other, study.scene.as_deref(), settings, None)
        };
        let shared = match &self.own {
            Some(own) => beside(Some(own))?,
            None => {
                let mut first = self.first.lock().unwrap_or_else(PoisonError::into_inner);
                let shared = beside(first.as_deref())?;
                first.get_or_insert_with(|| Arc::clone(&shared));
                shared
            }
        };
        self.own = Some(Arc::clone(&shared));
        Ok(shared)
    }
}

/// Runs a point.
fn one(
    study: &OpenedStudy,
    folder: &Folder,
    index: u64,
    volumes: &mut Volumes,
    is_to_end: &dyn Fn() -> bool,
) -> Result<PointOutcome, Failure> {
    let point = study.study.point(index);
    let mut row = empty_row(study, &point)?;
    let settings = study.settings(&point);
    let shared = match volumes.load(study, &settings) {
        Ok(shared) => shared,
        Err(SimError::Input(failure)) if failure.code == EXIT_BAD_INPUT => {
            row.outcome = Ending::Refused;
            row.reason = Some(failure.message);
            return Ok(PointOutcome::Ended(Box::new(row)));
        }
        Err(other) => return Err(Failure::failed(other)),
    };
    refuse_external(shared.scene())?;
    let has_programs = shared.scene().controller.iter().any(Controller::is_program);
    let is_session = has_programs || study.study.record == Record::Frames;
    if is_session || study.study.record == Record::All {
        row.log = Some(folder.claim_run(index)?);
    }
    let run_folder = row.log.as_ref().map(|run| folder.path().join(run));
    match run_folder {
        Some(run_folder) if is_session => {
            launched::run(&study.arguments(&point), row, &run_folder, is_to_end)
        }
        run_folder => in_process::run(&shared, row, run_folder, is_to_end),
    }
}

fn empty_row(study: &OpenedStudy, point: &Point) -> Result<Row, Failure> {
    let value = |(key, value): &(String, toml::Value)| (key.clone(), json_of(value));
    Ok(Row {
        point: point.index,
        parameters: point.values.iter().map(value).collect(),
        outcome: Ending::Failed,
        reason: None,
        ticks: 0,
        simulated_s: 0.0,
        final_hash: None,
        tool: None,
        drilling: None,
        plan: None,
        structures: Vec::new(),
        breaches: 0,
        log: None,
        command: study.command(point)?,
    })
}

fn json_of(value: &toml::Value) -> Value {
    match value {
        toml::Value::Integer(number) => Value::from(*number),
        toml::Value::Float(number) => Value::from(*number),
        toml::Value::Boolean(yes) => Value::from(*yes),
        toml::Value::String(text) => Value::from(text.clone()),
        other => Value::from(other.to_string()),
    }
}
