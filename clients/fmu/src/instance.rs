//! One instance of an FMU.

use std::collections::BTreeMap;
use std::ffi::CString;
use std::path::{Path, PathBuf};

use messages::{Command, SensorReading, State};
use sim::{Batch, Drive, SharedScene, Sim, Snapshot, View};
use zerocopy::{FromBytes, IntoBytes};

use crate::error::FmuError;
use crate::export::{DRIVE_FILE, SCENE_FILE, token};
use crate::variables::{Causality, Kind, Place, Start, Variable, Variables};

/// Most ticks in one step: more than a day of simulated time.
const MOST_TICKS: u64 = 100_000_000;
/// How far, as a share of a tick, a master's times may be from whole ticks: the rounding of its sums.
const TIME_SHARE: f64 = 1e-3;

/// A value of one element.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Value {
    Float(f64),
    Whole(u64),
    Signed(i64),
    Flag(bool),
}

impl Value {
    /// The nearest `f64`, for FMI 2.0's reals.
    pub fn as_f64(self) -> f64 {
        match self {
            Value::Float(value) => value,
            Value::Whole(value) => value as f64,
            Value::Signed(value) => value as f64,
            Value::Flag(value) => f64::from(u8::from(value)),
        }
    }
}

/// What a master has done with the instance.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    Instantiated,
    Initialising,
    Stepping,
    Terminated,
}

/// What an FMU state holds: everything that a step changes.
#[derive(Clone)]
struct Saved {
    snapshot: Snapshot,
    values: Values,
}

/// Values at a communication point.
#[derive(Clone)]
struct Values {
    /// Commands of the controllers that the caller drives.
    commands: Vec<Command>,
    state: State,
    /// Newest reading of each sensor.
    readings: Vec<SensorReading>,
}

/// An instance.
pub(crate) struct Instance {
    folder: PathBuf,
    drive: Drive,
    batch: Batch,
    variables: Variables,
    settings: BTreeMap<String, Value>,
    pub start_s: f64,
    dt_s: f64,
    values: Values,
    phase: Phase,
    saved: BTreeMap<u64, Saved>,
    /// Number of states saved so far.
    states: u64,
    /// Texts and frames handed out, valid until the next call.
    pub texts: Vec<CString>,
    pub frame: Vec<u8>,
}

fn file(path: &Path) -> Result<String, FmuError> {
    std::fs::read_to_string(path)
        .map_err(|cause| FmuError::File { path: path.display().to_string(), reason: cause.to_string() })
}

fn values_of(sim: &mut Sim, commands: Vec<Command>) -> Values {
    let count = sim.shared().scene().sensor.len();
    let mut readings: Vec<SensorReading> = (0..count)
        .map(|index| SensorReading { sensor_index: index as u32, ..SensorReading::zeroed() })
        .collect();
    newest(&mut readings, &sim.readings());
    Values { commands, state: *sim.state(), readings }
}

fn newest(kept: &mut [SensorReading], arrived: &[SensorReading]) {
    for reading in arrived {
        if let Some(place) = kept.get_mut(reading.sensor_index as usize) {
            *place = *reading;
        }
    }
}

fn started(
    shared: std::sync::Arc<SharedScene>,
    drive: Drive,
) -> Result<(Batch, Variables, Values, f64), FmuError> {
    let dt_s = shared.scene().dt_s();
    let batch = Batch::of(vec![Box::new(move || Sim::new(&shared, &drive))], 1)?;
    let (variables, values) = batch.with(0, |sim| {
        let commands = vec![Command::zeroed(); sim.driven().len()];
        Ok((Variables::of(sim), values_of(sim, commands)))
    })?;
    Ok((batch, variables, values, dt_s))
}

impl Instance {
    /// Creates an instance from the resources of an FMU.
    ///
    /// # Errors
    /// If the scene is refused, or the token is not that of the resources.
    pub fn new(folder: &Path, given: &str) -> Result<Instance, FmuError> {
        let (scene, drive) = (file(&folder.join(SCENE_FILE))?, file(&folder.join(DRIVE_FILE))?);
        let expected = token(&scene, &drive);
        if given != expected {
            return Err(FmuError::Token { given: given.to_owned(), expected });
        }
        let names: Vec<String> = drive.lines().map(str::to_owned).collect();
        let shared = SharedScene::load(Some(&folder.join(SCENE_FILE)), &[], None)?;
        let drive = Drive::These(names);
        let (batch, variables, values, dt_s) = started(shared, drive.clone())?;
        Ok(Instance {
            folder: folder.to_owned(),
            drive,
            batch,
            variables,
            settings: BTreeMap::new(),
            start_s: 0.0,
            dt_s,
            values,
            phase: Phase::Instantiated,
            saved: BTreeMap::new(),
            states: 0,
            texts: Vec::new(),
            frame: Vec::new(),
        })
    }

