//! `trabecula log export --dataset lerobot`: runs as demonstrations, with what was observed and commanded.

mod pictures;

use std::io::BufWriter;
use std::path::Path;

use clap::Args;
use foreign_text::{counted, foreign_path};
use ipc_types::messages::layout::Message;
use ipc_types::messages::{Command, Latched, SensorReading, State, Tick};
use ipc_types::scene::Scene;
use output_file::OutputFile;
use recorder_proc::log_file::{LogFile, log_path};
use run_log::columns::{Column, columns};
use run_log::{LogSource, MessageStream, ReadOptions, Topic, Verdict};
use serde_json::json;
use zerocopy::{FromBytes, IntoBytes};

use super::dataset::{judged_all, refuse_used, refused, worst, write};
use super::export::ExportArguments;
use crate::dataset::lerobot::{Episode, Features, LeRobot, Picture, Row};
use crate::failure::Failure;
use crate::report::course::{Course, distance_m};
use crate::report::outcome;
use pictures::Pictures;

/// Fields of the state in `observation.state` by default.
const OBSERVED: [&str; 8] = [
    "t_world_flange",
    "t_world_burr",
    "bend_rad",
    "tendon_tension_n",
    "tendon_displacement_m",
    "burr_speed_rad_per_s",
    "burr_force_n",
    "flange_wrench",
];

/// Fields of the command in `action` by default.
const COMMANDED: [&str; 6] = [
    "tendon_force_n",
    "tendon_displacement_m",
    "arm_axis",
    "arm_depth_m",
    "arm_speed_m_per_s",
    "burr_speed_rad_per_s",
];

/// Arguments of `--dataset lerobot`.
#[derive(Debug, Args)]
pub struct Demonstration {
    /// With `--dataset lerobot`: a field of `/state`, or the name of a sensor, in `observation.state` (may be
    /// repeated); default: flange, burr, bend, tendons and forces.
    #[arg(long = "observation", value_name = "FIELD")]
    observations: Vec<String>,
    /// With `--dataset lerobot`: a field of the latched command in `action` (may be repeated); default:
    /// tendons, insertion and burr speed.
    #[arg(long = "action", value_name = "FIELD")]
    actions: Vec<String>,
    /// With `--dataset lerobot`: the controller whose commands are the actions; default: the scene's only
    /// one.
    #[arg(long, value_name = "NAME")]
    controller: Option<String>,
    /// With `--dataset lerobot`: the task in words; default: the scene's name.
    #[arg(long, value_name = "TEXT")]
    task: Option<String>,
}

impl Demonstration {
    /// Returns the first of its flags that is given.
    pub(super) fn given(&self) -> Option<&'static str> {
        [
            ("--observation", !self.observations.is_empty()),
            ("--action", !self.actions.is_empty()),
            ("--controller", self.controller.is_some()),
            ("--task", self.task.is_some()),
        ]
        .into_iter()
        .find_map(|(flag, is_given)| is_given.then_some(flag))
    }
}

/// Exports the data set.
///
/// # Errors
/// Not a log of this build, an unknown field or controller, no rows in this range of ticks, incompatible
/// runs, a folder that is not empty (2); a log with a gap in these ticks, a damaged log, a full disk (1); a
/// log that is truncated or was not ended (3).
pub fn export(arguments: &ExportArguments) -> Result<(), Failure> {
    refuse_used(&arguments.output)?;
    let sources =
        arguments.logs.iter().map(|log| Source::open(log, arguments)).collect::<Result<Vec<_>, _>>()?;
    let Some(first) = sources.first() else {
        return Err(Failure::bad_input("--dataset: expected at least one log"));
    };
    for source in &sources {
        source.refuse_other_than(first)?;
    }
    let mut set = LeRobot::new(first.features.clone(), first.rate_hz, "trabecula");
    let mut verdicts = Vec::with_capacity(sources.len());
    for source in sources {
        verdicts.push(Export { set: &mut set, arguments, source }.take()?);
    }
    let [episodes, rows] = set.counts();
    if rows == 0 {
        return Err(Failure::bad_input("--dataset: the logs have no rows in this range of ticks"));
    }
    let files = set.end().map_err(not_encoded)?;
    files.into_iter().try_for_each(|file| write(&arguments.output, file))?;
    let figures = json!({"episodes": episodes, "rows": rows});
    let said = format!("{} in {}", counted(rows, "row"), counted(episodes, "episode"));
    arguments.say(&said, figures, &worst(&verdicts));
    judged_all(&arguments.logs, &verdicts)
}

