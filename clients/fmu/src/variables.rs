//! The variables of a scene's FMU. Names, units and descriptions come from the messages' own tables.
//!
//! Names: `time`; `CONTROLLER.FIELD` of a command for inputs; `state.FIELD`, `sensor.NAME.*`, `hash` and
//! `x_ray` for outputs; `scene.KEY` for parameters. An array of FMI 3.0 is one variable with the reference of
//! its first element; FMI 2.0 has a variable for each element, with consecutive references.

use messages::layout::{Description, Element, Message};
use messages::{Command, MAX_SENSOR_VALUES, SensorReading, State};
use run_log::unit_of;
use sim::{Sim, used_elements};

/// Type of a variable's elements.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    Float64,
    UInt32,
    UInt64,
    Int64,
    Boolean,
    String,
    Binary,
}

impl Kind {
    /// Name of the type in a model description of FMI 3.0.
    pub fn name(self) -> &'static str {
        match self {
            Kind::Float64 => "Float64",
            Kind::UInt32 => "UInt32",
            Kind::UInt64 => "UInt64",
            Kind::Int64 => "Int64",
            Kind::Boolean => "Boolean",
            Kind::String => "String",
            Kind::Binary => "Binary",
        }
    }

    fn of_ros(name: &str) -> Option<Kind> {
        match name {
            "float64" => Some(Kind::Float64),
            "uint32" => Some(Kind::UInt32),
            "uint64" => Some(Kind::UInt64),
            _ => None,
        }
    }

    fn size(self) -> usize {
        match self {
            Kind::UInt32 => 4,
            _ => 8,
        }
    }
}

/// Role of a variable.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Causality {
    Independent,
    Parameter,
    Input,
    Output,
}

/// Where a variable's value is.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Place {
    Time,
    /// Offset in the command of the caller's controller with this number.
    Command(usize, usize),
    /// Offset in the state.
    State(usize),
    /// Offset in the newest reading of a sensor.
    Reading(usize, usize),
    Hash,
    XRay,
    /// Key of the scene, with its value there as TOML.
    Key(String, Start),
}

/// Value of a scene's key.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Start {
    Float(f64),
    Whole(i64),
    Flag(bool),
}

/// A variable.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Variable {
    pub reference: u32,
    pub name: String,
    pub kind: Kind,
    /// Number of elements if it is an array.
    pub length: Option<usize>,
    pub causality: Causality,
    pub unit: &'static str,
    pub description: String,
    pub place: Place,
}

impl Variable {
    /// Number of elements.
    pub fn elements(&self) -> usize {
        self.length.unwrap_or(1)
    }

    /// Offset in its message of element `index`.
    pub fn offset(&self, offset: usize, index: usize) -> usize {
        offset + index * self.kind.size()
    }
}

/// All variables, in ascending order of their references.
#[derive(Debug, Clone)]
pub(crate) struct Variables(pub Vec<Variable>);

/// Fields of a command that an instance fills in.
const FILLED_IN: [&str; 2] = ["sequence", "state_tick"];
/// Fields of a state that are no outputs: `hash` is one text, and lists of structures would be hundreds of
/// variables.
const LEFT_OUT: [&str; 3] = ["hash", "contacts", "applied"];
/// Scene keys that an instance sets itself, or that decide which variables there are.
const NO_PARAMETERS: [&str; 3] = ["run.mode", "manipulator.links", "recording"];

/// A field without further structure.
struct Leaf {
    path: String,
    ros_type: &'static str,
    length: Option<usize>,
    offset: usize,
    doc: String,
}

/// Where a nested message is: the path before its fields, its offset, and what it is.
#[derive(Clone, Copy)]
struct Above<'a> {
    prefix: &'a str,
    offset: usize,
    doc: &'a str,
}

const TOP: Above<'static> = Above { prefix: "", offset: 0, doc: "" };

fn leaves(message: &'static Description, above: Above, state: &State, out: &mut Vec<Leaf>) {
    for field in message.fields {
        let path = format!("{}{}", above.prefix, field.name);
        let doc: Vec<&str> = above.doc.split_whitespace().chain(field.doc.split_whitespace()).collect();
        let doc = doc.join(" ");
        let used = used_elements(field.name, state).map(|used| used as usize);
        let length = field.array_length.map(|length| used.unwrap_or(length).min(length));
        if length == Some(0) {
            continue;
        }
        let offset = above.offset + field.offset;
        match field.element {
            Element::Scalar(ros_type) => out.push(Leaf { path, ros_type, length, offset, doc }),
            Element::Message(nested) => match length {
                None => leaves(nested, Above { prefix: &format!("{path}."), offset, doc: &doc }, state, out),
                Some(length) => {
                    for i in 0..length {
                        let (prefix, offset) = (format!("{path}[{i}]."), offset + i * nested.size);
                        leaves(nested, Above { prefix: &prefix, offset, doc: &doc }, state, out);
                    }
                }
            },
        }
    }
}

/// Collects variables and numbers them.
struct Collector {
    found: Vec<Variable>,
    next: u32,
}