    /// Sets the start time and enters initialisation.
    pub fn initialise(&mut self, start_s: f64) -> Result<(), FmuError> {
        if self.phase != Phase::Instantiated {
            return Err(FmuError::Phase("initialisation mode follows instantiation or reset"));
        }
        self.start_s = start_s;
        self.phase = Phase::Initialising;
        Ok(())
    }

    /// Ends initialisation: loads the scene again if parameters were set.
    pub fn begin(&mut self) -> Result<(), FmuError> {
        if self.phase != Phase::Initialising {
            return Err(FmuError::Phase("initialisation mode has not been entered"));
        }
        if !self.settings.is_empty() {
            let setting = |(key, value): (&String, &Value)| match value {
                Value::Float(value) => format!("{key}={value:?}"),
                Value::Whole(value) => format!("{key}={value}"),
                Value::Signed(value) => format!("{key}={value}"),
                Value::Flag(value) => format!("{key}={value}"),
            };
            let settings: Vec<String> = self.settings.iter().map(setting).collect();
            let shared = SharedScene::load(Some(&self.folder.join(SCENE_FILE)), &settings, None)?;
            let commands = std::mem::take(&mut self.values.commands);
            let (batch, _, values, dt_s) = started(shared, self.drive.clone())?;
            (self.batch, self.dt_s) = (batch, dt_s);
            self.values = Values { commands, ..values };
        }
        self.phase = Phase::Stepping;
        Ok(())
    }

    pub fn terminate(&mut self) -> Result<(), FmuError> {
        self.phase = Phase::Terminated;
        Ok(())
    }

    /// Returns to the state after instantiation.
    pub fn reset(&mut self) -> Result<(), FmuError> {
        if !self.settings.is_empty() {
            self.settings.clear();
            let shared = SharedScene::load(Some(&self.folder.join(SCENE_FILE)), &[], None)?;
            (self.batch, _, self.values, self.dt_s) = started(shared, self.drive.clone())?;
        } else {
            self.values = self.batch.with(0, |sim| {
                sim.reset()?;
                let commands = vec![Command::zeroed(); sim.driven().len()];
                Ok(values_of(sim, commands))
            })?;
        }
        self.saved.clear();
        self.phase = Phase::Instantiated;
        Ok(())
    }

    fn time_s(&self) -> f64 {
        self.start_s + self.values.state.tick as f64 * self.dt_s
    }

    /// Runs the ticks of a step; returns the time after it.
    pub fn step(&mut self, from_s: f64, step_s: f64) -> Result<f64, FmuError> {
        if self.phase != Phase::Stepping {
            return Err(FmuError::Phase("a step follows initialisation"));
        }
        let own_s = self.time_s();
        // False for NaN.
        let is_here = (from_s - own_s).abs() <= 0.5 * self.dt_s;
        if !is_here {
            return Err(FmuError::Time { given_s: from_s, own_s });
        }
        let ticks = (step_s / self.dt_s).round();
        let is_whole = (step_s - ticks * self.dt_s).abs() <= TIME_SHARE * self.dt_s;
        if !(is_whole && (1.0..=MOST_TICKS as f64).contains(&ticks)) {
            return Err(FmuError::Step { step_s, dt_s: self.dt_s, most: MOST_TICKS });
        }
        let commands = self.values.commands.clone();
        let (state, arrived) = self.batch.with(0, move |sim| {
            sim.step(&commands, ticks as u64)?;
            Ok((*sim.state(), sim.readings()))
        })?;
        self.values.state = state;
        newest(&mut self.values.readings, &arrived);
        Ok(self.time_s())
    }

    /// Finds a variable. With `whole` the reference must be an array's first element, which then stands for
    /// all (FMI 3.0); otherwise it is that of one element.
    pub fn find(&self, reference: u32, whole: bool) -> Result<(&Variable, usize, usize), FmuError> {
        let unknown = || FmuError::NoVariable { kind: "known", reference };
        let (variable, element) = self.variables.find(reference).ok_or_else(unknown)?;
        match (whole, element) {
            (true, 0) => Ok((variable, 0, variable.elements())),
            (true, _) => Err(unknown()),
            (false, element) => Ok((variable, element, 1)),
        }
    }

