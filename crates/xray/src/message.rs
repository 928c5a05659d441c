//! Converts volumes and C-arms from and to messages.

use messages::{CArmGeometry, CArmProjection, Volume};
use zerocopy::FromBytes;

use crate::{CArm, DrrError, Grid, PixelCentre, VolumeView};

/// Views the volume of a message in place.
///
/// # Errors
/// [`DrrError::BadVolume`], or an error of [`VolumeView::new`].
pub fn volume_view<'v>(volume: &Volume, voxels: &'v [u8]) -> Result<VolumeView<'v>, DrrError> {
    let grid = Grid::from(volume.grid().map_err(DrrError::from)?);
    let hu = <[i16]>::ref_from_bytes(voxels)
        .map_err(|cause| DrrError::BadVolume { problem: format!("the voxels are misaligned: {cause}") })?;
    VolumeView::new(grid, hu)
}

/// Converts a C-arm to its camera and positioner message.
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

/// Converts a C-arm to a message.
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

/// Converts a message to a validated C-arm.
///
/// # Errors
/// A value is out of range; the error names it.
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
