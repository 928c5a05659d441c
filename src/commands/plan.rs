//! `trabecula plan SCENE`: shows which settings meet a scene's tolerance; `trabecula plan --check LOG`: measures the
//! error that a run actually made.

use std::path::{Path, PathBuf};

use clap::Args;
use ipc_types::scene::Scene;

use crate::failure::Failure;
use crate::feasibility;
use crate::launcher::volume_source::VolumeFiles;
use crate::plan::{self, check, resolve};
use crate::replay::Overrides;
use crate::scenes::SceneSource;

/// Arguments of `plan`.
#[derive(Debug, Args)]
#[command(group = clap::ArgGroup::new("what").required(true).args(["scene", "check", "list"]))]
pub struct PlanArguments {
    /// Scene file with a `tolerance`.
    pub scene: Option<PathBuf>,
    /// Step a log's commands through the reference model and report the tip error; takes a run's folder or its `run.mcap`.
    #[arg(long, value_name = "LOG")]
    pub check: Option<PathBuf>,
    /// Print the table of measured errors and costs behind the choice.
    #[arg(long)]
    pub list: bool,
    /// With `--check`: number of ticks to compare.
    #[arg(long, default_value_t = 500, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    pub samples: u64,
    /// With `--check`: the last tick to re-run.
    #[arg(long, default_value_t = u64::MAX, hide_default_value = true)]
    pub to: u64,
    /// With `--check`: current path of the log's CT file.
    #[arg(long, value_name = "PATH")]
    pub volume: Option<PathBuf>,
    /// With `--check`: continue even if the log's build, layout or volume differs.
    #[arg(long)]
    pub allow_mismatch: bool,
    /// Which files the volume may name.
    #[command(flatten)]
    pub volume_files: VolumeFiles,
}

/// Runs the command.
///
/// # Errors
/// Bad input (2); a log whose path error exceeded its scene's tolerance (1).
pub fn run(arguments: &PlanArguments) -> Result<(), Failure> {
    match (&arguments.scene, &arguments.check) {
        (Some(scene), _) => show(scene),
        (None, Some(log)) => check_log(log, arguments),
        (None, None) => {
            say!("{}", plan::TABLE.trim_end());
            Ok(())
        }
    }
}

/// Loads a scene and resolves its tolerance; also returns the choice as text.
///
/// # Errors
/// Bad input: an invalid scene, or a tolerance that no settings meet.
pub fn load(source: &SceneSource) -> Result<(Scene, Option<String>), Failure> {
    let mut scene = source.load()?;
    let choice = resolve(&mut scene, &source.text()?)?;
    Ok((scene, choice.map(|choice| choice.text())))
}

fn show(file: &Path) -> Result<(), Failure> {
    let (scene, choice) = load(&SceneSource::File(file.to_owned()))?;
    for warning in feasibility::check(&scene, &file.display(), None)? {
        tell!("{warning}");
    }
    match choice {
        Some(choice) => say!("{}: scene `{}`\n{choice}", file.display(), scene.name),
        None => say!(
            "{}: scene `{}` states no `tolerance` of tip or path: the standard settings, or what it names",
            file.display(),
            scene.name
        ),
    }
    Ok(())
}

fn check_log(log: &Path, arguments: &PlanArguments) -> Result<(), Failure> {
    let overrides = Overrides {
        volume: arguments.volume.clone(),
        scene: None,
        allow_mismatch: arguments.allow_mismatch,
        volume_files: arguments.volume_files,
    };
    let (scene, found) = check::check(log, &overrides, arguments.samples, arguments.to)?;
    say!(
        "{}: {} ticks again by the reference (full, own flexures, hybrid, dt {} ms) in {:.1} s, tip compared at {}",
        log.display(),
        found.last_tick,
        0.5 * scene.run.dt_ms,
        found.wall_s,
        found.samples
    );
    let largest_s = found.largest.1 as f64 * scene.dt_s();
    say!(
        "path error    {:.4} mm r.m.s., largest {:.4} mm at {largest_s:.3} s, at the end {:.4} mm",
        found.rms_mm,
        found.largest.0,
        found.end_mm
    );
    match scene.tolerance.as_ref().and_then(|tolerance| tolerance.path_mm) {
        Some(allowed) if found.rms_mm > allowed || found.rms_mm.is_nan() => Err(Failure::failed(format!(
            "the path was {:.4} mm off (r.m.s.), `tolerance.path_mm` allows {allowed}",
            found.rms_mm
        ))),
        Some(allowed) => {
            say!("tolerance     {allowed} mm: kept");
            Ok(())
        }
        None => Ok(()),
    }
}
