//! The DRR process: takes every state and every removed voxel, renders the frames that are due, publishes them.
//!
//! One thread talks to the other processes, another renders (with as many worker threads as the scene says), so that
//! no message is lost however long a frame takes. In lockstep every scheduled tick is rendered, and the physics waits
//! when the renderer falls behind; in real time a frame that is due while another is rendered shows the newest state
//! once the renderer is free. Which tick a frame shows is published (`DrrReply`) before it is rendered.

mod ports;
mod schedule;
mod service;
mod tool_model;
mod worker;

use std::path::Path;

use ipc_types::messages::{CArmGeometry, CArmProjection, Part, Volume};
use ipc_types::ports::PortError;
use ipc_types::process::{EndRequest, Role, prioritise, session_scene};
use ipc_types::scene::{
    Display, Drr, PixelCentre as ScenePixelCentre, Projector as SceneProjector, Scene, SceneError, Tolerance,
};
use ipc_types::session::{Session, SessionError};
use thiserror::Error;
use zerocopy::FromBytes;

use crate::{
    CArm, Camera, DetectorFormat, DetectorParameters, DisplayMode, DisplayParameters, DrrError,
    DrrParameters, DrrRenderer, Grid, PixelCentre, PositionerAngles, Projector, Spectrum, VolumeView, ladder,
};

pub use tool_model::tool_of;
pub use worker::{Job, Rendered, render_job};

/// Why the DRR process ends early.
#[derive(Debug, Error)]
pub enum DrrProcessError {
    /// The session cannot be joined.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// The session's scene cannot be read.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// A message cannot be sent or taken.
    #[error(transparent)]
    Port(#[from] PortError),
    /// The renderer refuses the volume or the C-arm.
    #[error(transparent)]
    Renderer(#[from] DrrError),
    /// The scene has no X-ray.
    #[error("the scene has no `[drr]`: there is nothing to render")]
    NoDrr,
    /// The volume did not come.
    #[error("the volume did not arrive within {limit_s} s; is the launcher running?")]
    NoVolume {
        /// Seconds waited.
        limit_s: u64,
    },
    /// The volume's bytes do not lie as they should.
    #[error("the volume message is not one: {problem}")]
    BadVolume {
        /// What is wrong.
        problem: String,
    },
    /// Removed voxels were lost, so that frames would show bone that is gone.
    #[error("tick {tick}: {expected} voxels have been removed, but only {received} arrived here")]
    RemovedLost {
        /// Tick.
        tick: u64,
        /// Voxels that the physics removed.
        expected: u64,
        /// Voxels that came.
        received: u64,
    },
    /// The rendering thread ended.
    #[error("the rendering thread ended early")]
    WorkerGone,
    /// Signals cannot be handled.
    #[error("signals cannot be handled: {0}")]
    Signals(std::io::Error),
}

/// Runs the DRR process of a session to its end.
///
/// # Errors
/// Any [`DrrProcessError`].
pub fn run(session_folder: &Path) -> Result<(), DrrProcessError> {
    let end = EndRequest::install().map_err(DrrProcessError::Signals)?;
    let scene = session_scene(session_folder)?;
    let drr = scene.drr.clone().ok_or(DrrProcessError::NoDrr)?;
    // Frames may wait, ticks may not.
    prioritise(Role::Drr, scene.run.policy);
    let session = Session::join(session_folder)?;
    session.claim(Part::Drr)?;
    let ports = ports::Ports::open(&session)?;
    let volume = ports.receive_volume(&end)?;
    let view = volume_view(volume.message(), volume.tail())?;
    let mut renderer = DrrRenderer::new(&view, renderer_parameters(&drr, scene.tolerance.as_ref()))?;
    let c_arm = scene_c_arm(&drr)?;
    renderer.prepare(&view, &c_arm)?;
    service::serve(&scene, ports, &view, renderer, &c_arm, &end)
}

/// The volume of a message, in place.
///
/// # Errors
/// [`DrrProcessError::BadVolume`], or a grid that is not one.
pub fn volume_view<'v>(volume: &Volume, voxels: &'v [u8]) -> Result<VolumeView<'v>, DrrProcessError> {
    let grid = Grid::from(volume.grid().map_err(DrrError::from)?);
    let hu = <[i16]>::ref_from_bytes(voxels).map_err(|cause| DrrProcessError::BadVolume {
        problem: format!("voxels do not lie aligned: {cause}"),
    })?;
    Ok(VolumeView::new(grid, hu)?)
}