fn not_encoded(cause: impl std::fmt::Display) -> Failure {
    Failure::failed(format!("the data set cannot be encoded: {cause}"))
}

/// An element of `observation.state`.
enum Observation {
    Field(Column),
    /// The values of the sensor with this index.
    Sensor(usize, usize),
}

/// A log that is to be exported.
struct Source {
    file: LogFile,
    scene: Scene,
    dt_ns: u64,
    rate_hz: u32,
    task: String,
    controller: usize,
    observations: Vec<Observation>,
    actions: Vec<Column>,
    features: Features,
}

impl Source {
    /// Checks what a log offers against what was asked for.
    fn open(log: &Path, arguments: &ExportArguments) -> Result<Source, Failure> {
        let path = log_path(log);
        let file = LogFile::at(&path);
        let stream = MessageStream::open(&file, ReadOptions::default())?;
        let scene = Scene::parse(&stream.header().scene_toml, &path).map_err(Failure::bad_input)?;
        let asked = &arguments.demonstration;
        let picture = scene.drr.as_ref().filter(|drr| drr.rate_hz > 0.0).map(|drr| [drr.columns, drr.rows]);
        let (observations, state) = observed(&file, &scene, &asked.observations)?;
        let actions = columns(Command::DESCRIPTION, &or_default(&asked.actions, &COMMANDED))?;
        let has_reward = Course::of(&scene, None).target_m.is_some();
        let action = actions.iter().map(|column| column.name.clone()).collect();
        Ok(Source {
            dt_ns: stream.header().dt_ns.max(1),
            rate_hz: rate_hz(arguments.rate, &scene)?,
            task: asked.task.clone().unwrap_or_else(|| scene.name.clone()),
            controller: controller(&path, &scene, asked.controller.as_deref())?,
            observations,
            actions,
            features: Features { state, action, picture, has_reward },
            file,
            scene,
        })
    }

    fn refuse_other_than(&self, first: &Source) -> Result<(), Failure> {
        let what = if self.features.picture != first.features.picture {
            "its frames have another size than those of the first log"
        } else if self.features.has_reward != first.features.has_reward {
            "a target is set either in this log or in the first one, expected in both or neither"
        } else if self.features != first.features {
            "its sensors have another number of values than those of the first log"
        } else if self.rate_hz != first.rate_hz {
            "its X-ray has another rate than that of the first log; set --rate"
        } else {
            return Ok(());
        };
        Err(refused(self.file.path(), what))
    }

    /// Returns the tick of a row.
    fn tick_of(&self, start: u64, row: u64) -> u64 {
        start + (row as f64 * 1e9 / (f64::from(self.rate_hz) * self.dt_ns as f64)).round() as u64
    }
}

fn or_default(given: &[String], default: &[&str]) -> Vec<String> {
    if given.is_empty() { default.iter().map(|name| (*name).to_owned()).collect() } else { given.to_vec() }
}

fn rate_hz(given: Option<f64>, scene: &Scene) -> Result<u32, Failure> {
    let most = (1000.0 / scene.run.dt_ms).floor().min(1000.0);
    let allowed = |rate: f64| rate.fract() == 0.0 && (1.0..=most).contains(&rate);
    match given {
        Some(rate) if !allowed(rate) => {
            Err(Failure::bad_input(format!("--rate is {rate}; allowed: a whole number, 1 to {most}")))
        }
        Some(rate) => Ok(rate as u32),
        None => {
            let of_scene = scene.drr.as_ref().map(|drr| drr.rate_hz).filter(|rate| allowed(*rate));
            Ok(of_scene.unwrap_or(30.0).min(most) as u32)
        }
    }
}

