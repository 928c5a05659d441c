//! A study with its scenes, commands and measured rows.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use foreign_text::foreign_path;
use identify::signal::{RowCount, Rows};
use identify::study::{
    ClockZero, ColumnOrValue, CommandTable, Commands, Experiment, Role, SignalPart, Source, Study, Target,
};
use inputs::failure::Failure;
use inputs::scenes::{BuiltIn, SceneSource};
use inputs::volume_source::VolumeFiles;
use messages::Latched;
use messages::layout::Message;
use recorder_proc::log_file::{LogFile, log_path};
use run_log::LogReader;
use run_log::columns::{Column, columns};

use crate::error::SimError;
use crate::shared::SharedScene;
use crate::simulator::Drive;

/// A study that is ready to be fitted.
#[derive(Debug)]
pub struct OpenedStudy {
    /// The study.
    pub study: Study,
    pub(super) experiments: Vec<OpenedExperiment>,
    /// Settings that give arrays a value before one of their elements is set.
    pub(super) arrays: Vec<String>,
    /// Coordinates of the first starting point.
    pub(super) start: Vec<f64>,
}

/// An experiment with its files.
#[derive(Debug)]
pub(super) struct OpenedExperiment {
    pub source: SceneSource,
    /// The scene without parameters; others share its volume.
    pub shared: Arc<SharedScene>,
    pub drive: Drive,
    pub commands: OpenedCommands,
    pub ticks: u64,
    /// Rows of each measured quantity, within the simulated time.
    pub data: Vec<(Rows, RowCount)>,
}

#[derive(Debug)]
pub(super) enum OpenedCommands {
    Scene,
    Log(Vec<Latched>),
    Table(CommandRows),
}

/// Rows of commands; times are those of the simulation.
#[derive(Debug)]
pub(super) struct CommandRows {
    pub times_s: Vec<f64>,
    /// A column for each of the table's; constants have none.
    pub columns: Vec<Vec<f64>>,
    pub fields: Vec<Column>,
}

/// Returns a path relative to a folder.
fn beside(folder: &Path, path: &Path) -> PathBuf {
    folder.join(path)
}

/// Returns the value at a key's path in a table.
pub(super) fn lookup<'a>(table: &'a toml::Table, key: &str) -> Option<&'a toml::Value> {
    let mut parts = key.split('.');
    let mut value = table.get(parts.next()?)?;
    for part in parts {
        value = match value {
            toml::Value::Table(table) => table.get(part)?,
            toml::Value::Array(array) => array.get(part.parse::<usize>().ok()?)?,
            _ => return None,
        };
    }
    Some(value)
}

fn number(value: &toml::Value) -> Option<f64> {
    value.as_float().or_else(|| value.as_integer().map(|whole| whole as f64))
}

impl OpenedStudy {
    /// Reads a study and the files that it names, with paths relative to it.
    ///
    /// # Errors
    /// Bad input: not a study; a scene is refused; a key is unknown; a measured file cannot be read, lacks a
    /// column, or has no row within the simulated time.
    pub fn open(file: &Path) -> Result<OpenedStudy, SimError> {
        let text = inputs::text::read(file)?;
        let study = Study::parse(&text, file).map_err(Failure::bad_input)?;
        let folder = file.parent().unwrap_or(Path::new(""));
        OpenedStudy::of(study, folder, true)
    }

    /// As [`OpenedStudy::open`], but reads no measured files: for [`OpenedStudy::simulate`].
    ///
    /// # Errors
    /// As [`OpenedStudy::open`].
    pub fn open_without_measurements(file: &Path) -> Result<OpenedStudy, SimError> {
        let text = inputs::text::read(file)?;
        let study = Study::parse(&text, file).map_err(Failure::bad_input)?;
        let folder = file.parent().unwrap_or(Path::new(""));
        OpenedStudy::of(study, folder, false)
    }

    /// Opens the files of a study; `folder` is where its paths begin.
    ///
    /// # Errors
    /// As [`OpenedStudy::open`].
    pub fn of(study: Study, folder: &Path, with_measurements: bool) -> Result<OpenedStudy, SimError> {
        let mut experiments: Vec<OpenedExperiment> = Vec::new();
        for experiment in &study.experiments {
            let first = experiments.first().map(|first| Arc::clone(&first.shared));
            experiments.push(opened(&study, experiment, folder, first.as_deref(), with_measurements)?);
        }
        let mut opened = OpenedStudy { study, experiments, arrays: Vec::new(), start: Vec::new() };
        opened.arrays = opened.array_settings()?;
        opened.check_keys()?;
        opened.start = opened.starting_point()?;
        Ok(opened)
    }

