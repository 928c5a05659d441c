//! Simulations of experiments, several at a time.

use std::sync::Arc;

use identify::quantity::Kind;
use identify::signal::Trace;
use identify::study::{ColumnOrValue, CommandTable, Commands};
use inputs::volume_source::VolumeFiles;
use messages::{Command, State, Tick};
use xray::from_scene::scene_c_arm;
use zerocopy::IntoBytes;

use super::IsToEnd;
use super::open::{CommandRows, OpenedCommands, OpenedStudy};
use crate::error::SimError;
use crate::parallel::on_all_cores;
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
    on_all_cores("identify", jobs, |job| match simulated(study, job, is_to_end, &mut |_| Ok(())) {
        Ok(traces) => Ok(Ok(Arc::new(traces))),
        Err(error) if error.is_of_the_machine() || matches!(error, SimError::GivenUp { .. }) => Err(error),
        Err(error) => {
            let name = &study.study.experiments[job.experiment].name;
            Ok(Err(format!("experiment `{name}`: {error}")))
        }
    })
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
    let (source, files) = (opened.source.clone(), VolumeFiles::default());
    let shared = SharedScene::of_source(Some(&opened.shared), source, &settings, None, files)?;
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
                let commands = player.commands(rows, tick as f64 * dt_s, dt_s);
                sim.step(commands, 1)?;
            }
        }
        look(&sim, &mut traces);
    }
    sim.close_recording()?;
    Ok(traces)
}

/// Turns rows of a file into commands: each holds until the next row. A row that takes effect within a tick
/// counts for the rest of it, so that a command depends smoothly on its delay.
struct Player<'a> {
    table: Option<&'a CommandTable>,
    columns: Vec<Playing>,
    commands: Vec<Command>,
    /// Index of the driven controller among those that the caller drives.
    driven: usize,
}

/// Where a column is.
struct Playing {
    gain: f64,
    bias: f64,
    /// Size of the unit in SI units.
    unit: f64,
    delay_s: f64,
    /// Next row.
    next: usize,
    /// Value of the last row with one, in SI units.
    held: Option<f64>,
}

/// Half a nanosecond, for times that are multiples of the tick in decimal.
const ROUNDING_S: f64 = 5e-10;

impl<'a> Player<'a> {
    fn of(study: &'a OpenedStudy, job: &Job, sim: &Sim) -> Player<'a> {
        let table = match &study.study.experiments[job.experiment].commands {
            Commands::Table(table) => Some(table),
            _ => None,
        };
        let columns = table.map(|table| table.columns.as_slice()).unwrap_or_default();
        let playing = |column: &identify::study::CommandColumn| {
            let (gain, bias, delay_s) = study.study.command(column, &job.values);
            Playing { gain, bias, unit: column.unit, delay_s, next: 0, held: None }
        };
        let names = sim.driven();
        let controller = table.and_then(|table| table.controller.as_ref());
        Player {
            table,
            columns: columns.iter().map(playing).collect(),
            commands: vec![Command::zeroed(); names.len()],
            driven: controller
                .and_then(|name| names.iter().position(|driven| driven == name))
                .unwrap_or_default(),
        }
    }

    /// Returns the commands of a tick, one for each driven controller.
    fn commands(&mut self, rows: &CommandRows, time_s: f64, dt_s: f64) -> &[Command] {
        let Some((table, command)) = self.table.zip(self.commands.get_mut(self.driven)) else {
            return &self.commands;
        };
        for (((column, playing), field), values) in
            table.columns.iter().zip(&mut self.columns).zip(&rows.fields).zip(&rows.columns)
        {
            let value = |row: usize| match column.from {
                ColumnOrValue::Value(value) => Some(value),
                // A missing value leaves the last one.
                ColumnOrValue::Column(_) => values.get(row).copied().filter(|value| value.is_finite()),
            };
            if let Some(value) = playing.mean(&rows.times_s, value, time_s, dt_s) {
                [command.tendon_mode, command.arm_mode, command.burr_mode, command.tube_mode] = table.modes;
                field.put_f64(command.as_mut_bytes(), value);
            }
        }
        &self.commands
    }
}

impl Playing {
    /// Returns the mean over a tick, in SI units; `None` before the first row.
    fn mean(
        &mut self,
        times_s: &[f64],
        value: impl Fn(usize) -> Option<f64>,
        time_s: f64,
        dt_s: f64,
    ) -> Option<f64> {
        let (mut sum, mut from) = (0.0, 0.0);
        while let Some(row_s) = times_s.get(self.next) {
            let due = row_s + self.delay_s - time_s;
            if due >= dt_s - ROUNDING_S {
                break;
            }
            if let Some(value) = value(self.next) {
                // The first row, and one at the beginning of the tick, count for all of it.
                if let (Some(held), true) = (self.held, due > ROUNDING_S) {
                    sum += held * (due - from);
                    from = due;
                }
                self.held = Some((self.gain * value + self.bias) * self.unit);
            }
            self.next += 1;
        }
        let held = self.held?;
        Some(if from > 0.0 { (sum + held * (dt_s - from)) / dt_s } else { held })
    }
}
