//! The X-ray of a simulation's state.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use drr_proc::{ThisMachine, arm_model};
use messages::{CArmGeometry, Restores, State, Tick};
use xray::frame::{Cache, Job, RenderedFrame, label_job, render_job, render_poses};
use xray::from_scene::{renderer_parameters, scene_c_arm, scene_isocentre_m};
use xray::message::c_arm_of;
use xray::surroundings::Surroundings;
use xray::{CArm, DetectorFormat, DrrError, DrrRenderer, Labels, PositionerAngles, VolumeView};

use crate::error::SimError;
use crate::shared::SharedScene;

/// Number of frames rendered together between checks for an abort: a second for a large volume. A thread
/// without a frame waits for the last one of them.
const POSES_AT_ONCE: usize = 64;

/// The renderer of a simulation, and how much of the drilling it has applied.
pub(crate) struct XRay {
    renderer: DrrRenderer,
    c_arm: CArm,
    predrilled: Vec<u32>,
    around: Arc<Surroundings>,
    /// Number of voxels of the simulation's list that are removed here; `None` if everything must be applied
    /// again.
    told: Option<usize>,
}

impl XRay {
    pub(crate) fn new(shared: &SharedScene, predrilled: &[u32]) -> Result<XRay, SimError> {
        let drr = shared.scene().drr.as_ref().ok_or(SimError::NoXRay)?;
        let parameters = renderer_parameters(drr, shared.scene().tolerance.as_ref());
        Ok(XRay {
            renderer: DrrRenderer::new(&volume(shared)?, parameters, &ThisMachine)?,
            c_arm: scene_c_arm(drr)?,
            predrilled: predrilled.to_vec(),
            around: Arc::new(Surroundings::new(shared.scene(), arm_model(&shared.scene().arm)?)?),
            told: None,
        })
    }

    /// Returns the renderer of a simulation, created when it is first needed.
    pub(crate) fn of<'a>(
        kept: &'a mut Option<XRay>,
        shared: &SharedScene,
        predrilled: &[u32],
    ) -> Result<&'a mut XRay, SimError> {
        match kept {
            Some(x_ray) => Ok(x_ray),
            none => Ok(none.insert(XRay::new(shared, predrilled)?)),
        }
    }

    /// Registers that the simulation has moved to another state.
    pub(crate) fn forget(&mut self) {
        self.told = None;
    }

    pub(crate) fn render(
        &mut self,
        shared: &SharedScene,
        state: &State,
        drilled: &[u32],
        from: View,
        sequence: u64,
    ) -> Result<RenderedFrame, SimError> {
        let job = self.job(shared, state, drilled, from, sequence)?;
        self.render_job(shared, &job, drilled.len())
    }

    /// Renders a frame from each of these views, numbered from `sequence` on; aborts once `is_to_end` is set.
    pub(crate) fn render_many(
        &mut self,
        shared: &SharedScene,
        state: &State,
        drilled: &[u32],
        (from, sequence): (&[View], u64),
        is_to_end: &AtomicBool,
    ) -> Result<Vec<RenderedFrame>, SimError> {
        let c_arm = |(frame, view): (usize, &View)| match view.c_arm(shared) {
            Ok(c_arm) => Ok(c_arm.unwrap_or(self.c_arm)),
            Err(SimError::XRay(cause)) => Err(DrrError::Frame { frame, cause: Box::new(cause) }.into()),
            Err(other) => Err(other),
        };
        let c_arms = from.iter().enumerate().map(c_arm).collect::<Result<Vec<CArm>, SimError>>()?;
        let mut job = self.job(shared, state, drilled, View::Scene, sequence)?;
        let mut rendered: Vec<RenderedFrame> = Vec::with_capacity(from.len());
        for some in c_arms.chunks(POSES_AT_ONCE) {
            if is_to_end.load(Ordering::Relaxed) {
                return Err(SimError::GivenUp { tick: Tick(state.tick) });
            }
            // Frames that fail leave the renderer between two states.
            self.told = None;
            let of_all = |error| match error {
                DrrError::Frame { frame, cause } => DrrError::Frame { frame: rendered.len() + frame, cause },
                other => other,
            };
            let more = render_poses(&mut self.renderer, &volume(shared)?, &job, some).map_err(of_all)?;
            rendered.extend(more);
            self.told = Some(drilled.len());
            // The renderer has the voxels of this state now.
            (job.restores, job.removed) = (Restores::Nothing, Vec::new());
            job.sequence += some.len() as u64;
        }
        Ok(rendered)
    }

    /// Renders the frame with its labels; voxels at or above `bone_from_hu`, or else the scene's threshold,
    /// are bone.
    pub(crate) fn labels(
        &mut self,
        shared: &SharedScene,
        state: &State,
        drilled: &[u32],
        from: View,
        sequence: u64,
        bone_from_hu: Option<i16>,
    ) -> Result<(RenderedFrame, Labels), SimError> {
        let of_scene = shared.scene().labels_bone_from_hu().ok_or(SimError::NoXRay)?;
        let bone_from_hu = bone_from_hu.unwrap_or(of_scene);
        let mut job = self.job(shared, state, drilled, from, sequence)?;
        let rendered = self.render_job(shared, &job, drilled.len())?;
        // The renderer has the voxels of this state now.
        (job.restores, job.removed) = (Restores::Nothing, Vec::new());
        let labels = label_job(&mut self.renderer, &volume(shared)?, &job, bone_from_hu)?;
        Ok((rendered, labels))
    }

    fn render_job(
        &mut self,
        shared: &SharedScene,
        job: &Job,
        drilled: usize,
    ) -> Result<RenderedFrame, SimError> {
        // A frame that fails leaves the renderer between two states.
        self.told = None;
        let rendered = render_job(&mut self.renderer, &volume(shared)?, job)?;
        self.told = Some(drilled);
        Ok(rendered)
    }

    fn job(
        &self,
        shared: &SharedScene,
        state: &State,
        drilled: &[u32],
        from: View,
        sequence: u64,
    ) -> Result<Job, SimError> {
        let scene = shared.scene();
        let c_arm = from.c_arm(shared)?;
        let (restores, removed) = match self.told {
            Some(told) => (Restores::Nothing, drilled.get(told..).unwrap_or_default().to_vec()),
            None => (Restores::Drilled, [&self.predrilled, drilled].concat()),
        };
        Ok(Job {
            state: Box::new(*state),
            restores,
            removed,
            sequence,
            request_id: 0,
            // The cached anatomy stays that of the scene's C-arm.
            cache: if c_arm.is_some() { Cache::Kept } else { Cache::Follows },
            c_arm: c_arm.unwrap_or(self.c_arm),
            isocentre_m: scene_isocentre_m(scene),
            noise_seed: scene.run.seed,
            radii: scene.manipulator.radii(),
            holder: scene.arm.holder(),
            around: Arc::clone(&self.around),
            notch: scene.drr.as_ref().and_then(|drr| drr.notch),
        })
    }
}