    /// Returns the values of a variable.
    pub fn get(&self, reference: u32, whole: bool) -> Result<(Kind, Vec<Value>), FmuError> {
        let (variable, first, count) = self.find(reference, whole)?;
        let bytes: &[u8] = match &variable.place {
            Place::Time => return Ok((variable.kind, vec![Value::Float(self.time_s())])),
            Place::Key(key, start) => {
                let own = match start {
                    Start::Float(value) => Value::Float(*value),
                    Start::Whole(value) => Value::Signed(*value),
                    Start::Flag(value) => Value::Flag(*value),
                };
                return Ok((variable.kind, vec![self.settings.get(key).copied().unwrap_or(own)]));
            }
            Place::Hash | Place::XRay => {
                return Err(FmuError::NoVariable { kind: "numeric", reference });
            }
            Place::Command(index, _) => self.values.commands[*index].as_bytes(),
            Place::State(_) => self.values.state.as_bytes(),
            Place::Reading(index, _) => self.values.readings[*index].as_bytes(),
        };
        let (Place::Command(_, offset) | Place::State(offset) | Place::Reading(_, offset)) = variable.place
        else {
            return Err(FmuError::Defect);
        };
        let value = |index: usize| {
            let bytes = bytes.get(variable.offset(offset, first + index)..)?;
            Some(match variable.kind {
                Kind::Float64 => Value::Float(f64::from_le_bytes(*bytes.first_chunk()?)),
                Kind::UInt32 => Value::Whole(u32::from_le_bytes(*bytes.first_chunk()?).into()),
                _ => Value::Whole(u64::from_le_bytes(*bytes.first_chunk()?)),
            })
        };
        let values: Option<Vec<Value>> = (0..count).map(value).collect();
        Ok((variable.kind, values.ok_or(FmuError::Defect)?))
    }

    /// Sets a variable's values: inputs at any time before the end, parameters before initialisation ends.
    pub fn set(&mut self, reference: u32, whole: bool, values: &[Value]) -> Result<(), FmuError> {
        let (variable, first, count) = self.find(reference, whole)?;
        let (kind, name, causality) = (variable.kind, variable.name.clone(), variable.causality);
        if values.len() != count {
            return Err(FmuError::Count { given: values.len(), expected: count });
        }
        let refused = |when| Err(FmuError::NotSettable { name: name.clone(), when });
        match (&variable.place, causality) {
            (Place::Key(key, _), _) if matches!(self.phase, Phase::Instantiated | Phase::Initialising) => {
                let key = key.clone();
                self.settings.insert(key, values[0]);
                Ok(())
            }
            (Place::Key(..), _) => refused("after initialisation: it is a parameter"),
            (Place::Command(index, offset), Causality::Input) => {
                let (index, offset) = (*index, variable.offset(*offset, first));
                let mut bytes = [0; size_of::<Command>()];
                bytes.copy_from_slice(self.values.commands[index].as_bytes());
                for (number, value) in values.iter().enumerate() {
                    let (place, written) = match (kind, value) {
                        (Kind::Float64, Value::Float(value)) => {
                            (offset + 8 * number, value.to_le_bytes().to_vec())
                        }
                        (Kind::UInt32, Value::Whole(value)) => {
                            let Ok(value) = u32::try_from(*value) else {
                                return refused("to a number above 4294967295");
                            };
                            (offset + 4 * number, value.to_le_bytes().to_vec())
                        }
                        _ => return refused("as this type"),
                    };
                    bytes[place..place + written.len()].copy_from_slice(&written);
                }
                self.values.commands[index] =
                    Command::read_from_bytes(&bytes).map_err(|_| FmuError::Defect)?;
                Ok(())
            }
            _ => refused("at all: it is an output"),
        }
    }

    /// Returns the text of a string variable.
    pub fn text(&self, reference: u32) -> Result<String, FmuError> {
        match &self.find(reference, true)?.0.place {
            Place::Hash => {
                let [low, high] = self.values.state.hash;
                Ok(format!("{high:016x}{low:016x}"))
            }
            _ => Err(FmuError::NoVariable { kind: "string", reference }),
        }
    }

    /// Renders the X-ray frame of a binary variable.
    pub fn binary(&self, reference: u32) -> Result<Vec<u8>, FmuError> {
        match &self.find(reference, true)?.0.place {
            Place::XRay => {
                let rendered = self.batch.with(0, |sim| sim.render(View::Scene))?;
                Ok(rendered.pixels.as_bytes().to_vec())
            }
            _ => Err(FmuError::NoVariable { kind: "binary", reference }),
        }
    }

