//! `trabecula scene check FILE` validates a scene; `trabecula scene init` writes one to start from.

use std::path::{Path, PathBuf};

use clap::Subcommand;
use controllers::Calibration;

use crate::failure::Failure;
use crate::launcher::volume_source::{self, VolumeFiles};
use crate::output::refuse_existing;
use crate::scenes::{BuiltIn, SceneSource};

/// What to do with a scene.
#[derive(Debug, Subcommand)]
pub enum SceneCommand {
    /// Check every key and range, and that the volume and the calibrations can be read.
    Check {
        /// Scene file.
        file: PathBuf,
        /// Which files the volume may name.
        #[command(flatten)]
        volume_files: VolumeFiles,
    },
    /// Write a scene that is inside the program into a folder, to be changed: the default scene unless another is named.
    Init {
        /// Folder; made if it is not there.
        #[arg(default_value = ".")]
        folder: PathBuf,
        /// Which one.
        #[arg(long, value_enum, default_value_t = BuiltIn::Femur)]
        scene: BuiltIn,
    },
}

/// Runs the command.
///
/// # Errors
/// An invalid scene (2); a file that already exists or cannot be written.
pub fn run(command: &SceneCommand) -> Result<(), Failure> {
    match command {
        SceneCommand::Check { file, volume_files } => check(file, *volume_files),
        SceneCommand::Init { folder, scene } => init(folder, *scene),
    }
}

fn init(folder: &Path, scene: BuiltIn) -> Result<(), Failure> {
    let file = folder.join(scene.name()).with_extension("toml");
    refuse_existing(&[&file])?;
    output_file::create_folder(folder).map_err(Failure::folder(folder))?;
    output_file::write(&file, scene.text())?;
    say!("written      {}", file.display());
    Ok(())
}

fn check(file: &Path, volume_files: VolumeFiles) -> Result<(), Failure> {
    let (scene, _) = super::plan::load(&SceneSource::File(file.to_owned()))?;
    if let Some(path) = scene.volume.as_ref().and_then(|volume| volume.path.as_ref()) {
        if !path.exists() {
            return Err(Failure::bad_input(format!(
                "{}: `volume.path` is {}, which does not exist",
                file.display(),
                path.display()
            )));
        }
        volume_source::load(&scene, volume_files)?;
    }
    let calibrations = scene.controller.iter().filter_map(|controller| controller.curved_drilling.as_ref());
    for path in calibrations.filter_map(|drilling| drilling.calibration.as_ref()) {
        Calibration::load(path, &ipc_types::text_file::read)
            .map_err(|cause| Failure::bad_input(format!("{}: {cause}", file.display())))?;
    }
    say!(
        "{}: scene `{}` is valid: {:?}, {} ticks of {} ms, {} controllers, {}",
        file.display(),
        scene.name,
        scene.run.mode,
        scene.tick_count(),
        scene.run.dt_ms,
        scene.controller.len(),
        match scene.frame_period_ticks() {
            Some(ticks) => format!("a frame every {ticks} ticks"),
            None => "no scheduled frames".to_owned(),
        }
    );
    if let Some(choice) = xray::from_scene::tolerance_text(&scene) {
        say!("{choice}");
    }
    Ok(())
}
