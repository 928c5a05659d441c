//! `trabecula scene check FILE` validates a scene; `scene init` writes a built-in one; `scene show` draws
//! one; `scene schema` prints the JSON schema of scenes, for editors.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use clap::Subcommand;
use foreign_text::counted;
use ipc_types::scene::{Mode, Scene};

use super::from_markups::{self, FromMarkupsArguments};
use super::show::{self, ShowArguments};
use crate::failure::Failure;
use crate::feasibility;
use crate::launcher::volume_source::{self, VolumeFiles};
use crate::output::refuse_existing;
use crate::prediction::Prediction;
use crate::say::{self, Figures};
use crate::scenes::{BuiltIn, SceneSource};

/// Arguments of `scene`.
#[derive(Debug, Subcommand)]
pub enum SceneCommand {
    /// Validate a scene: keys and ranges, that volume and calibrations are readable, and that it is feasible.
    Check {
        /// Scene file.
        file: PathBuf,
        /// Also simulate the scene in this process and report what will happen: distance from the target,
        /// deviation from the planned path, forces, stops, breaches of the bone.
        #[arg(long)]
        simulate: bool,
        /// Treat warnings as errors (exit code 2).
        #[arg(long)]
        strict: bool,
        #[command(flatten)]
        volume_files: VolumeFiles,
        #[command(flatten)]
        figures: Figures,
    },
    /// Write a built-in scene to a folder as a starting point.
    Init {
        /// Output folder; created if missing.
        #[arg(short, long, default_value = ".")]
        output: PathBuf,
        /// Built-in scene to write.
        #[arg(long, value_enum, default_value_t = BuiltIn::Femur)]
        scene: BuiltIn,
    },
    /// Write a scene from a 3D Slicer plan (entry, bend and target) and its CT.
    FromMarkups(FromMarkupsArguments),
    /// Draw a scene before it is run: CT slices through burr start, entry and target with the planned path,
    /// pilot hole and tool, Hounsfield units along the path, and measurements of the bone.
    Show(ShowArguments),
    /// Print the JSON schema of scenes (draft 7), for completion and validation in an editor.
    Schema,
}

/// Runs the command.
///
/// # Errors
/// An invalid scene (2); a file that already exists or cannot be written.
pub fn run(command: &SceneCommand) -> Result<(), Failure> {
    match command {
        SceneCommand::Check { file, simulate, strict, volume_files, figures } => {
            let prediction = if *simulate { Simulate::Yes } else { Simulate::No };
            check(file, (prediction, *volume_files), *strict, *figures)
        }
        SceneCommand::Init { output, scene } => init(output, *scene),
        SceneCommand::FromMarkups(arguments) => from_markups::run(arguments),
        SceneCommand::Show(arguments) => show::run(arguments),
        SceneCommand::Schema => schema(),
    }
}

fn schema() -> Result<(), Failure> {
    let text = serde_json::to_string_pretty(&ipc_types::scene::json_schema());
    let text =
        text.map_err(|cause| Failure::failed(format!("the schema cannot be written as JSON: {cause}")))?;
    say::verbatim(&text);
    say::verbatim("\n");
    Ok(())
}

fn init(folder: &Path, scene: BuiltIn) -> Result<(), Failure> {
    let file = folder.join(scene.name()).with_extension("toml");
    refuse_existing(&[&file])?;
    output_file::create_folder(folder).map_err(Failure::folder(folder))?;
    output_file::write(&file, scene.text())?;
    say!("written      {}", file.display());
    Ok(())
}

/// Whether a command also predicts the scene's run.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Simulate {
    Yes,
    No,
}

/// Checks a scene with its volume; returns what there is to say about it, and the prediction of its run.
///
/// # Errors
/// The scene is infeasible, or its volume cannot be read (2); out of memory (1).
pub(super) fn examine(
    scene: &Scene,
    source: &dyn std::fmt::Display,
    simulate: Simulate,
    volume_files: VolumeFiles,
) -> Result<(Vec<String>, Option<Prediction>), Failure> {
    let loaded = volume_source::load_with_notes(scene, volume_files)?;
    let mut notes = loaded.iter().flat_map(|loaded| loaded.notes.clone()).collect::<Vec<_>>();
    let volume = loaded.as_ref().map(|loaded| &loaded.ct.volume);
    let warnings = feasibility::check(scene, source, volume)
        .inspect_err(|_| notes.iter().for_each(|note| tell!("{note}")))?;
    notes.extend(warnings);
    let prediction = match simulate {
        Simulate::Yes => Some(Prediction::of(scene, loaded.map(|loaded| Arc::new(loaded.ct)))?),
        Simulate::No => None,
    };
    notes.extend(prediction.iter().flat_map(|prediction| prediction.lines(source)));
    Ok((notes, prediction))
}

/// Returns lines with their severities, as JSON.
pub(super) fn findings_json(notes: &[String]) -> serde_json::Value {
    let finding = |note: &String| {
        let (severity, text) = match note.strip_prefix(WARNING) {
            Some(text) => ("warning", text),
            None => ("note", note.as_str()),
        };
        serde_json::json!({"severity": severity, "text": text})
    };
    notes.iter().map(finding).collect()
}

/// Begin of a line that warns.
const WARNING: &str = "warning: ";

fn check(
    file: &Path,
    (simulate, volume_files): (Simulate, VolumeFiles),
    strict: bool,
    figures: Figures,
) -> Result<(), Failure> {
    let (scene, _) = crate::plan::load_scene(&SceneSource::File(file.to_owned()))?;
    volume_source::refuse_missing(&file.display(), &scene)?;
    let (mut notes, prediction) = examine(&scene, &file.display(), simulate, volume_files)?;
    notes.extend(xray::from_scene::tolerance_text(&scene));
    figures.say(
        || {
            let predicted = prediction.as_ref().map(Prediction::text).unwrap_or_default();
            [notes.join("\n"), text_of(file, &scene), predicted].join("\n").trim().to_owned()
        },
        || json_of(&scene, &notes, prediction.as_ref()),
    );
    let warnings = notes.iter().filter(|note| note.starts_with(WARNING)).count();
    match strict && warnings > 0 {
        true => Err(Failure::bad_input(format!(
            "{}: {}, treated as errors (--strict)",
            file.display(),
            counted(warnings, "warning")
        ))),
        false => Ok(()),
    }
}

fn text_of(file: &Path, scene: &Scene) -> String {
    let frames = match scene.frame_period_ticks() {
        Some(1) => "a frame every tick".to_owned(),
        Some(ticks) => format!("a frame every {ticks} ticks"),
        None => "no scheduled frames".to_owned(),
    };
    let controllers = counted(scene.controller.len(), "controller");
    format!(
        "{}: scene `{}` is valid: {}, {} of {} ms, {controllers}, {frames}",
        file.display(),
        scene.name,
        match scene.run.mode {
            Mode::Lockstep => "lockstep",
            Mode::Realtime => "real time",
        },
        counted(scene.tick_count(), "tick"),
        scene.run.dt_ms,
    )
}

fn json_of(scene: &Scene, notes: &[String], prediction: Option<&Prediction>) -> serde_json::Value {
    serde_json::json!({
        "scene": scene.name,
        "ticks": scene.tick_count(),
        "dt_s": scene.dt_s(),
        "controllers": scene.controller_names(),
        "frame_period_ticks": scene.frame_period_ticks(),
        "notes": notes,
        "findings": findings_json(notes),
        "prediction": prediction.map(Prediction::json),
    })
}
