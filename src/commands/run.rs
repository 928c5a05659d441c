//! `trabecula run SCENE`: a whole run.

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use ipc_types::process::EndRequest;
use ipc_types::scene::{Mode, Scene};

use crate::failure::{EXIT_INTERRUPTED, Failure};
use crate::launcher::run::{Outcome, RunError, RunPlan, RunResult, output_folder, run as run_scene};

/// The scene that runs when none is named.
pub const DEFAULT_SCENE: &str = "configs/femur_curved_drilling.toml";

/// Arguments of `run`.
#[derive(Debug, Args)]
pub struct RunArguments {
    /// Scene file.
    #[arg(default_value = DEFAULT_SCENE)]
    pub scene: PathBuf,
    /// How time passes, instead of what the scene says.
    #[arg(long, value_enum)]
    pub mode: Option<ModeArgument>,
    /// Simulated seconds, instead of what the scene says.
    #[arg(long)]
    pub duration_s: Option<f64>,
    /// Folder below which the run's folder is made.
    #[arg(long, default_value = "out")]
    pub output: PathBuf,
    /// Record nothing.
    #[arg(long)]
    pub no_record: bool,
    /// No progress line.
    #[arg(long)]
    pub quiet: bool,
}

/// How time passes.
#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum ModeArgument {
    /// As fast as the parts allow.
    Lockstep,
    /// By the wall clock.
    Realtime,
}

/// Runs a scene.
///
/// # Errors
/// Bad input (exit code 2), a part that died (1), Ctrl-C (130).
pub fn run(arguments: &RunArguments) -> Result<(), Failure> {
    let scene = scene_of(arguments)?;
    let end = EndRequest::install().map_err(|cause| Failure::failed(format!("signals cannot be handled: {cause}")))?;
    let output = match arguments.no_record {
        true => None,
        false => Some(output_folder(&arguments.output, &scene).map_err(|cause| {
            Failure::bad_input(format!("--output {}: cannot be made ({cause})", arguments.output.display()))
        })?),
    };
    let plan = RunPlan { scene, output };
    let result = run_scene(&plan, &end, |_glance| {}).map_err(|error| {
        // Nothing was recorded: leave no empty folder.
        if let Some(output) = &plan.output {
            let _ = std::fs::remove_dir(output);
        }
        match error {
            RunError::Volume(_) => Failure::bad_input(error),
            _ => Failure::failed(error.to_string()),
        }
    })?;
    finish(&result, plan.output.as_deref())
}

fn scene_of(arguments: &RunArguments) -> Result<Scene, Failure> {
    let mut scene = Scene::load(&arguments.scene).map_err(Failure::bad_input)?;
    match arguments.mode {
        Some(ModeArgument::Lockstep) => scene.run.mode = Mode::Lockstep,
        Some(ModeArgument::Realtime) => scene.run.mode = Mode::Realtime,
        None => {}
    }
    if let Some(duration_s) = arguments.duration_s {
        if !(0.001..=3600.0).contains(&duration_s) {
            return Err(Failure::bad_input(format!("--duration-s is {duration_s}, allowed is 0.001 to 3600")));
        }
        scene.run.duration_s = duration_s;
    }
    Ok(scene)
}

fn finish(result: &RunResult, _output: Option<&Path>) -> Result<(), Failure> {
    println!("{result:#?}");
    match &result.outcome {
        Outcome::Completed => Ok(()),
        Outcome::Interrupted => Err(Failure { message: "interrupted".to_owned(), code: EXIT_INTERRUPTED }),
        Outcome::PartDied { name, how, last_words } => {
            let words = if last_words.is_empty() { "nothing".to_owned() } else { last_words.join("\n  ") };
            Err(Failure::failed(format!("part `{name}` died ({how}); its last words:\n  {words}")))
        }
    }
}