/// The projector of `[drr]`.
fn given_projector(drr: &Drr) -> Projector {
    match drr.projector {
        SceneProjector::Siddon => Projector::Siddon,
        SceneProjector::Joseph => Projector::Joseph,
        SceneProjector::SliceOrdered => {
            Projector::SliceOrdered { oversampling: drr.oversampling, sharpen: true }
        }
        SceneProjector::Preview => Projector::Preview { reduction: drr.reduction },
    }
}

/// What `tolerance.drr_rel` chooses, in words; `None` for a scene without it or without X-ray.
pub fn tolerance_text(scene: &Scene) -> Option<String> {
    let wanted = scene.drr.as_ref().and(scene.tolerance)?.drr_rel?;
    let rung = ladder::choose(wanted);
    let projector = match rung.projector {
        Projector::Siddon => "siddon".to_owned(),
        Projector::Joseph => "joseph".to_owned(),
        Projector::SliceOrdered { oversampling, .. } => format!("slice_ordered, oversampling {oversampling}"),
        Projector::Preview { reduction } => format!("preview, reduction {reduction}"),
    };
    Some(format!(
        "tolerance.drr_rel = {wanted:e}: X-ray by {projector} (measured error {:.1e})",
        rung.error_rel
    ))
}

/// The renderer's parameters of a scene.
pub fn renderer_parameters(drr: &Drr, tolerance: Option<&Tolerance>) -> DrrParameters {
    let wanted = tolerance.and_then(|tolerance| tolerance.drr_rel);
    DrrParameters {
        projector: wanted.map_or_else(|| given_projector(drr), |wanted| ladder::choose(wanted).projector),
        energy_kev: drr.energy_kev,
        spectrum: drr.spectrum.as_ref().map(|spectrum| Spectrum {
            tube_kv: spectrum.tube_kv,
            aluminium_mm: spectrum.aluminium_mm,
            ct_energy_kev: spectrum.ct_energy_kev,
            bone_above_hu: spectrum.bone_above_hu,
        }),
        threads: drr.threads,
        detector: DetectorParameters {
            photons_per_pixel: if drr.photons_per_pixel > 0.0 { drr.photons_per_pixel } else { 1.0e5 },
            quantum_noise: drr.photons_per_pixel > 0.0,
            blur_sigma_px: drr.blur_pixels,
            gain: drr.detector.gain,
            offset: drr.detector.offset,
            saturation: drr.detector.saturation,
        },
        display: DisplayParameters {
            mode: match drr.display {
                Display::BoneDark => DisplayMode::BoneDark,
                Display::BoneBright => DisplayMode::BoneBright,
                Display::Linear => DisplayMode::Linear,
            },
            ..DisplayParameters::default()
        },
        ..DrrParameters::default()
    }
}

/// The C-arm of a scene.
///
/// # Errors
/// A value out of range, by name.
pub fn scene_c_arm(drr: &Drr) -> Result<CArm, DrrError> {
    if let Some(c_arm) = given_c_arm(drr)? {
        return Ok(c_arm);
    }
    let format = DetectorFormat {
        columns: drr.columns,
        rows: drr.rows,
        pixel_pitch_m: [drr.pixel_pitch_mm * 1e-3; 2],
    };
    let angles = PositionerAngles::from_degrees(drr.primary_angle_deg, drr.secondary_angle_deg);
    let isocentre_m = drr.isocentre_mm.map(|x| x * 1e-3);
    CArm::from_positioner_angles(
        isocentre_m,
        angles,
        drr.source_isocentre_mm * 1e-3,
        drr.source_detector_mm * 1e-3,
        format,
    )
}

