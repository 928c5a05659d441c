//! Simulations of experiments, several at a time.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use identify::quantity::Kind;
use identify::signal::Trace;
use identify::study::{ColumnOrValue, CommandTable, Commands};
use messages::{Command, State, Tick};
use xray::from_scene::scene_c_arm;
use zerocopy::IntoBytes;

use super::IsToEnd;
use super::open::{CommandRows, OpenedCommands, OpenedStudy};
use crate::error::SimError;
use crate::shared::SharedScene;
use crate::simulator::Sim;

/// Ticks between two questions whether to end.
const LOOK_TICKS: u64 = 64;

/// One simulation to run.
#[derive(Debug, Clone)]
pub(super) struct Job {
    /// Index of the experiment.
    pub experiment: usize,
    /// Values of the parameters.
    pub values: Vec<f64>,
}

/// Traces of an experiment's measured quantities, or why its scene is refused or fails.
pub(super) type Traces = Result<Arc<Vec<Trace>>, String>;

/// Runs jobs on all cores; results are in their order and do not depend on the number of cores.
///
/// # Errors
/// A failure of the machine; [`SimError::GivenUp`] on request.
pub(super) fn run_all(
    study: &OpenedStudy,
    jobs: &[Job],
    is_to_end: IsToEnd<'_>,
) -> Result<Vec<Traces>, SimError> {
    let next = AtomicUsize::new(0);
    let results: Mutex<Vec<Option<Traces>>> = Mutex::new(vec![None; jobs.len()]);
    let failure: Mutex<Option<SimError>> = Mutex::new(None);
    let work = || {
        loop {
            let index = next.fetch_add(1, Ordering::Relaxed);
            let has_failed = failure.lock().unwrap_or_else(PoisonError::into_inner).is_some();
            let Some(job) = jobs.get(index).filter(|_| !has_failed) else { return };
            let traces = match simulated(study, job, is_to_end, &mut |_| Ok(())) {
                Ok(traces) => Ok(Arc::new(traces)),
                Err(error) if error.is_of_the_machine() || matches!(error, SimError::GivenUp { .. }) => {
                    failure.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
                    return;
                }
                Err(error) => {
                    let name = &study.study.experiments[job.experiment].name;
                    Err(format!("experiment `{name}`: {error}"))
                }
            };
            if let Some(place) = results.lock().unwrap_or_else(PoisonError::into_inner).get_mut(index) {
                *place = Some(traces);
            }
        }
    };
    let cores = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
    let threads = cores.min(jobs.len());
    std::thread::scope(|scope| {
        for number in 1..threads {
            let thread = std::thread::Builder::new().name(format!("identify-{number}"));
            // With fewer threads the work takes longer, and its results are the same.
            let _ = thread.spawn_scoped(scope, work);
        }
        work();
    });
    if let Some(error) = failure.into_inner().unwrap_or_else(PoisonError::into_inner) {
        return Err(error);
    }
    let results = results.into_inner().unwrap_or_else(PoisonError::into_inner);
    results.into_iter().map(|traces| traces.ok_or(SimError::Gone)).collect()
}

