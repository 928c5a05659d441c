//! The C-arm that the tests share.

use xray::{CArm, DetectorFormat, PositionerAngles};

/// About the world's origin, 0.7 m from source to isocentre, 1.0 m to the detector.
pub fn c_arm(primary_deg: f64, secondary_deg: f64, pixels: u32, field_m: f64) -> CArm {
    let pitch = field_m / f64::from(pixels);
    let format = DetectorFormat { columns: pixels, rows: pixels, pixel_pitch_m: [pitch; 2] };
    let angles = PositionerAngles::from_degrees(primary_deg, secondary_deg);
    CArm::from_positioner_angles([0.0; 3], angles, 0.7, 1.0, format).unwrap()
}
