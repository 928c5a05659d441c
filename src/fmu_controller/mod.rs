//! An FMU as a controller of a session: what it is connected to, and how it answers states.
//!
//! [`check`] and [`Setup::check`] read the archive and its model description and run no code of the FMU;
//! [`drive`] loads its library into this process.

mod connections;
mod driven;

use std::path::PathBuf;

use ipc_types::scene::{Controller, Scene, whole_steps};
use trabecula_client::{Client, Connection};
use trabecula_fmu::master::Archived;

use crate::failure::Failure;
use connections::Connections;
use driven::Driven;

/// How error messages name the parts of a setup.
#[derive(Debug, Clone, Copy)]
pub struct Labels {
    inputs: &'static str,
    outputs: &'static str,
    constants: &'static str,
    parameters: &'static str,
    step: &'static str,
    preload: &'static str,
}

/// Options of `trabecula fmu drive`.
pub const OPTIONS: Labels = Labels {
    inputs: "--input",
    outputs: "--command",
    constants: "--constant",
    parameters: "--parameter",
    step: "--step-ms",
    preload: "--preload",
};

/// Keys of a scene's `[[controller]]`.
const KEYS: Labels = Labels {
    inputs: "`controller.inputs`",
    outputs: "`controller.outputs`",
    constants: "`controller.constants`",
    parameters: "`controller.parameters`",
    step: "`controller.step_ms`",
    preload: "`controller.preload`",
};

/// An FMU, and what it is connected to.
#[derive(Debug, Clone)]
pub struct Setup {
    /// The file.
    pub fmu: PathBuf,
    /// Input of the FMU, and the field of the state or of a sensor's reading that it gets.
    pub inputs: Vec<(String, String)>,
    /// Field of the command, and the output that it gets.
    pub outputs: Vec<(String, String)>,
    /// Field of the command, and its fixed value.
    pub constants: Vec<(String, f64)>,
    /// Parameter of the FMU, and its value.
    pub parameters: Vec<(String, f64)>,
    /// Step of the FMU, ms; `None` is a tick.
    pub step_ms: Option<f64>,
    /// Library to load before the FMU's.
    pub preload: Option<String>,
    /// Names of all these in errors.
    pub labels: Labels,
}

impl Setup {
    /// Returns the setup of a scene's controller; `None` if it is not an FMU.
    fn of(controller: &Controller) -> Option<Setup> {
        Some(Setup {
            fmu: controller.fmu.clone()?,
            inputs: controller.inputs.clone().into_iter().collect(),
            outputs: controller.outputs.clone().into_iter().collect(),
            constants: controller.constants.clone().into_iter().collect(),
            parameters: controller.parameters.clone().into_iter().collect(),
            step_ms: controller.step_ms,
            preload: controller.preload.clone(),
            labels: KEYS,
        })
    }

    /// Reads the FMU's archive and model description and checks the connections; runs no code of it. `scene`
    /// is the scene of the session, if it is known.
    ///
    /// # Errors
    /// Bad input: not an FMU for this program and machine, or a connection to something that does not exist.
    pub fn check(&self, scene: Option<&Scene>) -> Result<(), Failure> {
        self.connected(scene).map(drop)
    }

    fn connected(&self, scene: Option<&Scene>) -> Result<(Archived, Connections), Failure> {
        let archived = Archived::read(&self.fmu).map_err(|error| Failure::bad_input(error.to_string()))?;
        let connections = Connections::of(self, &archived.model, scene).map_err(Failure::bad_input)?;
        if let Some(scene) = scene {
            let step_s = self.ticks(scene.dt_s())? as f64 * scene.dt_s();
            let fixed = archived.model.fixed_step_s.filter(|fixed_s| whole_steps(step_s, *fixed_s).is_none());
            if let Some(fixed_s) = fixed {
                return Err(Failure::bad_input(format!(
                    "{}: the step is {step_s} s; expected a multiple of the FMU's fixed internal step, {fixed_s} s",
                    self.labels.step
                )));
            }
        }
        Ok((archived, connections))
    }

    /// Returns the number of ticks in a step of the FMU.
    fn ticks(&self, dt_s: f64) -> Result<u64, Failure> {
        let Some(step_ms) = self.step_ms else { return Ok(1) };
        whole_steps(step_ms * 1e-3, dt_s).filter(|count| *count <= 1_000_000).ok_or_else(|| {
            Failure::bad_input(format!(
                "{} is {step_ms}; expected a multiple of the scene's tick, {} ms",
                self.labels.step,
                dt_s * 1e3
            ))
        })
    }
}

/// Returns how a log replays the FMUs of a scene, with their controllers' names; `None` without an FMU. A
/// keyframe has no state of an FMU: a replay repeats the recorded commands.
pub fn replay_note(scene: &Scene) -> Option<String> {
    let fmus = scene.controller.iter().filter(|controller| controller.fmu.is_some());
    let names: Vec<&str> = fmus.map(|controller| controller.name.as_str()).collect();
    (!names.is_empty()).then(|| format!("{}: replays from the log of its outputs", names.join(", ")))
}

/// Checks the FMUs of a scene's controllers without running them; `source` names the scene in messages.
///
/// # Errors
/// Bad input: as [`Setup::check`], with the controller's name.
pub fn check(scene: &Scene, source: &dyn std::fmt::Display) -> Result<(), Failure> {
    for controller in &scene.controller {
        let Some(setup) = Setup::of(controller) else { continue };
        let name = format_args!("{source}: controller `{}`", controller.name);
        setup.check(Some(scene)).map_err(|error| error.of(&name))?;
    }
    Ok(())
}

/// Drives the controller that the environment names, with the FMU of the session's scene, until the run ends.
///
/// # Errors
/// As [`drive`]; or the controller is not an FMU.
pub fn drive_of_scene() -> Result<(), Failure> {
    let client = Client::connect(&Connection::default()).map_err(Failure::failed)?;
    let name = client.info().controller.as_ref().map(|(name, _)| name.clone()).unwrap_or_default();
    let controller = client.scene().controller.iter().find(|controller| controller.name == name);
    let setup = controller.and_then(Setup::of);
    let setup = setup.ok_or_else(|| Failure::bad_input(format!("controller `{name}` is not an FMU")))?;
    drive(&setup, client)
}

/// Runs an FMU in this process and answers every state of the session, until the run ends.
///
/// # Errors
/// As [`Setup::check`]; the FMU or the session fails.
pub fn drive(setup: &Setup, mut client: Client) -> Result<(), Failure> {
    let (archived, connections) = setup.connected(Some(client.scene()))?;
    let (every, dt_s) = (setup.ticks(client.info().dt_s)?, client.info().dt_s);
    if let Some(library) = &setup.preload {
        trabecula_fmu::master::preload(library)
            .map_err(|error| Failure::failed(format!("{}: {error}", setup.labels.preload)))?;
    }
    let folder = tempfile::tempdir().map_err(Failure::failed)?;
    archived.extract(folder.path()).map_err(Failure::failed)?;
    Driven::new(&archived, folder.path(), &connections, (every, dt_s))
        .and_then(|driven| driven.answer_all(&mut client))
}
