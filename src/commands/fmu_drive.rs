//! `trabecula fmu drive`: an FMU as a controller.

use std::path::PathBuf;

use clap::Args;
use trabecula_client::{Client, Connection};

use crate::failure::Failure;
use crate::fmu_controller::{OPTIONS, Setup, drive};

/// Arguments of `fmu drive`.
#[derive(Debug, Args)]
pub struct DriveArguments {
    /// FMU for co-simulation, FMI 2.0 or 3.0.
    fmu: PathBuf,
    /// Input of the FMU that gets a field of the state or of a sensor's newest reading, such as `y=bend_rad`
    /// or `y=sensor.fbg.value[0]` (may be repeated).
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
    /// Shared library to load before the FMU, whose functions it uses: Python's for one of PythonFMU3.
    #[arg(long, value_name = "LIBRARY")]
    preload: Option<String>,
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

/// Runs the command.
pub fn run(arguments: &DriveArguments) -> Result<(), Failure> {
    let setup = Setup {
        fmu: arguments.fmu.clone(),
        inputs: arguments.input.clone(),
        outputs: arguments.command.clone(),
        constants: arguments.constant.clone(),
        parameters: arguments.parameter.clone(),
        step_ms: arguments.step_ms,
        preload: arguments.preload.clone(),
        labels: OPTIONS,
    };
    setup.check(None)?;
    if arguments.check {
        return Ok(());
    }
    drive(&setup, Client::connect(&Connection::default()).map_err(Failure::failed)?)
}
