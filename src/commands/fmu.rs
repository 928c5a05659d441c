//! `trabecula fmu`: scenes as Functional Mock-up Units.

use std::path::{Path, PathBuf};

use clap::{Args, Subcommand};
use sim::{Drive, SharedScene};
use trabecula_fmu::{FmuError, Version, export};

use super::fmu_drive::DriveArguments;
use super::{Choice, choice};
use crate::failure::Failure;
use crate::output::refuse_existing;
use crate::say::{Figures, path_text};

/// Arguments of `fmu`.
#[derive(Debug, Subcommand)]
pub enum FmuCommand {
    /// Write a scene as an FMU for co-simulation, for Simulink, Modelica tools and FMPy.
    Export(ExportArguments),
    /// Run an FMU as a controller of a session. An FMU is a program: run only what you trust.
    Drive(DriveArguments),
}

const VERSIONS: &[Choice<Version>] = &[
    ("3", "FMI 3.0: arrays, and X-ray frames as a binary output", Version::Three),
    ("2", "FMI 2.0: a variable for each element of an array, no frames", Version::Two),
];

/// Arguments of `fmu export`.
#[derive(Debug, Args)]
pub struct ExportArguments {
    /// Scene; default: the built-in femur.
    scene: Option<PathBuf>,
    /// New file.
    #[arg(short, long)]
    output: PathBuf,
    /// Version of the standard.
    #[arg(long, value_name = "VERSION", default_value = "3", value_parser = choice(VERSIONS))]
    fmi: Version,
    /// Built-in controller to leave to the importing program (may be repeated); external ones always are.
    #[arg(long, value_name = "CONTROLLER")]
    drive: Vec<String>,
    /// Set a scene key (may be repeated).
    #[arg(long = "set", value_name = "KEY=VALUE")]
    settings: Vec<String>,
    #[command(flatten)]
    figures: Figures,
}

/// File name of the library that an FMU holds.
const LIBRARY: &str = "libtrabecula_fmu.so";
/// Environment variable with the path of that library, for programs that are not installed beside it.
const LIBRARY_VARIABLE: &str = "TRABECULA_FMU_LIBRARY";

/// Returns the library's file: that of the environment, or beside the program, or in `lib` beside its folder,
/// or in `deps`, where cargo leaves it.
fn library() -> Result<PathBuf, Failure> {
    if let Some(path) = std::env::var_os(LIBRARY_VARIABLE) {
        return Ok(path.into());
    }
    let program = std::env::current_exe().unwrap_or_default();
    let folder = program.parent().unwrap_or(Path::new("."));
    let places = [".", "../lib", "deps"].map(|below| folder.join(below).join(LIBRARY));
    places.into_iter().find(|path| path.exists()).ok_or_else(|| {
        Failure::failed(format!(
            "{LIBRARY} not found beside {}; set {LIBRARY_VARIABLE} to its path",
            path_text(&program)
        ))
    })
}

/// Runs the command.
pub fn run(command: &FmuCommand) -> Result<(), Failure> {
    match command {
        FmuCommand::Export(arguments) => export_scene(arguments),
        FmuCommand::Drive(arguments) => super::fmu_drive::run(arguments),
    }
}

fn export_scene(arguments: &ExportArguments) -> Result<(), Failure> {
    refuse_existing(&[&arguments.output])?;
    let shared = SharedScene::load(arguments.scene.as_deref(), &arguments.settings, None);
    let shared = shared.map_err(|error| failure(&FmuError::Sim(error)))?;
    let drive = match arguments.drive.as_slice() {
        [] => Drive::Nothing,
        names => Drive::These(names.to_vec()),
    };
    let fmu = export::fmu(&shared, &drive, arguments.fmi, &library()?).map_err(|error| failure(&error))?;
    output_file::write(&arguments.output, &fmu.bytes)?;
    arguments.figures.say(
        || {
            let size_mb = fmu.bytes.len() as f64 * 1e-6;
            let mut text = format!("{}: {size_mb:.1} MB", path_text(&arguments.output));
            for path in &fmu.outside {
                text.push_str(&format!("\nnot in the FMU, used by its path: {path}"));
            }
            text
        },
        || serde_json::json!({"file": path_text(&arguments.output), "bytes": fmu.bytes.len(), "outside": fmu.outside}),
    );
    Ok(())
}

pub(super) fn failure(error: &FmuError) -> Failure {
    match error {
        FmuError::Sim(cause) if !cause.is_of_the_machine() => Failure::bad_input(error.to_string()),
        _ => Failure::failed(error.to_string()),
    }
}