    /// Returns the scene of the first experiment as a table.
    pub(super) fn scene_table(&self) -> Result<toml::Table, SimError> {
        let scene = toml::Table::try_from(self.experiments[0].shared.scene());
        scene.map_err(|cause| SimError::SceneText(cause.to_string()))
    }

    /// Returns `KEY=[…]` for every array of which a parameter sets an element and that a scene leaves out.
    fn array_settings(&self) -> Result<Vec<String>, SimError> {
        let scene = self.scene_table()?;
        let text = self.experiments[0].source.text()?;
        let written = text.parse::<toml::Table>().unwrap_or_default();
        let mut settings: Vec<String> = Vec::new();
        for target in &self.study.targets {
            let Target::Scene(key) = target else { continue };
            let Some((array, index)) = key.rsplit_once('.') else { continue };
            if index.parse::<usize>().is_err() || lookup(&written, array).is_some() {
                continue;
            }
            let setting = match lookup(&scene, array) {
                Some(value) => format!("{array}={value}"),
                // Without `[truth]`, its three-component keys are zero.
                None if array.starts_with("truth.") => format!("{array}=[0.0, 0.0, 0.0]"),
                None => continue,
            };
            if !settings.contains(&setting) {
                settings.push(setting);
            }
        }
        Ok(settings)
    }

    /// Refuses keys that a scene does not have.
    fn check_keys(&self) -> Result<(), SimError> {
        for (index, experiment) in self.study.experiments.iter().enumerate() {
            let middle: Vec<f64> = self.study.parameters.iter().map(|it| it.value(0.5)).collect();
            let settings = self.settings(index, &middle);
            let with = self.experiments[index].source.clone().with(&settings)?;
            with.has_the_keys().map_err(|failure| Failure {
                message: format!("experiment `{}`: {}", experiment.name, failure.message),
                ..failure
            })?;
        }
        Ok(())
    }

    /// Returns all settings of an experiment's scene for values of the parameters.
    pub(super) fn settings(&self, experiment: usize, values: &[f64]) -> Vec<String> {
        let own = &self.study.experiments[experiment].set;
        [own.as_slice(), &self.arrays, &self.study.settings(values)].concat()
    }

    /// Returns the coordinates to start from: those of the study, of the scene, or the middle.
    fn starting_point(&self) -> Result<Vec<f64>, SimError> {
        let scene = self.scene_table()?;
        let own = |target: &Target| -> Option<f64> {
            match target {
                Target::Scene(key) => {
                    let assumed = key.strip_prefix("truth.").unwrap_or(key);
                    lookup(&scene, key).or_else(|| lookup(&scene, assumed)).and_then(number)
                }
                Target::ClockOffset { experiment } => {
                    Some(self.study.experiments[*experiment].clock_offset_s)
                }
                Target::Measured { name, part } => {
                    let mut all = self.study.experiments.iter().flat_map(|it| &it.measured);
                    all.find(|measured| measured.name == *name).and_then(|it| part.get(&it.signal))
                }
                Target::Command { name, part } => {
                    let columns = self.study.experiments.iter().filter_map(|it| match &it.commands {
                        Commands::Table(table) => Some(&table.columns),
                        _ => None,
                    });
                    let column = columns.flatten().find(|column| column.name == *name)?;
                    Some(match part {
                        identify::study::CommandPart::Gain => column.gain,
                        identify::study::CommandPart::Bias => column.bias,
                        identify::study::CommandPart::Delay => column.delay_s * 1e3,
                    })
                }
            }
        };
        let pairs = self.study.parameters.iter().zip(&self.study.targets);
        let unit = |(parameter, target): (&identify::Parameter, &Target)| {
            let given = parameter.start.or_else(|| own(target));
            let within = given.filter(|value| (parameter.min..=parameter.max).contains(value));
            within.map_or(0.5, |value| parameter.unit(value))
        };
        Ok(pairs.map(unit).collect())
    }
}