/// Returns the index of the controller whose commands are the actions.
fn controller(path: &Path, scene: &Scene, given: Option<&str>) -> Result<usize, Failure> {
    let names = || scene.controller.iter().map(|c| c.name.as_str()).collect::<Vec<_>>().join(", ");
    match given {
        Some(name) => scene.controller.iter().position(|c| c.name == name).ok_or_else(|| {
            refused(path, &format!("--controller: no controller `{name}`; the scene has {}", names()))
        }),
        None => match scene.controller.len() {
            1 => Ok(0),
            0 => Err(refused(path, "the scene has no controller, so there are no actions")),
            _ => Err(refused(path, &format!("choose one with --controller: the scene has {}", names()))),
        },
    }
}

/// Returns the elements of `observation.state` and their names.
fn observed(
    file: &LogFile,
    scene: &Scene,
    asked: &[String],
) -> Result<(Vec<Observation>, Vec<String>), Failure> {
    let (mut observations, mut names) = (Vec::new(), Vec::new());
    for field in or_default(asked, &OBSERVED) {
        if let Some(index) = scene.sensor.iter().position(|sensor| sensor.name == field) {
            let count = values_of(file, index)?
                .ok_or_else(|| refused(file.path(), &format!("sensor `{field}` has no valid reading")))?;
            observations.extend((0..count).map(|place| Observation::Sensor(index, place)));
            names.extend((0..count).map(|place| format!("{field}[{place}]")));
            continue;
        }
        for column in columns(State::DESCRIPTION, &[field])? {
            names.push(column.name.clone());
            observations.push(Observation::Field(column));
        }
    }
    Ok((observations, names))
}

/// Returns the number of values of a sensor, from its first valid reading.
fn values_of(file: &LogFile, sensor: usize) -> Result<Option<usize>, Failure> {
    let topics = [Topic::Sensor.name().to_owned()];
    let mut stream = MessageStream::open_topics(file, &topics, ReadOptions::default())?;
    while let Some(message) = stream.next_message()? {
        let Ok(reading) = SensorReading::read_from_bytes(message.body) else { continue };
        if reading.sensor_index as usize == sensor && reading.is_valid() {
            return Ok(Some(reading.values().len()));
        }
    }
    Ok(None)
}

type File = BufWriter<std::fs::File>;

/// The export of one log.
struct Export<'a> {
    set: &'a mut LeRobot,
    arguments: &'a ExportArguments,
    source: Source,
}

/// An episode in progress, from the first row that has everything.
struct Running {
    file: OutputFile,
    episode: Episode<File>,
    start: u64,
    rows: u64,
    /// The last row, which lacks its reward, and the distance from the target at its tick.
    open: Option<(Row, f64)>,
}

