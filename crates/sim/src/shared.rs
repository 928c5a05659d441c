//! A checked scene with its volume.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError, Weak};

use inputs::failure::Failure;
use inputs::log::OpenedLog;
use inputs::scenes::{BuiltIn, SceneSource};
use inputs::volume_source::{self, VolumeFiles};
use inputs::{feasibility, plan};
use messages::Volume as VolumeMessage;
use scene::{Mode, Scene};
use voxel_grid::Ct;

use crate::error::SimError;

/// The scene loaded last, while it is in use: the next one with the same synthetic volume shares it.
static NEWEST: Mutex<Weak<SharedScene>> = Mutex::new(Weak::new());

/// A scene that `trabecula scene check` accepts, with its volume; simulations share it.
#[derive(Debug)]
pub struct SharedScene {
    scene: Scene,
    ct: Option<Arc<Ct>>,
    notes: Vec<String>,
}

impl SharedScene {
    /// Loads a scene, or the built-in femur's, and sets keys: each of `settings` is a line `KEY=VALUE` of
    /// `trabecula run --set`; `seed` replaces `run.seed`. Settings that follow from its tolerance are chosen
    /// as for a run. The mode is always lockstep.
    ///
    /// # Errors
    /// [`SimError::Input`], with the message of `trabecula scene check`.
    pub fn load(
        file: Option<&Path>,
        settings: &[String],
        seed: Option<u64>,
    ) -> Result<Arc<SharedScene>, SimError> {
        let newest = NEWEST.lock().unwrap_or_else(PoisonError::into_inner).upgrade();
        // A synthetic volume is a function of the scene; a file may have changed meanwhile.
        let is_synthetic = |shared: &&Arc<SharedScene>| {
            shared.scene.volume.as_ref().is_some_and(|volume| volume.path.is_none())
        };
        let loaded = Self::load_beside(
            newest.as_ref().filter(is_synthetic).map(|shared| &**shared),
            file,
            settings,
            seed,
        )?;
        *NEWEST.lock().unwrap_or_else(PoisonError::into_inner) = Arc::downgrade(&loaded);
        Ok(loaded)
    }

    /// As [`SharedScene::load`], but reuses the volume of `other` if both scenes name the same one.
    ///
    /// # Errors
    /// As [`SharedScene::load`].
    pub fn load_beside(
        other: Option<&SharedScene>,
        file: Option<&Path>,
        settings: &[String],
        seed: Option<u64>,
    ) -> Result<Arc<SharedScene>, SimError> {
        let source = SceneSource::new(file, BuiltIn::Femur);
        Self::of_source(other, source, settings, seed, VolumeFiles::default())
    }

    /// As [`SharedScene::load_beside`], of any source; `files` are those that its volume may name.
    ///
    /// # Errors
    /// As [`SharedScene::load`].
    pub fn of_source(
        other: Option<&SharedScene>,
        source: SceneSource,
        settings: &[String],
        seed: Option<u64>,
        files: VolumeFiles,
    ) -> Result<Arc<SharedScene>, SimError> {
        let source = source.with(settings)?;
        let (mut scene, choice) = plan::load_scene(&source)?;
        scene.run.mode = Mode::Lockstep;
        scene.run.seed = seed.unwrap_or(scene.run.seed);
        volume_source::refuse_missing(&source, &scene)?;
        // A registration error moves the loaded volume.
        let has_volume_of =
            |other: &&SharedScene| other.scene.volume == scene.volume && other.scene.has_bone_pose_of(&scene);
        let same = other.filter(has_volume_of);
        if let Some(ct) = same.and_then(|other| other.ct.clone()) {
            let notes = feasibility::check(&scene, &source, Some(&ct.volume))?;
            return Ok(Arc::new(SharedScene { scene, ct: Some(ct), notes }));
        }
        let loaded = volume_source::load_with_notes(&scene, files).map_err(Failure::from)?;
        let mut notes: Vec<String> = choice.into_iter().collect();
        let ct = loaded.map(|loaded| {
            notes.extend(loaded.notes);
            Arc::new(loaded.ct)
        });
        notes.extend(feasibility::check(&scene, &source, ct.as_ref().map(|ct| &ct.volume))?);
        Ok(Arc::new(SharedScene { scene, ct, notes }))
    }

