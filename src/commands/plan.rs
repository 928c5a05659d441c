//! `trabecula plan SCENE`: shows which settings meet a scene's tolerance; `trabecula plan --check LOG`:
//! measures the error that a run actually made; `trabecula plan path SCENE`: see `plan_path`.

use std::path::{Path, PathBuf};

use clap::{Args, Subcommand};
use serde_json::json;

use super::log_name;
use super::plan_path::{self, PathArguments};
use crate::failure::Failure;
use crate::feasibility;
use crate::launcher::volume_source::VolumeFiles;
use crate::plan::{self, check};
use crate::replay::Overrides;
use crate::say::Figures;
use crate::scenes::SceneSource;

/// Subcommands of `plan`.
#[derive(Debug, Subcommand)]
enum PlanCommand {
    /// Search paths to the target with the largest clearance and the least bone removed, by simulating them.
    Path(PathArguments),
}

/// Arguments of `plan`.
#[derive(Debug, Args)]
#[command(args_conflicts_with_subcommands = true, subcommand_negates_reqs = true)]
#[command(group = clap::ArgGroup::new("what").required(true).multiple(true).args(["scene", "check", "list"]))]
pub struct PlanArguments {
    #[command(subcommand)]
    command: Option<PlanCommand>,
    /// Scene file with a `tolerance`.
    scene: Option<PathBuf>,
    /// Step a log's commands through the reference model and report the tip error; LOG is a run's folder or
    /// its `run.mcap`; `latest` is the newest run in `out`.
    #[arg(long, value_name = "LOG", value_parser = log_name(), conflicts_with_all = ["scene", "list"])]
    check: Option<PathBuf>,
    /// Print the table of errors and costs behind the choice; with a scene, the table of its tool (measured
    /// first if it is not the standard tool).
    #[arg(long)]
    list: bool,
    /// With `--check`: number of ticks to compare.
    #[arg(long, requires = "check", conflicts_with_all = ["scene", "list"], default_value_t = 500, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    samples: u64,
    /// With `--check`: last tick to replay.
    #[arg(long, requires = "check", conflicts_with_all = ["scene", "list"], default_value_t = u64::MAX, hide_default_value = true)]
    to: u64,
    /// With `--check`: current path of the log's CT file.
    #[arg(long, value_name = "PATH", requires = "check", conflicts_with_all = ["scene", "list"])]
    volume: Option<PathBuf>,
    /// With `--check`: continue even if the log's build, layout or volume differs.
    #[arg(long, requires = "check", conflicts_with_all = ["scene", "list"])]
    allow_mismatch: bool,
    #[command(flatten)]
    volume_files: VolumeFiles,
    #[command(flatten)]
    figures: Figures,
}

/// Runs the command.
///
/// # Errors
/// Bad input (2); a log whose path error exceeded its scene's tolerance (1).
pub fn run(arguments: &PlanArguments) -> Result<(), Failure> {
    if let Some(PlanCommand::Path(arguments)) = &arguments.command {
        return plan_path::run(arguments);
    }
    match (&arguments.scene, &arguments.check) {
        (scene, None) if arguments.list => list(scene.as_deref(), arguments.figures),
        (Some(scene), _) => show(scene, arguments.figures),
        (None, Some(log)) => check_log(log, arguments),
        (None, None) => list(None, arguments.figures),
    }
}

fn list(scene: Option<&Path>, figures: Figures) -> Result<(), Failure> {
    let table = match scene {
        Some(file) => {
            let scene = SceneSource::File(file.to_owned()).load()?;
            plan::Table::of(&scene).map_err(|failure| failure.of(&file.display()))?
        }
        None => plan::Table::standard()?,
    };
    let text = plan::write(&table.rows);
    figures.say(|| text.trim_end().to_owned(), || json!({ "table_csv": text, "tool": table.tool }));
    Ok(())
}

fn show(file: &Path, figures: Figures) -> Result<(), Failure> {
    let (scene, choice) = plan::load_scene(&SceneSource::File(file.to_owned()))?;
    let warnings = feasibility::check(&scene, &file.display(), None)?;
    warnings.iter().for_each(|warning| tell!("{warning}"));
    let none = "sets no `tolerance` for tip or path: it uses the standard settings, or those it names";
    figures.say(
        || match &choice {
            Some(choice) => format!("{}: scene `{}`\n{choice}", file.display(), scene.name),
            None => format!("{}: scene `{}` {none}", file.display(), scene.name),
        },
        || json!({"scene": scene.name, "choice": choice}),
    );
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
    let largest_s = found.largest.1 as f64 * scene.dt_s();
    let allowed = scene.tolerance.as_ref().and_then(|tolerance| tolerance.path_mm);
    arguments.figures.say(
        || {
            let kept = allowed.filter(|allowed| found.rms_mm <= *allowed);
            let kept = kept.map_or(String::new(), |allowed| format!("\ntolerance     {allowed} mm: met"));
            format!(
                "{}: {} ticks replayed with the reference (full, own flexures, hybrid, dt {} ms) in {:.1} \
                 s, tip compared at {}\n\
                 path error    {:.4} mm RMS, maximum {:.4} mm at {largest_s:.3} s, {:.4} mm at the end{kept}",
                log.display(),
                found.last_tick,
                0.5 * scene.run.dt_ms,
                found.wall_s,
                found.samples,
                found.rms_mm,
                found.largest.0,
                found.end_mm
            )
        },
        || {
            json!({
                "last_tick": found.last_tick,
                "samples": found.samples,
                "wall_s": found.wall_s,
                "rms_mm": found.rms_mm,
                "largest_mm": found.largest.0,
                "largest_at_s": largest_s,
                "end_mm": found.end_mm,
                "tolerance_mm": allowed,
            })
        },
    );
    match allowed {
        Some(allowed) if found.rms_mm > allowed || found.rms_mm.is_nan() => Err(Failure::failed(format!(
            "path error is {:.4} mm RMS, `tolerance.path_mm` allows {allowed}",
            found.rms_mm
        ))),
        _ => Ok(()),
    }
}
