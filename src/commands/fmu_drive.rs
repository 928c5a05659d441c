//! `trabecula fmu drive`: an FMU as a controller.

use std::path::PathBuf;
use std::time::Duration;

use clap::Args;
use ipc_types::messages::layout::Message;
use ipc_types::messages::{Command, State};
use run_log::columns::{Column, columns};
use trabecula_client::{Client, ClientError};
use trabecula_fmu::FmuError;
use trabecula_fmu::master::{Archived, ForeignModel, ForeignVariable, Master};
use zerocopy::{FromBytes, IntoBytes};

use super::fmu::failure;
use crate::failure::Failure;

/// Arguments of `fmu drive`.
#[derive(Debug, Args)]
pub struct DriveArguments {
    /// FMU for co-simulation, FMI 2.0 or 3.0.
    fmu: PathBuf,
    /// Input of the FMU that gets a field of the state, such as `y=bend_rad` (may be repeated).
    #[arg(long, value_name = "INPUT=FIELD", value_parser = pair)]
    input: Vec<(String, String)>,
    /// Field of the command that gets an output of the FMU, such as `tendon_force_n[0]=u` (may be repeated).
    #[arg(long, value_name = "FIELD=OUTPUT", value_parser = pair)]
    command: Vec<(String, String)>,
    /// Field of the command with a fixed value, such as `tendon_mode=1` (may be repeated).
    #[arg(long, value_name = "FIELD=VALUE", value_parser = setting)]
    constant: Vec<(String, f64)>,
    /// Parameter of the FMU (may be repeated).
    #[arg(long, value_name = "PARAMETER=VALUE", value_parser = setting)]
    parameter: Vec<(String, f64)>,
    /// Step of the FMU, ms: a multiple of the scene's tick; default: the tick.
    #[arg(long, value_name = "MS")]
    step_ms: Option<f64>,
    /// Only check the FMU's model description and the connections; runs no code of the FMU.
    #[arg(long)]
    check: bool,
}

fn pair(text: &str) -> Result<(String, String), String> {
    let (name, value) = text.split_once('=').ok_or("expected NAME=VALUE")?;
    Ok((name.to_owned(), value.to_owned()))
}

fn setting(text: &str) -> Result<(String, f64), String> {
    let (name, value) = pair(text)?;
    let number: f64 = value.parse().map_err(|_| format!("`{value}` is not a number"))?;
    if number.is_finite() { Ok((name, number)) } else { Err(format!("`{value}` is not finite")) }
}

/// The FMU's variables beside the fields that they are connected to.
struct Connections {
    inputs: Vec<(ForeignVariable, Column)>,
    outputs: Vec<(Column, ForeignVariable)>,
    constants: Vec<(Column, f64)>,
    parameters: Vec<(ForeignVariable, f64)>,
}

fn variable(
    model: &ForeignModel,
    option: &str,
    name: &str,
    causality: &str,
) -> Result<ForeignVariable, Failure> {
    let of_kind = model.variables.iter().filter(|variable| variable.causality == causality);
    let names: Vec<&str> = of_kind.map(|variable| variable.name.as_str()).collect();
    let found = model.variable(name).filter(|variable| variable.causality == causality);
    found.cloned().ok_or_else(|| {
        Failure::bad_input(format!(
            "{option}: the FMU has no {causality} `{name}`; expected one of {names:?}"
        ))
    })
}

/// Returns the one element that a field's path names.
fn column<M: Message>(option: &str, path: &str) -> Result<Column, Failure> {
    let found = columns(M::DESCRIPTION, &[path.to_owned()]);
    let found = found.map_err(|error| Failure::bad_input(format!("{option}: {error}")))?;
    let several = || {
        Failure::bad_input(format!(
            "{option}: `{path}` has several elements, expected one, as in `{path}[0]`"
        ))
    };
    <[Column; 1]>::try_from(found).map(|[column]| column).map_err(|_| several())
}

fn settable(option: &str, path: &str) -> Result<Column, Failure> {
    let column = column::<Command>(option, path)?;
    match column.name.as_str() {
        "sequence" | "state_tick" => {
            Err(Failure::bad_input(format!("{option}: `{path}` is filled in for every command")))
        }
        _ => Ok(column),
    }
}

impl Connections {
    fn of(arguments: &DriveArguments, model: &ForeignModel) -> Result<Connections, Failure> {
        let input = |(name, path): &(String, String)| {
            Ok((variable(model, "--input", name, "input")?, column::<State>("--input", path)?))
        };
        let output = |(path, name): &(String, String)| {
            Ok((settable("--command", path)?, variable(model, "--command", name, "output")?))
        };
        let constant = |(path, value): &(String, f64)| Ok((settable("--constant", path)?, *value));
        let parameter =
            |(name, value): &(String, f64)| Ok((variable(model, "--parameter", name, "parameter")?, *value));
        Ok(Connections {
            inputs: arguments.input.iter().map(input).collect::<Result<_, Failure>>()?,
            outputs: arguments.command.iter().map(output).collect::<Result<_, Failure>>()?,
            constants: arguments.constant.iter().map(constant).collect::<Result<_, Failure>>()?,
            parameters: arguments.parameter.iter().map(parameter).collect::<Result<_, Failure>>()?,
        })
    }
}