fn opened(
    study: &Study,
    experiment: &Experiment,
    folder: &Path,
    first: Option<&SharedScene>,
    with_measurements: bool,
) -> Result<OpenedExperiment, SimError> {
    let named = |failure: Failure| Failure {
        message: format!("experiment `{}`: {}", experiment.name, failure.message),
        ..failure
    };
    let log = match &experiment.commands {
        Commands::Log(log) => Some(log_path(&beside(folder, log))),
        _ => None,
    };
    let latched = log.as_deref().map(latched).transpose().map_err(named)?;
    let source = match (&experiment.scene, &log, &latched) {
        (Some(scene), ..) => SceneSource::new(Some(&beside(folder, scene)), BuiltIn::Femur),
        (None, Some(log), Some((_, text))) => {
            SceneSource::Changed { source: Box::new(SceneSource::File(log.clone())), text: text.clone() }
        }
        _ => SceneSource::BuiltIn(BuiltIn::Femur),
    };
    let files = VolumeFiles::default();
    let shared = SharedScene::of_source(first, source.clone(), &experiment.set, None, files);
    let shared = shared.map_err(|error| match error {
        SimError::Input(failure) => SimError::Input(named(failure)),
        other => other,
    })?;
    let mut zero_s = 0.0;
    let is_relative = experiment.clock_zero == ClockZero::FirstRow;
    let first_time = |rows: &Rows| rows.times_s.iter().copied().filter(|t| t.is_finite()).reduce(f64::min);
    let (drive, commands) = match (&experiment.commands, latched) {
        (Commands::Table(table), _) => {
            let rows = command_rows(table, folder).map_err(named)?;
            if is_relative {
                zero_s = first_time(&rows).unwrap_or(0.0);
            }
            let (drive, rows) = table_commands(table, rows, zero_s, &shared).map_err(named)?;
            (drive, OpenedCommands::Table(rows))
        }
        (_, Some((latched, _))) => (Drive::Everything, OpenedCommands::Log(latched)),
        _ => {
            refuse_external(&shared).map_err(named)?;
            (Drive::Nothing, OpenedCommands::Scene)
        }
    };
    let mut data: Vec<Rows> = Vec::new();
    if with_measurements {
        for measured in &experiment.measured {
            let rows = match &measured.source {
                Some(source) => {
                    let source = Source { file: beside(folder, &source.file), ..source.clone() };
                    inputs::measurements::read(&source, &measured.columns).map_err(named)?
                }
                None => Rows::default(),
            };
            data.push(rows);
        }
    }
    if is_relative && !matches!(commands, OpenedCommands::Table(_)) {
        zero_s = data.iter().filter_map(first_time).reduce(f64::min).unwrap_or(0.0);
    }
    data.iter_mut().flat_map(|rows| &mut rows.times_s).for_each(|time_s| *time_s -= zero_s);
    let mut found = OpenedExperiment { source, shared, drive, commands, ticks: 0, data: Vec::new() };
    found.ticks = ticks(study, experiment, &found, &data);
    let end_s = found.ticks as f64 * found.shared.scene().dt_s();
    let index = study.experiments.iter().position(|it| it.name == experiment.name).unwrap_or(0);
    for (measured, rows) in experiment.measured.iter().zip(data) {
        let [early_s, late_s] = shifts(study, index, measured);
        let (used, count) = rows.within(early_s, late_s, end_s);
        if measured.source.is_some() && count.compared == 0 {
            return Err(named(no_overlap(measured, &rows, count, [early_s, late_s], end_s)).into());
        }
        found.data.push((used, count));
    }
    Ok(found)
}

/// Error of a measured quantity without a comparable row.
fn no_overlap(
    measured: &identify::study::Measured,
    rows: &Rows,
    count: RowCount,
    [early_s, late_s]: [f64; 2],
    end_s: f64,
) -> Failure {
    let name = &measured.name;
    let file = measured.source.as_ref().map(|source| foreign_path(&source.file).to_string());
    let file = file.unwrap_or_default();
    let times = rows.times_s.iter().copied().filter(|time| time.is_finite());
    let (first, last) =
        (times.clone().fold(f64::INFINITY, f64::min), times.fold(f64::NEG_INFINITY, f64::max));
    match () {
        () if count.rows == 0 => Failure::bad_input(format!("`{name}`: {file} has no rows")),
        () if count.outside + count.without_time < count.rows => {
            Failure::bad_input(format!("`{name}`: all values in {file} are missing"))
        }
        () => Failure::bad_input(format!(
            "`{name}`: no row of {file} lies within the simulated time, 0 to {end_s:.3} s: its times are \
             {first:.3} to {last:.3} s, less an offset and delay of {early_s:.3} to {late_s:.3} s; check \
             `time_unit`, `clock_offset_s` and `clock_zero`"
        )),
    }
}

/// Returns the smallest and the largest sum of clock offset and delay within the ranges, s.
fn shifts(study: &Study, experiment: usize, measured: &identify::study::Measured) -> [f64; 2] {
    [0.0, 1.0].map(|side| {
        let mut offset_s = study.experiments[experiment].clock_offset_s;
        let mut delay_s = measured.signal.delay_s;
        for (target, parameter) in study.targets.iter().zip(&study.parameters) {
            match target {
                Target::ClockOffset { experiment: at } if *at == experiment => {
                    offset_s = parameter.value(side);
                }
                Target::Measured { name, part: SignalPart::Delay } if *name == measured.name => {
                    delay_s = parameter.value(side) * 1e-3;
                }
                _ => {}
            }
        }
        offset_s + delay_s
    })
}

