//! The variables of an FMU, and the fields of messages that they are connected to.

use ipc_types::messages::layout::Message;
use ipc_types::messages::{Command, SensorReading, State};
use ipc_types::scene::Scene;
use run_log::columns::{Column, columns};
use trabecula_fmu::master::{ForeignModel, ForeignVariable};

use super::Setup;

/// Where an input's value comes from.
#[derive(Debug, Clone)]
pub(super) enum Source {
    /// A field of the state.
    State(Column),
    /// A field of the newest reading of the sensor with this index in the scene.
    Reading(usize, Column),
}

/// All connections of an FMU.
#[derive(Debug)]
pub(super) struct Connections {
    pub inputs: Vec<(ForeignVariable, Source)>,
    pub outputs: Vec<(Column, ForeignVariable)>,
    pub constants: Vec<(Column, f64)>,
    pub parameters: Vec<(ForeignVariable, f64)>,
}

impl Connections {
    /// Finds what a setup names. Without a scene, sensors have the index 0.
    ///
    /// # Errors
    /// The first name that does not exist, or cannot be connected.
    pub fn of(setup: &Setup, model: &ForeignModel, scene: Option<&Scene>) -> Result<Connections, String> {
        let labels = setup.labels;
        let input = |(name, path): &(String, String)| {
            Ok((variable(model, labels.inputs, name, "input")?, source(labels.inputs, path, scene)?))
        };
        let output = |(path, name): &(String, String)| {
            Ok((settable(labels.outputs, path)?, variable(model, labels.outputs, name, "output")?))
        };
        let constant = |(path, value): &(String, f64)| {
            let column = settable(labels.constants, path)?;
            let is_whole = value.fract() == 0.0 && (0.0..=f64::from(u32::MAX)).contains(value);
            if column.ros_type == "uint32" && !is_whole {
                let label = labels.constants;
                return Err(format!("{label}: `{path}` is {value}; expected a whole number, 0 or more"));
            }
            Ok((column, *value))
        };
        let parameter = |(name, value): &(String, f64)| {
            Ok((variable(model, labels.parameters, name, "parameter")?, *value))
        };
        Ok(Connections {
            inputs: setup.inputs.iter().map(input).collect::<Result<_, String>>()?,
            outputs: setup.outputs.iter().map(output).collect::<Result<_, String>>()?,
            constants: setup.constants.iter().map(constant).collect::<Result<_, String>>()?,
            parameters: setup.parameters.iter().map(parameter).collect::<Result<_, String>>()?,
        })
    }
}

fn variable(
    model: &ForeignModel,
    label: &str,
    name: &str,
    causality: &str,
) -> Result<ForeignVariable, String> {
    if let Some(found) = model.variable(name).filter(|variable| variable.causality == causality) {
        return Ok(found.clone());
    }
    if let Some(other) = model.variable(name) {
        return Err(format!("{label}: `{name}` has the causality {}; expected {causality}", other.causality));
    }
    if let Some((_, kind)) = model.unsupported.iter().find(|(unsupported, _)| unsupported == name) {
        return Err(format!("{label}: `{name}` is {kind}; expected a single number or flag"));
    }
    let of_kind = model.variables.iter().filter(|variable| variable.causality == causality);
    let names: Vec<&str> = of_kind.map(|variable| variable.name.as_str()).collect();
    Err(format!("{label}: the FMU has no {causality} `{name}`; expected one of {names:?}"))
}

/// Returns the one element that a field's path names.
fn column<M: Message>(label: &str, path: &str) -> Result<Column, String> {
    let found = columns(M::DESCRIPTION, &[path.to_owned()]).map_err(|error| format!("{label}: {error}"))?;
    <[Column; 1]>::try_from(found)
        .map(|[column]| column)
        .map_err(|_| format!("{label}: `{path}` has several elements; expected one, as in `{path}[0]`"))
}

/// Start of the path of a sensor's reading: `sensor.NAME.FIELD`.
const SENSOR: &str = "sensor.";

fn source(label: &str, path: &str, scene: Option<&Scene>) -> Result<Source, String> {
    let Some(below) = path.strip_prefix(SENSOR) else {
        return column::<State>(label, path).map(Source::State);
    };
    let (name, field) = below.split_once('.').ok_or_else(|| {
        format!("{label}: `{path}` names no field; expected one, as in `{SENSOR}{below}.value[0]`")
    })?;
    let column = column::<SensorReading>(label, field)?;
    let Some(scene) = scene else { return Ok(Source::Reading(0, column)) };
    let index = scene.sensor.iter().position(|sensor| sensor.name == name).ok_or_else(|| {
        let names: Vec<&str> = scene.sensor.iter().map(|sensor| sensor.name.as_str()).collect();
        format!("{label}: the scene has no sensor `{name}`; expected one of {names:?}")
    })?;
    Ok(Source::Reading(index, column))
}

fn settable(label: &str, path: &str) -> Result<Column, String> {
    let column = column::<Command>(label, path)?;
    match column.name.as_str() {
        "sequence" | "state_tick" => Err(format!("{label}: `{path}` is filled in for every command")),
        _ => Ok(column),
    }
}