impl Collector {
    fn push(&mut self, variable: Variable) {
        let reference = self.next;
        self.next += variable.elements() as u32;
        self.found.push(Variable { reference, ..variable });
    }

    fn field(&mut self, prefix: &str, leaf: &Leaf, causality: Causality, place: Place) {
        let Some(kind) = Kind::of_ros(leaf.ros_type) else { return };
        let last = leaf.path.rsplit('.').next().unwrap_or_default();
        self.push(Variable {
            reference: 0,
            name: format!("{prefix}{}", leaf.path),
            kind,
            length: leaf.length,
            causality,
            unit: unit_of(last.split('[').next().unwrap_or_default()).unwrap_or_default(),
            description: leaf.doc.clone(),
            place,
        });
    }

    fn single(&mut self, name: &str, kind: Kind, causality: Causality, place: Place, description: &str) {
        self.push(Variable {
            reference: 0,
            name: name.to_owned(),
            kind,
            length: None,
            causality,
            unit: if name == "time" { "s" } else { "" },
            description: description.to_owned(),
            place,
        });
    }
}

impl Variables {
    /// Lists the variables of a simulation at its start.
    pub fn of(sim: &Sim) -> Variables {
        let (scene, state) = (sim.shared().scene(), sim.state());
        let mut all = Collector { found: Vec::new(), next: 0 };
        all.single("time", Kind::Float64, Causality::Independent, Place::Time, "Simulated time.");
        for (index, controller) in sim.driven().iter().enumerate() {
            let mut fields = Vec::new();
            leaves(Command::DESCRIPTION, TOP, state, &mut fields);
            for leaf in fields.iter().filter(|leaf| !FILLED_IN.contains(&leaf.path.as_str())) {
                let place = Place::Command(index, leaf.offset);
                all.field(&format!("{controller}."), leaf, Causality::Input, place);
            }
        }
        let mut fields = Vec::new();
        leaves(State::DESCRIPTION, TOP, state, &mut fields);
        let is_left_out =
            |leaf: &Leaf| LEFT_OUT.contains(&leaf.path.split(['.', '[']).next().unwrap_or_default());
        for leaf in fields.iter().filter(|leaf| !is_left_out(leaf)) {
            all.field("state.", leaf, Causality::Output, Place::State(leaf.offset));
        }
        for (index, sensor) in scene.sensor.iter().enumerate() {
            let mut fields = Vec::new();
            leaves(SensorReading::DESCRIPTION, TOP, state, &mut fields);
            for leaf in fields.iter().filter(|leaf| !["sensor_index", "kind"].contains(&leaf.path.as_str())) {
                debug_assert!(leaf.length.is_none_or(|length| length == MAX_SENSOR_VALUES));
                let place = Place::Reading(index, leaf.offset);
                all.field(&format!("sensor.{}.", sensor.name), leaf, Causality::Output, place);
            }
        }
        let text =
            "Chained hash of every command and state so far, 32 hexadecimal digits: that of a lockstep run.";
        all.single("hash", Kind::String, Causality::Output, Place::Hash, text);
        if let Some(drr) = &scene.drr {
            let text = format!(
                "X-ray of the state, {} columns x {} rows, 16-bit little-endian, row by row from the top.",
                drr.columns, drr.rows
            );
            all.single("x_ray", Kind::Binary, Causality::Output, Place::XRay, &text);
        }
        if let Ok(toml::Value::Table(table)) = toml::Value::try_from(scene) {
            keys("", &toml::Value::Table(table), &mut all);
        }
        Variables(all.found)
    }

    /// Returns a variable and the number of its element with this reference.
    pub fn find(&self, reference: u32) -> Option<(&Variable, usize)> {
        let index = self.0.partition_point(|variable| variable.reference <= reference).checked_sub(1)?;
        let variable = &self.0[index];
        let element = (reference - variable.reference) as usize;
        (element < variable.elements()).then_some((variable, element))
    }
}

/// Adds the numbers and flags of a scene as parameters.
fn keys(path: &str, value: &toml::Value, all: &mut Collector) {
    let below = |key: &str| if path.is_empty() { key.to_owned() } else { format!("{path}.{key}") };
    let start = match value {
        toml::Value::Table(table) => {
            return table.iter().for_each(|(key, value)| keys(&below(key), value, all));
        }
        toml::Value::Array(items) => {
            for (index, item) in items.iter().enumerate().filter(|(_, item)| item.is_table()) {
                keys(&below(&index.to_string()), item, all);
            }
            return;
        }
        toml::Value::Float(value) => Start::Float(*value),
        toml::Value::Integer(value) => Start::Whole(*value),
        toml::Value::Boolean(value) => Start::Flag(*value),
        _ => return,
    };
    if NO_PARAMETERS.iter().any(|key| path.starts_with(key)) {
        return;
    }
    let kind = match start {
        Start::Float(_) => Kind::Float64,
        Start::Whole(_) => Kind::Int64,
        Start::Flag(_) => Kind::Boolean,
    };
    let place = Place::Key(path.to_owned(), start);
    let text = format!("Scene key {path}.");
    all.single(&format!("scene.{path}"), kind, Causality::Parameter, place, &text);
}
