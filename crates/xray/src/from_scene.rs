//! C-arm and renderer parameters from a scene's `[drr]`.

use scene::{Drr, PixelCentre, Projector as SceneProjector, Scene, Tolerance};

use crate::{
    CArm, Camera, DetectorFormat, DetectorParameters, DisplayParameters, DrrError, DrrParameters,
    PositionerAngles, Projector, ladder,
};

/// The projector that `[drr]` selects.
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

/// Describes the projector that `tolerance.drr_rel` selects; `None` for a scene without it or without X-ray.
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
        spectrum: drr.spectrum,
        scatter: drr.scatter,
        grid: drr.grid,
        threads: drr.threads,
        detector: DetectorParameters {
            photons_per_pixel: if drr.photons_per_pixel > 0.0 { drr.photons_per_pixel } else { 1.0e5 },
            quantum_noise: drr.photons_per_pixel > 0.0,
            blur_sigma_px: drr.blur_pixels,
            gain: drr.detector.gain,
            offset: drr.detector.offset,
            saturation: drr.detector.saturation,
        },
        display: DisplayParameters { mode: drr.display, ..DisplayParameters::default() },
        ..DrrParameters::default()
    }
}

/// The C-arm of a scene.
///
/// # Errors
/// A value is out of range; the error names it.
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

/// The C-arm of `[drr.carm]`; the scene's validation guarantees that one of its two forms is complete.
fn given_c_arm(drr: &Drr) -> Result<Option<CArm>, DrrError> {
    let Some(given) = &drr.carm else { return Ok(None) };
    let (columns, rows, pitch_m) = (drr.columns, drr.rows, drr.pixel_pitch_mm * 1e-3);
    if let (Some(intrinsics), Some(rotation), Some(translation_mm)) =
        (given.intrinsics, given.rotation, given.translation_mm)
    {
        let camera = Camera { intrinsics, rotation, translation_m: translation_mm.map(|x| x * 1e-3) };
        let centre = given.pixel_centre.unwrap_or(PixelCentre::Whole);
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

/// The point about which the scene's C-arm rotates; the origin for a scene without one.
pub fn scene_isocentre_m(scene: &Scene) -> [f64; 3] {
    scene.drr.as_ref().map_or([0.0; 3], |drr| drr.isocentre_mm.map(|x| x * 1e-3))
}