    /// Takes a checked scene with its volume.
    pub fn new(scene: &Scene, ct: Option<Arc<Ct>>) -> Arc<SharedScene> {
        let mut scene = scene.clone();
        scene.run.mode = Mode::Lockstep;
        Arc::new(SharedScene { scene, ct, notes: Vec::new() })
    }

    /// Loads the scene of packed bytes, whose volume must have this SHA-256. Shares the newest scene if it is
    /// the same.
    pub(crate) fn of_packed(
        toml: &str,
        notes: Vec<String>,
        volume_sha256: Option<[u8; 32]>,
    ) -> Result<Arc<SharedScene>, SimError> {
        let mut scene = Scene::parse(toml, Path::new("simulation as bytes")).map_err(Failure::bad_input)?;
        scene.run.mode = Mode::Lockstep;
        let newest = NEWEST.lock().unwrap_or_else(PoisonError::into_inner).upgrade();
        let is_same = |shared: &Arc<SharedScene>| {
            shared.scene == scene && shared.ct().map(|ct| ct.sha256) == volume_sha256
        };
        if let Some(newest) = newest.filter(is_same) {
            return Ok(newest);
        }
        let ct = volume_source::load(&scene, VolumeFiles::default()).map_err(Failure::from)?.map(Arc::new);
        if ct.as_ref().map(|ct| ct.sha256) != volume_sha256 {
            return Err(SimError::Packed(
                "the scene's volume has changed since; use the volume with which it was packed".to_owned(),
            ));
        }
        let loaded = Arc::new(SharedScene { scene, ct, notes });
        *NEWEST.lock().unwrap_or_else(PoisonError::into_inner) = Arc::downgrade(&loaded);
        Ok(loaded)
    }

    /// Takes the scene and volume of a log.
    pub(crate) fn of_log(log: &mut OpenedLog) -> Arc<SharedScene> {
        SharedScene::new(&log.scene, log.ct.take().map(Arc::new))
    }

    /// Returns the scene, in lockstep.
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// Returns the scene as TOML.
    ///
    /// # Errors
    /// If it cannot be written as TOML, which has not happened for any scene that was read from TOML.
    pub fn toml(&self) -> Result<String, SimError> {
        toml::to_string(&self.scene).map_err(|cause| SimError::SceneText(cause.to_string()))
    }

    /// Returns notes about scene and volume: assumptions, and likely mistakes.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// Returns the volume's header; `None` if the scene has no volume.
    pub fn volume(&self) -> Option<VolumeMessage> {
        self.ct.as_ref().map(|ct| VolumeMessage::of(ct))
    }

    /// Returns the volume's Hounsfield units, x fastest; empty if the scene has no volume.
    pub fn hu(&self) -> &[i16] {
        self.ct.as_ref().map_or(&[], |ct| &ct.volume.hu)
    }

    /// Returns the CT; `None` if the scene has no volume.
    pub fn ct(&self) -> Option<&Arc<Ct>> {
        self.ct.as_ref()
    }

    /// Returns whether both are the same scene and volume, so that a snapshot of one fits the other.
    pub(crate) fn is_same(self: &Arc<Self>, other: &Arc<SharedScene>) -> bool {
        Arc::ptr_eq(self, other) || (self.scene == other.scene && self.has_volume_of(other))
    }

    fn has_volume_of(&self, other: &SharedScene) -> bool {
        let sha256 = |shared: &SharedScene| shared.ct().map(|ct| ct.sha256);
        sha256(self) == sha256(other)
    }

    /// Refuses states of another scene, unless it differs only in parameters of `[truth]`.
    pub(crate) fn refuse_other_state(&self, other: &SharedScene) -> Result<(), SimError> {
        if !self.scene.differs_only_in_truth(&other.scene) {
            return Err(SimError::OtherScene);
        }
        match self.scene.state_mismatch(&other.scene) {
            Some(key) => Err(SimError::OtherTruth { key }),
            None if !self.has_volume_of(other) => Err(SimError::OtherScene),
            None => Ok(()),
        }
    }
}

/// Returns the path of a recording in a folder: `run.mcap`.
pub(crate) fn log_in(folder: &Path) -> PathBuf {
    folder.join("run.mcap")
}