    /// Saves the present state, in the place of an earlier one if `id` is one; returns its number.
    pub fn save(&mut self, id: u64) -> Result<u64, FmuError> {
        let snapshot = self.batch.with(0, |sim| Ok(sim.snapshot()))?;
        Ok(self.keep(id, snapshot, self.values.clone()))
    }

    fn keep(&mut self, id: u64, snapshot: Snapshot, values: Values) -> u64 {
        let id = if self.saved.contains_key(&id) {
            id
        } else {
            self.states += 1;
            self.states
        };
        self.saved.insert(id, Saved { snapshot, values });
        id
    }

    pub fn restore(&mut self, id: u64) -> Result<(), FmuError> {
        let saved = self.saved.get(&id).ok_or(FmuError::Handle { what: "FMU state" })?.clone();
        self.batch.restore(vec![saved.snapshot])?;
        self.values = saved.values;
        self.phase = Phase::Stepping;
        Ok(())
    }

    pub fn free(&mut self, id: u64) -> Result<(), FmuError> {
        self.saved.remove(&id).map(|_| ()).ok_or(FmuError::Handle { what: "FMU state" })
    }

    /// Returns a saved state as bytes: commands and readings, then the simulation's keyframe.
    pub fn serialise(&self, id: u64) -> Result<Vec<u8>, FmuError> {
        let saved = self.saved.get(&id).ok_or(FmuError::Handle { what: "FMU state" })?;
        let snapshot = saved.snapshot.clone();
        let keyframe = self.batch.with(0, move |sim| {
            let here = sim.snapshot();
            sim.restore(&snapshot)?;
            let keyframe = sim.keyframe();
            sim.restore(&here)?;
            keyframe
        })?;
        Ok([saved.values.commands.as_bytes(), saved.values.readings.as_bytes(), &keyframe].concat())
    }

    /// Saves the state of [`Instance::serialise`]; returns its number.
    pub fn deserialise(&mut self, bytes: &[u8]) -> Result<u64, FmuError> {
        let too_short = || FmuError::Count { given: bytes.len(), expected: bytes.len() + 1 };
        let mut values = self.values.clone();
        let mut rest = bytes;
        for command in &mut values.commands {
            (*command, rest) = Command::read_from_prefix(rest).map_err(|_| too_short())?;
        }
        for reading in &mut values.readings {
            (*reading, rest) = SensorReading::read_from_prefix(rest).map_err(|_| too_short())?;
        }
        let keyframe = rest.to_vec();
        let (snapshot, state) = self.batch.with(0, move |sim| {
            let here = sim.snapshot();
            sim.restore_keyframe(&keyframe)?;
            let (snapshot, state) = (sim.snapshot(), *sim.state());
            sim.restore(&here)?;
            Ok((snapshot, state))
        })?;
        values.state = state;
        Ok(self.keep(0, snapshot, values))
    }

    /// Returns the derivative of outputs after the next tick by inputs, times `seed`.
    pub fn derivative(
        &self,
        unknowns: &[u32],
        knowns: &[u32],
        seed: &[f64],
        whole: bool,
    ) -> Result<Vec<f64>, FmuError> {
        let signals = |references: &[u32], causality, prefix: &dyn Fn(&Variable) -> usize| {
            let mut names = Vec::new();
            for reference in references {
                let (variable, first, count) = self.find(*reference, whole)?;
                if variable.causality != causality || variable.kind != Kind::Float64 {
                    return Err(FmuError::NoVariable { kind: "differentiable", reference: *reference });
                }
                let name = &variable.name[prefix(variable)..];
                match variable.length {
                    None => names.push(name.to_owned()),
                    Some(_) => names.extend((first..first + count).map(|i| format!("{name}[{i}]"))),
                }
            }
            Ok(names)
        };
        // Names are `state.FIELD` and `CONTROLLER.FIELD`.
        let after_dot = |variable: &Variable| variable.name.find('.').map_or(0, |at| at + 1);
        let outputs = signals(unknowns, Causality::Output, &after_dot)?;
        let inputs = signals(knowns, Causality::Input, &after_dot)?;
        if inputs.len() != seed.len() {
            return Err(FmuError::Count { given: seed.len(), expected: inputs.len() });
        }
        let (commands, rows, width) = (self.values.commands.clone(), outputs.len(), inputs.len());
        let derivatives =
            self.batch.with(0, move |sim| sim.output_derivatives(&commands, &inputs, &outputs))?;
        let row =
            |i: usize| derivatives[i * width..(i + 1) * width].iter().zip(seed).map(|(a, b)| a * b).sum();
        Ok((0..rows).map(row).collect())
    }
}