/// Returns how many ticks to simulate.
fn ticks(study: &Study, experiment: &Experiment, found: &OpenedExperiment, data: &[Rows]) -> u64 {
    let scene = found.shared.scene();
    let of_time = |time_s: f64| (time_s.min(3600.0) / scene.dt_s()).ceil().max(1.0) as u64;
    if let Some(duration_s) = experiment.duration_s {
        return of_time(duration_s);
    }
    let limit = match &found.commands {
        OpenedCommands::Log(latched) => latched.len() as u64,
        OpenedCommands::Scene => scene.tick_count(),
        OpenedCommands::Table(_) if data.iter().all(|rows| rows.times_s.is_empty()) => scene.tick_count(),
        OpenedCommands::Table(_) => u64::MAX,
    };
    let index = study.experiments.iter().position(|it| it.name == experiment.name).unwrap_or(0);
    let last = |(measured, rows): (&identify::study::Measured, &Rows)| {
        let last = rows.times_s.iter().copied().filter(|t| t.is_finite()).reduce(f64::max)?;
        Some(last - shifts(study, index, measured)[0])
    };
    let last = experiment.measured.iter().zip(data).filter_map(last).reduce(f64::max);
    match (experiment.role, last) {
        (Role::Fitted | Role::HeldOut, Some(last)) => of_time(last).min(limit),
        _ => limit.min(of_time(3600.0)),
    }
}

/// Refuses a scene without commands whose controller runs elsewhere.
fn refuse_external(shared: &SharedScene) -> Result<(), Failure> {
    let is_absent = |controller: &&scene::Controller| {
        (controller.external || controller.is_program()) && !controller.optional
    };
    match shared.scene().controller.iter().find(is_absent) {
        None => Ok(()),
        Some(absent) => Err(Failure::bad_input(format!(
            "controller `{}` is a separate program; name its recorded `commands`",
            absent.name
        ))),
    }
}

/// Returns the commands of a log, tick by tick, and its scene.
fn latched(log: &Path) -> Result<(Vec<Latched>, String), Failure> {
    let reader = LogReader::open(&LogFile::at(log))?;
    if reader.beginning().is_some() {
        let why = "the log does not begin at tick 0, so its commands cannot be repeated";
        return Err(Failure::bad_input(format!("{}: {why}", foreign_path(log))));
    }
    let text = reader.header().scene_toml.clone();
    let commands = reader.map(|record| Ok(record?.latched)).collect::<Result<Vec<Latched>, Failure>>()?;
    Ok((commands, text))
}

fn command_rows(table: &CommandTable, folder: &Path) -> Result<Rows, Failure> {
    let names: Vec<String> = table
        .columns
        .iter()
        .map(|column| match &column.from {
            ColumnOrValue::Column(name) => name.clone(),
            ColumnOrValue::Value(_) => String::new(),
        })
        .collect();
    let source = Source { file: beside(folder, &table.source.file), ..table.source.clone() };
    inputs::measurements::read(&source, &names)
}

fn table_commands(
    table: &CommandTable,
    rows: Rows,
    zero_s: f64,
    shared: &SharedScene,
) -> Result<(Drive, CommandRows), Failure> {
    let known = shared.scene().controller_names();
    let controller = match (&table.controller, known.as_slice()) {
        (Some(name), _) if known.contains(name) => name.clone(),
        (None, [only]) => only.clone(),
        (given, _) => {
            let given = given.as_ref().map_or("missing".to_owned(), |name| format!("`{name}`"));
            let why = "expected one of the scene's controllers";
            let list = known.join("`, `");
            return Err(Failure::bad_input(format!("`commands.controller` is {given}, {why}: `{list}`")));
        }
    };
    let file = foreign_path(&table.source.file).to_string();
    let times_s: Vec<f64> = rows.times_s.iter().map(|time| time - zero_s - table.clock_offset_s).collect();
    if times_s.is_empty() {
        return Err(Failure::bad_input(format!("{file}: no rows of commands")));
    }
    let is_ordered = |pair: &[f64]| pair[0] <= pair[1];
    if let Some(row) = times_s.windows(2).position(|pair| !is_ordered(pair)) {
        return Err(Failure::bad_input(format!(
            "{file}: the time of row {} of the commands is missing or before that of row {}",
            row + 2,
            row + 1
        )));
    }
    let field = |column: &identify::study::CommandColumn| {
        let found = columns(messages::Command::DESCRIPTION, std::slice::from_ref(&column.field));
        // The study has been checked for it.
        found.map_err(Failure::bad_input)?.pop().ok_or_else(|| Failure::bad_input("a command has no field"))
    };
    let fields = table.columns.iter().map(field).collect::<Result<_, _>>()?;
    Ok((Drive::These(vec![controller]), CommandRows { times_s, columns: rows.columns, fields }))
}