/// Runs the command.
pub fn run(arguments: &DriveArguments) -> Result<(), Failure> {
    let archived = Archived::read(&arguments.fmu).map_err(|error| Failure::bad_input(error.to_string()))?;
    let connections = Connections::of(arguments, &archived.model)?;
    if arguments.check {
        return Ok(());
    }
    let folder = tempfile::tempdir().map_err(Failure::failed)?;
    archived.extract(folder.path()).map_err(|error| failure(&error))?;
    let mut client = Client::connect(&trabecula_client::Connection::default()).map_err(Failure::failed)?;
    let every = ticks(arguments.step_ms, client.info().dt_s)?;
    let dt_s = client.info().dt_s;
    let master = begun(&archived, folder.path(), &connections).map_err(|error| failure(&error))?;
    let mut driven = Driven { master, connections, every, dt_s, next: None, command: Command::zeroed() };
    loop {
        let mut problem = None;
        let answered = client.answer(LONGEST_WAIT, |state, command| {
            if let Err(error) = driven.answer(state, command) {
                problem = Some(error);
            }
        });
        if let Some(error) = problem {
            return Err(failure(&error));
        }
        match answered {
            Ok(()) | Err(ClientError::TimedOut(_)) => {}
            Err(ClientError::Ended) => return Ok(()),
            Err(other) => return Err(Failure::failed(other)),
        }
    }
}

/// Longest wait for a state: a paused run publishes none.
const LONGEST_WAIT: Duration = Duration::from_secs(1);

/// Returns the number of ticks in a step of the FMU.
fn ticks(step_ms: Option<f64>, dt_s: f64) -> Result<u64, Failure> {
    let Some(step_ms) = step_ms else { return Ok(1) };
    let count = (step_ms * 1e-3 / dt_s).round();
    let is_whole = (count * dt_s * 1e3 - step_ms).abs() <= 1e-6 * step_ms.abs();
    match is_whole && (1.0..=1e6).contains(&count) {
        true => Ok(count as u64),
        false => Err(Failure::bad_input(format!(
            "--step-ms is {step_ms}, expected a multiple of the scene's tick, {} ms",
            dt_s * 1e3
        ))),
    }
}

fn begun(
    archived: &Archived,
    folder: &std::path::Path,
    connections: &Connections,
) -> Result<Master, FmuError> {
    let master = Master::new(archived, folder)?;
    connections.parameters.iter().try_for_each(|(variable, value)| master.set(variable, *value))?;
    master.enter_initialisation()?;
    master.exit_initialisation()?;
    Ok(master)
}

/// An FMU that answers states.
struct Driven {
    master: Master,
    connections: Connections,
    every: u64,
    dt_s: f64,
    /// Tick of the next step; `None` before the first.
    next: Option<u64>,
    /// What the last step commands.
    command: Command,
}

impl Driven {
    /// Steps the FMU if a step is due, and repeats its last command otherwise.
    fn answer(&mut self, state: &State, command: &mut Command) -> Result<(), FmuError> {
        if self.next.is_none_or(|next| state.tick >= next) {
            for (variable, column) in &self.connections.inputs {
                let value = column.value(state.as_bytes());
                self.master.set(variable, value.map_or(0.0, run_log::fields::Scalar::nearest_f64))?;
            }
            let step_s = self.every as f64 * self.dt_s;
            // The FMU's own time: its steps follow one another even if it has missed states in real time.
            let steps = self.next.map_or(0, |next| next / self.every);
            self.master.step(steps as f64 * step_s, step_s)?;
            self.next = Some((steps + 1) * self.every);
            self.command = self.commanded()?;
        }
        let Command { sequence, state_tick, .. } = *command;
        *command = Command { sequence, state_tick, ..self.command };
        Ok(())
    }

    fn commanded(&self) -> Result<Command, FmuError> {
        let mut bytes = [0; size_of::<Command>()];
        for (column, variable) in &self.connections.outputs {
            put(column, &mut bytes, self.master.get(variable)?);
        }
        self.connections.constants.iter().for_each(|(column, value)| put(column, &mut bytes, *value));
        Command::read_from_bytes(&bytes).map_err(|_| FmuError::Defect)
    }
}

/// Writes a value; a mode is rounded.
fn put(column: &Column, bytes: &mut [u8], value: f64) {
    if !column.set(bytes, value) {
        column.set_whole(bytes, value.round() as u32);
    }
}
