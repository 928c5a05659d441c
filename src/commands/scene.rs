//! `trabecula scene check FILE`.

use std::path::PathBuf;

use clap::Subcommand;
use controller_proc::Calibration;

use crate::failure::Failure;

/// What to do with a scene.
#[derive(Debug, Subcommand)]
pub enum SceneCommand {
    /// Check every key and range, that the volume is there, and the calibrations.
    Check {
        /// Scene file.
        file: PathBuf,
    },
}

/// Runs the command.
///
/// # Errors
/// A scene that is not one (2).
pub fn run(command: &SceneCommand) -> Result<(), Failure> {
    let SceneCommand::Check { file } = command;
    let (scene, _) = super::plan::load(file)?;
    if let Some(path) = scene.volume.as_ref().and_then(|volume| volume.path.as_ref())
        && !path.exists()
    {
        return Err(Failure::bad_input(format!(
            "{}: `volume.path` is {}, which does not exist",
            file.display(),
            path.display()
        )));
    }
    let calibrations = scene.controller.iter().filter_map(|controller| controller.curved_drilling.as_ref());
    for path in calibrations.filter_map(|drilling| drilling.calibration.as_ref()) {
        Calibration::load(path)
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
    if let Some(choice) = drr_proc::process::tolerance_text(&scene) {
        say!("{choice}");
    }
    Ok(())
}