/// The C-arm of `[drr.carm]`; the scene's check has seen that one of its two forms is complete.
fn given_c_arm(drr: &Drr) -> Result<Option<CArm>, DrrError> {
    let Some(given) = &drr.carm else { return Ok(None) };
    let (columns, rows, pitch_m) = (drr.columns, drr.rows, drr.pixel_pitch_mm * 1e-3);
    if let (Some(intrinsics), Some(rotation), Some(translation_mm)) =
        (given.intrinsics, given.rotation, given.translation_mm)
    {
        let camera = Camera { intrinsics, rotation, translation_m: translation_mm.map(|x| x * 1e-3) };
        let centre = match given.pixel_centre {
            Some(ScenePixelCentre::Half) => PixelCentre::Half,
            Some(ScenePixelCentre::Whole) | None => PixelCentre::Whole,
        };
        return CArm::from_camera(&camera, centre, pitch_m, columns, rows).map(Some);
    }
    let (Some(source), Some(detector), Some(row_axis), Some(column_axis)) =
        (given.source_mm, given.detector_centre_mm, given.row_axis, given.column_axis)
    else {
        return Ok(None);
    };
    let c_arm = CArm {
        source_m: source.map(|x| x * 1e-3),
        detector_centre_m: detector.map(|x| x * 1e-3),
        row_axis,
        column_axis,
        pixel_pitch_m: [pitch_m; 2],
        columns,
        rows,
    };
    c_arm.validate()?;
    Ok(Some(c_arm))
}

/// Point about which the scene's C-arm turns; the origin for a scene without one.
pub fn scene_isocentre_m(scene: &Scene) -> [f64; 3] {
    scene.drr.as_ref().map_or([0.0; 3], |drr| drr.isocentre_mm.map(|x| x * 1e-3))
}

/// A C-arm as camera and positioner.
pub fn projection_message(c_arm: &CArm, isocentre_m: [f64; 3]) -> CArmProjection {
    let camera = c_arm.camera(PixelCentre::Whole);
    let positioner = c_arm.positioner(isocentre_m);
    let flat = |m: [[f64; 3]; 3]| core::array::from_fn(|i| m[i / 3][i % 3]);
    CArmProjection {
        intrinsics: flat(camera.intrinsics),
        rotation: flat(camera.rotation),
        translation_m: camera.translation_m,
        primary_angle_rad: positioner.primary_rad,
        secondary_angle_rad: positioner.secondary_rad,
        source_detector_m: positioner.source_detector_m,
        source_isocentre_m: positioner.source_isocentre_m,
    }
}

/// A C-arm as a message.
pub fn c_arm_message(c_arm: &CArm) -> CArmGeometry {
    CArmGeometry {
        source_m: c_arm.source_m,
        detector_centre_m: c_arm.detector_centre_m,
        row_axis: c_arm.row_axis,
        column_axis: c_arm.column_axis,
        pixel_pitch_m: c_arm.pixel_pitch_m,
        columns: c_arm.columns,
        rows: c_arm.rows,
    }
}

/// A message's C-arm, checked.
///
/// # Errors
/// A value out of range, by name.
pub fn c_arm_of(message: &CArmGeometry) -> Result<CArm, DrrError> {
    let c_arm = CArm {
        source_m: message.source_m,
        detector_centre_m: message.detector_centre_m,
        row_axis: message.row_axis,
        column_axis: message.column_axis,
        pixel_pitch_m: message.pixel_pitch_m,
        columns: message.columns,
        rows: message.rows,
    };
    c_arm.validate()?;
    Ok(c_arm)
}

/// Radius of the scene's burr.
pub fn burr_radius_m(scene: &Scene) -> f64 {
    // The standard burr has 6.5 mm.
    scene.manipulator.burr_diameter_mm.unwrap_or(6.5) * 0.5e-3
}
