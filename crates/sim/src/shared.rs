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
use simulation::{CtView, SharedCt};

use crate::error::SimError;

/// The scene loaded last, while anybody has it: the next one with the same synthetic volume shares that.
static NEWEST: Mutex<Weak<SharedScene>> = Mutex::new(Weak::new());

/// A scene that `trabecula scene check` accepts, with its volume; simulations share it.
#[derive(Debug)]
pub struct SharedScene {
    scene: Scene,
    volume: Option<SharedVolume>,
    notes: Vec<String>,
}

/// A volume of one copy.
#[derive(Debug, Clone)]
struct SharedVolume {
    message: VolumeMessage,
    ct: SharedCt,
}

impl SharedScene {
    /// Reads a scene, or takes the built-in femur's, and sets keys: each of `settings` is a line `KEY=VALUE` of `trabecula run --set`;
    /// `seed` replaces `run.seed`. The settings that its tolerance leads to are chosen as for a run. Mode is lockstep, whatever it says.
    ///
    /// # Errors
    /// [`SimError::Input`], in the words of `trabecula scene check`.
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

    /// The same, with the volume of `other` if both scenes name the same one.
    ///
    /// # Errors
    /// As [`SharedScene::load`].
    pub fn load_beside(
        other: Option<&SharedScene>,
        file: Option<&Path>,
        settings: &[String],
        seed: Option<u64>,
    ) -> Result<Arc<SharedScene>, SimError> {
        let source = SceneSource::new(file, BuiltIn::Femur).with(settings)?;
        let (mut scene, choice) = plan::load_scene(&source)?;
        scene.run.mode = Mode::Lockstep;
        scene.run.seed = seed.unwrap_or(scene.run.seed);
        volume_source::refuse_missing(&source, &scene)?;
        let same = other.filter(|other| other.scene.volume == scene.volume);
        if let Some(volume) = same.and_then(|other| other.volume.clone()) {
            let notes = feasibility::check(&scene, &source, Some(&volume.copied()))?;
            return Ok(Arc::new(SharedScene { scene, volume: Some(volume), notes }));
        }
        let loaded = volume_source::load_with_notes(&scene, VolumeFiles::default()).map_err(Failure::from)?;
        let mut notes: Vec<String> = choice.into_iter().collect();
        let volume = loaded.map(|loaded| {
            notes.extend(loaded.notes);
            (loaded.volume, loaded.sha256)
        });
        notes.extend(feasibility::check(&scene, &source, volume.as_ref())?);
        Ok(Arc::new(SharedScene { scene, volume: volume.map(SharedVolume::of), notes }))
    }

    /// The scene and volume of a log.
    pub(crate) fn of_log(log: &mut OpenedLog) -> Arc<SharedScene> {
        let mut scene = log.scene.clone();
        scene.run.mode = Mode::Lockstep;
        let volume = log.volume.take().map(SharedVolume::of);
        Arc::new(SharedScene { scene, volume, notes: Vec::new() })
    }

    /// The scene, in lockstep.
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// The scene as text.
    ///
    /// # Errors
    /// It cannot be written as TOML, which no scene that was read from TOML has shown.
    pub fn toml(&self) -> Result<String, SimError> {
        toml::to_string(&self.scene).map_err(|cause| SimError::SceneText(cause.to_string()))
    }

    /// What is noteworthy about scene and volume: assumptions, and what is most likely a mistake.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// The volume's header; `None` if the scene has none.
    pub fn volume(&self) -> Option<&VolumeMessage> {
        self.volume.as_ref().map(|volume| &volume.message)
    }

    /// The volume's Hounsfield units, x fastest; empty if the scene has none.
    pub fn hu(&self) -> &[i16] {
        self.volume.as_ref().map_or(&[], |volume| &volume.ct.hu)
    }

    pub(crate) fn ct(&self) -> Option<&SharedCt> {
        self.volume.as_ref().map(|volume| &volume.ct)
    }

    /// Whether a snapshot of a simulation of the other is one of this.
    pub(crate) fn is_same(self: &Arc<Self>, other: &Arc<SharedScene>) -> bool {
        let sha256 = |shared: &SharedScene| shared.volume().map(|volume| volume.sha256);
        Arc::ptr_eq(self, other) || (self.scene == other.scene && sha256(self) == sha256(other))
    }
}

impl SharedVolume {
    fn of((volume, sha256): (volume_io::Volume, [u8; 32])) -> SharedVolume {
        let message = volume_source::message(&volume, sha256);
        let geometry = CtView::new(&message, &volume.hu).geometry;
        SharedVolume { message, ct: SharedCt { geometry, hu: volume.hu.into() } }
    }

    /// As a volume of its own.
    fn copied(&self) -> (volume_io::Volume, [u8; 32]) {
        let message = &self.message;
        let d = message.direction;
        let volume = volume_io::Volume {
            dims: message.dimensions.map(|n| n as usize),
            spacing_m: message.spacing_m,
            origin_m: message.origin_m,
            // The message has the axes one after the other, the volume the rows of a matrix whose columns they are.
            direction: [[d[0], d[3], d[6]], [d[1], d[4], d[7]], [d[2], d[5], d[8]]],
            hu: self.ct.hu.to_vec(),
        };
        (volume, message.sha256)
    }
}

/// Where a recording of this name lies: `run.mcap` in a folder.
pub(crate) fn log_in(folder: &Path) -> PathBuf {
    folder.join("run.mcap")
}
