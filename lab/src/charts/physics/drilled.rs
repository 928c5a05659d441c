//! The drilled path of the default scene: its feed and tendon ramp, open loop, with any settings.

use ipc_types::scene::{Feedback, Mode, Scene};
use nalgebra::Vector3;
use simulation::CtView;
use voxel_grid::Ct;

use trabecula::failure::Failure;
use trabecula::launcher::volume_source;
use trabecula::plan::Settings;
use trabecula::plan::measure::against::{ReferenceComparison, References, Run, against_reference, path};
use trabecula::scenes::BuiltIn;

/// The feed of 28 mm at 1.5 mm/s, before the tool retracts.
const DURATION_S: f64 = 18.6;
/// The default scene with its bone.
pub struct Drilling {
    scene: Scene,
    ct: Ct,
}

impl Drilling {
    /// Creates the scene with this voxel size, for a fraction of its length.
    ///
    /// # Errors
    /// The scene or its phantom cannot be built.
    pub fn new(spacing_mm: f64, share: f64) -> Result<Drilling, Failure> {
        let mut scene = BuiltIn::Femur.scene()?;
        scene.run.mode = Mode::Lockstep;
        scene.run.duration_s = share * DURATION_S;
        scene.drr = None;
        for controller in &mut scene.controller {
            if let Some(drilling) = &mut controller.curved_drilling {
                drilling.feedback = Feedback::None;
            }
        }
        if let Some(volume) = &mut scene.volume {
            volume.spacing_mm = spacing_mm;
        }
        let ct = volume_source::load(&scene, volume_source::VolumeFiles::default())
            .map_err(|cause| Failure::failed(cause.to_string()))?;
        let ct = ct.ok_or_else(|| Failure::failed("the default scene has no volume"))?;
        Ok(Drilling { ct, scene })
    }

    /// Drills with these settings, and compares with the reference.
    ///
    /// # Errors
    /// The physics refuses the settings.
    pub fn compare(
        &self,
        settings: &Settings,
        references: &mut References,
    ) -> Result<ReferenceComparison, Failure> {
        Ok(against_reference(&Run::new(&self.with(settings), Some(self.ct())), references)?)
    }

    /// Drills with these settings; returns the burr's path, and the cost of a simulated millisecond, µs.
    ///
    /// # Errors
    /// The physics refuses the settings.
    pub fn path(&self, settings: &Settings) -> Result<(Vec<Vector3<f64>>, f64), Failure> {
        Ok(path(&Run::new(&self.with(settings), Some(self.ct())))?)
    }

    fn with(&self, settings: &Settings) -> Scene {
        let mut scene = self.scene.clone();
        settings.write_into(&mut scene);
        scene
    }

    fn ct(&self) -> CtView<'_> {
        CtView::from(&self.ct.volume)
    }
}
