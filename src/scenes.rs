//! The built-in scenes, and which scene a command uses.
//!
//! A command that needs no scene file uses one of these, so it works in any folder. Each is one file of `configs/` and
//! refers to no other file (no CT, no calibration), so it is complete wherever it is written and its paths cannot
//! point elsewhere.

use std::fmt;
use std::path::{Path, PathBuf};

use clap::ValueEnum;
use ipc_types::scene::Scene;

use crate::failure::Failure;

/// A built-in scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum BuiltIn {
    /// Drills a curve into a synthetic femur.
    #[value(name = "femur_curved_drilling")]
    Femur,
    /// Neither bone nor X-ray.
    #[value(name = "free_space")]
    FreeSpace,
    /// Sweeps the tendon, for `trabecula calibrate`.
    #[value(name = "tension_sweep")]
    TensionSweep,
}

impl BuiltIn {
    /// Name of the scene; with `.toml`, of its file.
    pub fn name(self) -> &'static str {
        match self {
            BuiltIn::Femur => "femur_curved_drilling",
            BuiltIn::FreeSpace => "free_space",
            BuiltIn::TensionSweep => "tension_sweep",
        }
    }

    /// The scene's text.
    pub fn text(self) -> &'static str {
        match self {
            BuiltIn::Femur => include_str!("../configs/femur_curved_drilling.toml"),
            BuiltIn::FreeSpace => include_str!("../configs/free_space.toml"),
            BuiltIn::TensionSweep => include_str!("../configs/tension_sweep.toml"),
        }
    }

    /// The parsed scene.
    ///
    /// # Errors
    /// None for this build's texts (a test parses them all).
    pub fn scene(self) -> Result<Scene, Failure> {
        Scene::parse(self.text(), Path::new(&format!("built-in {}.toml", self.name())))
            .map_err(Failure::bad_input)
    }
}

/// The scene of a command.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum SceneSource {
    /// The user's file.
    File(PathBuf),
    /// The user named no file.
    BuiltIn(BuiltIn),
}

impl SceneSource {
    /// The named file, or else the built-in scene.
    pub fn new(file: Option<&Path>, built_in: BuiltIn) -> SceneSource {
        file.map_or(SceneSource::BuiltIn(built_in), |file| SceneSource::File(file.to_owned()))
    }

    /// The scene, validated.
    ///
    /// # Errors
    /// Bad input: the file is not a scene.
    pub fn load(&self) -> Result<Scene, Failure> {
        match self {
            SceneSource::File(file) => ipc_types::scene_file::load(file).map_err(Failure::bad_input),
            SceneSource::BuiltIn(scene) => scene.scene(),
        }
    }

    /// The scene's text, as its author wrote it.
    ///
    /// # Errors
    /// Bad input: the file cannot be read.
    pub fn text(&self) -> Result<String, Failure> {
        match self {
            SceneSource::File(file) => ipc_types::text_file::read(file).map_err(Failure::bad_input),
            SceneSource::BuiltIn(scene) => Ok(scene.text().to_owned()),
        }
    }

    /// The argument that names the scene on another call of the same command; none for a built-in one.
    pub fn argument(&self) -> Option<&Path> {
        match self {
            SceneSource::File(file) => Some(file),
            SceneSource::BuiltIn(_) => None,
        }
    }
}

impl fmt::Display for SceneSource {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            SceneSource::File(file) => write!(out, "{}", file.display()),
            SceneSource::BuiltIn(scene) => write!(out, "the built-in scene `{}`", scene.name()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_built_in_scene_is_valid_bears_its_file_name_and_names_no_other_file() {
        for built_in in BuiltIn::value_variants() {
            let scene = built_in.scene().unwrap();
            let file = built_in.to_possible_value().unwrap();
            assert_eq!((scene.name.as_str(), file.get_name()), (built_in.name(), built_in.name()));
            assert_eq!(scene.volume.as_ref().and_then(|volume| volume.path.as_ref()), None);
            for controller in &scene.controller {
                assert_eq!(controller.command, None);
                let drilling = controller.curved_drilling.as_ref();
                assert_eq!(drilling.and_then(|drilling| drilling.calibration.as_ref()), None);
            }
        }
    }
}