/// Runs an experiment and records its measured quantities at every tick. `prepare` gets the simulation at
/// tick 0, for example to record it.
pub(super) fn simulated(
    study: &OpenedStudy,
    job: &Job,
    is_to_end: IsToEnd<'_>,
    prepare: &mut dyn FnMut(&mut Sim) -> Result<(), SimError>,
) -> Result<Vec<Trace>, SimError> {
    let (experiment, opened) = (&study.study.experiments[job.experiment], &study.experiments[job.experiment]);
    let settings = study.settings(job.experiment, &job.values);
    let shared = SharedScene::of_source(Some(&opened.shared), opened.source.clone(), &settings, None)?;
    let needs_c_arm = experiment.measured.iter().any(|it| it.quantity.kind == Kind::Pixel);
    let c_arm = match (&shared.scene().drr, needs_c_arm) {
        (Some(drr), true) => Some(scene_c_arm(drr)?),
        (None, true) => return Err(SimError::NoXRay),
        _ => None,
    };
    let project = |point_m: [f64; 3]| {
        let seen = c_arm.as_ref()?.project(point_m)?;
        Some([seen.column, seen.row])
    };
    let mut sim = Sim::new(&shared, &opened.drive)?;
    prepare(&mut sim)?;
    let start: State = *sim.state();
    let dt_s = shared.scene().dt_s();
    let trace = |measured: &identify::study::Measured| {
        let width = measured.columns.len();
        Trace { dt_s, width, values: Vec::with_capacity((opened.ticks as usize + 1) * width) }
    };
    let mut traces: Vec<Trace> = experiment.measured.iter().map(trace).collect();
    let look = |sim: &Sim, traces: &mut Vec<Trace>| {
        for (measured, trace) in experiment.measured.iter().zip(traces) {
            let quantity = &measured.quantity;
            quantity.values(sim.state(), &start, &project, trace.width, &mut trace.values);
        }
    };
    look(&sim, &mut traces);
    let mut player = Player::of(study, job, &sim);
    for tick in 0..opened.ticks {
        if tick % LOOK_TICKS == 0 && is_to_end() {
            return Err(SimError::GivenUp { tick: Tick(tick) });
        }
        match &opened.commands {
            OpenedCommands::Scene => sim.step(&[], 1)?,
            OpenedCommands::Log(latched) => match latched.get(tick as usize) {
                Some(latched) => sim.follow(latched)?,
                None => return Err(SimError::CommandCount { given: latched.len(), driven: sim.driven() }),
            },
            OpenedCommands::Table(rows) => {
                let commands = player.commands(rows, tick as f64 * dt_s);
                sim.step(commands, 1)?;
            }
        }
        look(&sim, &mut traces);
    }
    sim.close_recording()?;
    Ok(traces)
}

/// Turns rows of a file into commands: each holds until the next row.
struct Player<'a> {
    table: Option<&'a CommandTable>,
    /// Gain, bias and unit of each column.
    scales: Vec<(f64, f64, f64)>,
    /// Next row.
    next: usize,
    commands: Vec<Command>,
    /// Index of the driven controller among those that the caller drives.
    driven: usize,
}

impl<'a> Player<'a> {
    fn of(study: &'a OpenedStudy, job: &Job, sim: &Sim) -> Player<'a> {
        let table = match &study.study.experiments[job.experiment].commands {
            Commands::Table(table) => Some(table),
            _ => None,
        };
        let columns = table.map(|table| table.columns.as_slice()).unwrap_or_default();
        let scale = |column: &identify::study::CommandColumn| {
            let (gain, bias) = study.study.command(column, &job.values);
            (gain, bias, column.unit)
        };
        let names = sim.driven();
        let controller = table.and_then(|table| table.controller.as_ref());
        Player {
            table,
            scales: columns.iter().map(scale).collect(),
            next: 0,
            commands: vec![Command::zeroed(); names.len()],
            driven: controller
                .and_then(|name| names.iter().position(|driven| driven == name))
                .unwrap_or_default(),
        }
    }

    /// Returns the commands at a time, one for each driven controller.
    fn commands(&mut self, rows: &CommandRows, time_s: f64) -> &[Command] {
        // Half a nanosecond, for times that are multiples of the tick in decimal.
        let is_due = |row: usize| rows.times_s.get(row).is_some_and(|due| *due <= time_s + 5e-10);
        let before = self.next;
        while is_due(self.next) {
            self.next += 1;
        }
        let (Some(table), true) = (self.table, self.next > before) else { return &self.commands };
        let Some(command) = self.commands.get_mut(self.driven) else { return &self.commands };
        [command.tendon_mode, command.arm_mode, command.burr_mode, command.tube_mode] = table.modes;
        let places = table.columns.iter().zip(&rows.fields).zip(&self.scales).zip(&rows.columns);
        for (((column, field), (gain, bias, unit)), values) in places {
            let value = match column.from {
                ColumnOrValue::Value(value) => value,
                // A missing value leaves the last one.
                ColumnOrValue::Column(_) => match values.get(self.next - 1) {
                    Some(value) if value.is_finite() => *value,
                    _ => continue,
                },
            };
            field.put_f64(command.as_mut_bytes(), (gain * value + bias) * unit);
        }
        &self.commands
    }
}
