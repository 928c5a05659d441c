//! `trabecula scene check FILE` validates a scene; `scene init` writes a built-in one; `scene show` draws
//! one; `scene schema` prints the JSON schema of scenes, for editors.

use std::path::{Path, PathBuf};

use clap::Subcommand;
use ipc_types::scene::{Mode, Scene};

use super::from_markups::{self, FromMarkupsArguments};
use super::show::{self, ShowArguments};
use crate::failure::Failure;
use crate::feasibility;
use crate::launcher::volume_source::{self, VolumeFiles};
use crate::output::refuse_existing;
use crate::say::{self, Figures};
use crate::scenes::{BuiltIn, SceneSource};

/// Arguments of `scene`.
#[derive(Debug, Subcommand)]
pub enum SceneCommand {
    /// Validate a scene: keys and ranges, that volume and calibrations are readable, and that it is feasible.
    Check {
        /// Scene file.
        file: PathBuf,
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
        SceneCommand::Check { file, volume_files, figures } => check(file, *volume_files, *figures),
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

fn check(file: &Path, volume_files: VolumeFiles, figures: Figures) -> Result<(), Failure> {
    let mut notes = Vec::new();
    let (scene, _) = crate::plan::load_scene(&SceneSource::File(file.to_owned()))?;
    volume_source::refuse_missing(&file.display(), &scene)?;
    let loaded = volume_source::load_with_notes(&scene, volume_files)?;
    notes.extend(loaded.iter().flat_map(|loaded| loaded.notes.clone()));
    let volume = loaded.as_ref().map(|loaded| &loaded.ct.volume);
    let warnings = feasibility::check(&scene, &file.display(), volume)
        .inspect_err(|_| notes.iter().for_each(|note| tell!("{note}")))?;
    notes.extend(warnings);
    notes.extend(xray::from_scene::tolerance_text(&scene));
    figures.say(
        || [notes.join("\n"), text_of(file, &scene)].join("\n").trim_start().to_owned(),
        || json_of(&scene, &notes),
    );
    Ok(())
}

fn text_of(file: &Path, scene: &Scene) -> String {
    let frames = match scene.frame_period_ticks() {
        Some(ticks) => format!("a frame every {ticks} ticks"),
        None => "no scheduled frames".to_owned(),
    };
    let controllers = match scene.controller.len() {
        1 => "1 controller".to_owned(),
        count => format!("{count} controllers"),
    };
    format!(
        "{}: scene `{}` is valid: {}, {} ticks of {} ms, {controllers}, {frames}",
        file.display(),
        scene.name,
        match scene.run.mode {
            Mode::Lockstep => "lockstep",
            Mode::Realtime => "real time",
        },
        scene.tick_count(),
        scene.run.dt_ms,
    )
}

fn json_of(scene: &Scene, notes: &[String]) -> serde_json::Value {
    serde_json::json!({
        "scene": scene.name,
        "ticks": scene.tick_count(),
        "dt_s": scene.dt_s(),
        "controllers": scene.controller_names(),
        "frame_period_ticks": scene.frame_period_ticks(),
        "notes": notes,
    })
}