impl Export<'_> {
    /// Exports a log to its end.
    fn take(&mut self) -> Result<Verdict, Failure> {
        let topics = [Topic::State, Topic::Latched, Topic::Sensor].map(|topic| topic.name().to_owned());
        let mut stream = MessageStream::open_topics(&self.source.file, &topics, ReadOptions::default())?;
        let mut pictures = Pictures::open(&self.source.file, self.source.features.picture.is_some())?;
        let mut readings: Vec<Option<Vec<f64>>> = vec![None; self.source.scene.sensor.len()];
        let mut course = Course::of(&self.source.scene, None);
        let mut running: Option<Running> = None;
        let mut now: Option<Box<State>> = None;
        while let Some(message) = stream.next_message()? {
            match message.known {
                Some(Topic::State) => {
                    let Ok(state) = State::read_from_bytes(message.body) else { continue };
                    if let Some(before) = now.as_ref().filter(|before| before.tick + 1 != state.tick) {
                        let what = format!("ticks {} to {} are missing", before.tick + 1, state.tick);
                        return Err(Failure::failed(format!(
                            "{}: {what}",
                            foreign_path(self.source.file.path())
                        )));
                    }
                    course.add(&state);
                    now = Some(Box::new(state));
                }
                Some(Topic::Sensor) => {
                    let Ok(reading) = SensorReading::read_from_bytes(message.body) else { continue };
                    if let Some(slot) =
                        readings.get_mut(reading.sensor_index as usize).filter(|_| reading.is_valid())
                    {
                        *slot = Some(reading.values().to_vec());
                    }
                }
                Some(Topic::Latched) => {
                    let Ok(latched) = Latched::read_from_bytes(message.body) else { continue };
                    if latched.reset == 1 {
                        self.end(running.take(), &course)?;
                        course = Course::of(&self.source.scene, None);
                    } else if let Some(state) = now.as_ref().filter(|state| state.tick == latched.tick) {
                        self.latch(&mut running, state, &latched, &readings, &mut pictures, &course)?;
                    }
                }
                _ => {}
            }
        }
        self.end(running, &course)?;
        Ok(pictures.verdict()?.unwrap_or_else(|| stream.verdict()))
    }

    /// Adds the row of a tick, if it has one.
    fn latch(
        &mut self,
        running: &mut Option<Running>,
        state: &State,
        latched: &Latched,
        readings: &[Option<Vec<f64>>],
        pictures: &mut Pictures,
        course: &Course,
    ) -> Result<(), Failure> {
        let next = running.as_ref().map(|running| self.source.tick_of(running.start, running.rows));
        if !self.arguments.ticks().contains(Tick(state.tick)) || next.is_some_and(|next| next != state.tick) {
            return Ok(());
        }
        let picture = pictures.at(state.tick)?;
        let Some(row) = self.row(state, latched, readings, picture, pictures.are_expected()) else {
            return Ok(());
        };
        let running = match running {
            Some(running) => running,
            None => running.insert(self.start(state.tick)?),
        };
        let distance_m = from_target_m(state, course);
        running.close(distance_m)?;
        running.open = Some((row, distance_m));
        running.rows += 1;
        Ok(())
    }

    /// Returns the row of a tick, or `None` if something that it needs has not arrived yet.
    fn row(
        &self,
        state: &State,
        latched: &Latched,
        readings: &[Option<Vec<f64>>],
        picture: Option<Picture>,
        has_picture: bool,
    ) -> Option<Row> {
        if has_picture && picture.is_none() {
            return None;
        }
        let value = |observation: &Observation| match observation {
            Observation::Field(column) => Some(column.value(state.as_bytes())?.nearest_f64() as f32),
            Observation::Sensor(index, place) => Some(*readings.get(*index)?.as_ref()?.get(*place)? as f32),
        };
        let command = latched.commands.get(self.source.controller)?.command;
        let commanded = |column: &Column| Some(column.value(command.as_bytes())?.nearest_f64() as f32);
        Some(Row {
            state: self.source.observations.iter().map(value).collect::<Option<_>>()?,
            action: self.source.actions.iter().map(commanded).collect::<Option<_>>()?,
            picture,
            reward: 0.0,
        })
    }

    fn start(&mut self, tick: u64) -> Result<Running, Failure> {
        let path = self.arguments.output.join(self.set.next_file());
        let parent = output_file::folder_of(&path);
        output_file::create_folder(parent).map_err(Failure::folder(parent))?;
        let file = OutputFile::create(&path)?;
        let out = BufWriter::new(file.handle()?);
        let episode = self.set.start(out, &self.source.task).map_err(not_encoded)?;
        Ok(Running { file, episode, start: tick, rows: 0, open: None })
    }

    /// Ends an episode.
    fn end(&mut self, running: Option<Running>, course: &Course) -> Result<(), Failure> {
        let Some(mut running) = running else { return Ok(()) };
        let last = course.last.as_ref().map_or(0.0, |state| from_target_m(state, course));
        running.close(last)?;
        let success = outcome::reached_target(&self.source.scene, course);
        let out = self.set.add(running.episode, success).map_err(not_encoded)?;
        out.into_inner().map_err(not_encoded)?;
        Ok(running.file.keep()?)
    }
}

impl Running {
    /// Adds the open row: its reward is how much nearer to the target the burr has come since, in mm.
    fn close(&mut self, distance_m: f64) -> Result<(), Failure> {
        let Some((row, before_m)) = self.open.take() else { return Ok(()) };
        let reward = ((before_m - distance_m) * 1e3) as f32;
        self.episode.add(Row { reward, ..row }).map_err(not_encoded)
    }
}

/// Distance of the burr from the scene's target; 0 without one.
fn from_target_m(state: &State, course: &Course) -> f64 {
    course.target_m.map_or(0.0, |target_m| distance_m(target_m, state.t_world_burr.position_m))
}