/// Returns the volume in the renderer's form.
fn volume(shared: &SharedScene) -> Result<VolumeView<'_>, SimError> {
    let volume = &shared.ct().ok_or(SimError::NoXRay)?.volume;
    Ok(VolumeView::try_from(volume)?)
}

/// Viewpoint of an image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum View {
    /// The scene's C-arm.
    Scene,
    /// The scene's C-arm turned about the scene's isocentre to these positioner angles, as defined by DICOM.
    Angles {
        /// Primary angle.
        primary_deg: f64,
        /// Secondary angle.
        secondary_deg: f64,
    },
    /// This C-arm.
    Geometry(CArmGeometry),
}

impl View {
    /// Returns the C-arm; `None` for the scene's.
    fn c_arm(self, shared: &SharedScene) -> Result<Option<CArm>, SimError> {
        match self {
            View::Scene => Ok(None),
            View::Geometry(geometry) => Ok(Some(c_arm_of(&geometry)?)),
            View::Angles { primary_deg, secondary_deg } => {
                let drr = shared.scene().drr.as_ref().ok_or(SimError::NoXRay)?;
                let format = DetectorFormat {
                    columns: drr.columns,
                    rows: drr.rows,
                    pixel_pitch_m: [drr.pixel_pitch_mm * 1e-3; 2],
                };
                for (field, given) in
                    [("primary_angle_deg", primary_deg), ("secondary_angle_deg", secondary_deg)]
                {
                    // Written so that NaN fails; the C-arm's own error is in radians.
                    if !(-180.0..=180.0).contains(&given) {
                        let expected = "-180 to 180 degrees";
                        return Err(DrrError::OutOfRange { field, given, expected }.into());
                    }
                }
                let angles = PositionerAngles::from_degrees(primary_deg, secondary_deg);
                let [to_isocentre_m, to_detector_m] =
                    [drr.source_isocentre_mm, drr.source_detector_mm].map(|mm| mm * 1e-3);
                let isocentre_m = scene_isocentre_m(shared.scene());
                let c_arm =
                    CArm::from_positioner_angles(isocentre_m, angles, to_isocentre_m, to_detector_m, format)?;
                Ok(Some(c_arm))
            }
        }
    }
}
