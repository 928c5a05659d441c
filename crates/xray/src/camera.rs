//! C-arms in the conventions of other software: a pinhole camera (K, R, t) in both directions, and DICOM
//! positioner angles from any C-arm.
//!
//! Camera: `s (u, v, 1) = K (R x + t)`, x in the world, the camera's z toward the detector, as in OpenCV and
//! DeepDRR. In OpenCV pixel centres are integers, as in [`CArm`]; in DeepDRR and nanodrr they are at +1/2
//! ([`PixelCentre::Half`]). A radiograph is usually viewed from the detector's side, which mirrors what a
//! camera at the source sees. With a proper rotation that means a negative focal length, which DeepDRR also
//! uses.

use scene::PixelCentre;

use crate::carm::CArm;
use crate::error::{DrrError, check_orthonormal, check_range};
use crate::vector::{Vec3, add_scaled, cross, dot, scale, sub};

/// Tolerance on the orthonormality of R, as for the axes of a volume: files with five decimals keep it.
const ROTATION_LIMIT: f64 = 1e-4;
/// Deviations up to this are rounding of the last bits, and R is used as it is.
const EXACT_LIMIT: f64 = 1e-6;

/// A pinhole camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// K in pixels, row-major: `[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]`.
    pub intrinsics: [[f64; 3]; 3],
    /// R, row-major: its rows are the camera's axes in the world.
    pub rotation: [[f64; 3]; 3],
    /// t: the world origin in camera coordinates.
    pub translation_m: [f64; 3],
}

/// A C-arm's pose and distances as in DICOM's X-Ray Positioner module (PS3.3 C.8.7.5).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Positioner {
    /// (0018,1510), -pi to pi.
    pub primary_rad: f64,
    /// (0018,1511), -pi/2 to pi/2.
    pub secondary_rad: f64,
    /// (0018,1110): source to detector, along the detector's normal.
    pub source_detector_m: f64,
    /// (0018,1111): source to isocentre, along the detector's normal.
    pub source_isocentre_m: f64,
}

/// The rotation next to one with rounded decimals: keeps the viewing direction, the last row.
fn orthonormal([x, _, z]: [Vec3; 3]) -> [Vec3; 3] {
    let unit = |v: Vec3| scale(v, 1.0 / dot(v, v).sqrt());
    let z = unit(z);
    let x = unit(add_scaled(x, -dot(x, z), z));
    [x, cross(z, x), z]
}

impl CArm {
    /// The C-arm of a camera. A rotation with rounded decimals is made orthonormal. K gives the detector
    /// distance in pixels only; the pixel pitch along a row converts it to metres.
    ///
    /// # Errors
    /// A number is not finite, K has skew, a last row other than (0, 0, 1) or a focal length of 0, R is not a
    /// rotation, or [`CArm::validate`] refuses the result.
    pub fn from_camera(
        camera: &Camera,
        centre: PixelCentre,
        pixel_pitch_m: f64,
        columns: u32,
        rows: u32,
    ) -> Result<Self, DrrError> {
        let [[fx, skew, cx], [zero, fy, cy], last] = camera.intrinsics;
        check_range("intrinsics K[0][1] (skew)", skew, 0.0, 0.0, "0: a flat detector has no skew")?;
        check_range("intrinsics K[1][0]", zero, 0.0, 0.0, "0")?;
        for (value, want) in last.into_iter().zip([0.0, 0.0, 1.0]) {
            check_range("intrinsics K[2]", value, want, want, "0, 0, 1: divide K by its last element")?;
        }
        for (field, f) in [("intrinsics K[0][0] (fx)", fx), ("intrinsics K[1][1] (fy)", fy)] {
            check_range(field, f.abs(), 1.0, 1e7, "1 to 1e7 pixels, of either sign")?;
        }
        for (field, c) in [("intrinsics K[0][2] (cx)", cx), ("intrinsics K[1][2] (cy)", cy)] {
            check_range(field, c, -1e6, 1e6, "-1e6 to 1e6 pixels")?;
        }
        check_range("pixel_pitch_m", pixel_pitch_m, 1e-6, 0.1, "1e-6 to 0.1 m")?;
        check_orthonormal("rows of the rotation", &camera.rotation, ROTATION_LIMIT)?;
        let handed = dot(cross(camera.rotation[0], camera.rotation[1]), camera.rotation[2]);
        check_range("determinant of the rotation", handed, 0.5, 1.5, "1: a mirror is a negative fx or fy")?;
        let is_exact = check_orthonormal("rows of the rotation", &camera.rotation, EXACT_LIMIT).is_ok();
        let [x, y, z] = if is_exact { camera.rotation } else { orthonormal(camera.rotation) };
        for t in camera.translation_m {
            check_range("translation_m", t, -100.0, 100.0, "-100 to 100 m")?;
        }
        let distance_m = fx.abs() * pixel_pitch_m;
        let pitch = [pixel_pitch_m, distance_m / fy.abs()];
        let (row_axis, column_axis) = (scale(x, fx.signum()), scale(y, fy.signum()));
        let t = camera.translation_m;
        let source_m = [0, 1, 2].map(|i| -(x[i] * t[0] + y[i] * t[1] + z[i] * t[2]));
        let shift = if centre == PixelCentre::Half { 0.5 } else { 0.0 };
        let from_principal = [(columns, cx, pitch[0]), (rows, cy, pitch[1])]
            .map(|(n, c, p)| ((f64::from(n) - 1.0) / 2.0 - (c - shift)) * p);
        let foot = add_scaled(source_m, distance_m, z);
        let along = add_scaled(foot, from_principal[0], row_axis);
        let c_arm = Self {
            source_m,
            detector_centre_m: add_scaled(along, from_principal[1], column_axis),
            row_axis,
            column_axis,
            pixel_pitch_m: pitch,
            columns,
            rows,
        };
        c_arm.validate()?;
        Ok(c_arm)
    }

    /// The camera of a C-arm; fx is negative if the image is viewed from the detector's side.
    pub fn camera(&self, centre: PixelCentre) -> Camera {
        let (z, distance_m) = self.sight();
        let mirrored = dot(cross(self.row_axis, self.column_axis), z) < 0.0;
        let sign = if mirrored { -1.0 } else { 1.0 };
        let rotation = [scale(self.row_axis, sign), self.column_axis, z];
        let offset = sub(self.detector_centre_m, self.source_m);
        let shift = if centre == PixelCentre::Half { 0.5 } else { 0.0 };
        let [pu, pv] = self.pixel_pitch_m;
        let cx = (f64::from(self.columns) - 1.0) / 2.0 - dot(offset, self.row_axis) / pu + shift;
        let cy = (f64::from(self.rows) - 1.0) / 2.0 - dot(offset, self.column_axis) / pv + shift;
        Camera {
            intrinsics: [[sign * distance_m / pu, 0.0, cx], [0.0, distance_m / pv, cy], [0.0, 0.0, 1.0]],
            rotation,
            translation_m: rotation.map(|axis| -dot(axis, self.source_m)),
        }
    }

    /// Positioner angles of the direction from source to detector, and distances, about an isocentre. The
    /// angles do not define the image's rotation about that direction, and DICOM assumes that the central ray
    /// hits the image centre.
    pub fn positioner(&self, isocentre_m: [f64; 3]) -> Positioner {
        let (n, source_detector_m) = self.sight();
        Positioner {
            primary_rad: libm::atan2(n[0], -n[1]),
            secondary_rad: libm::asin(n[2].clamp(-1.0, 1.0)),
            source_detector_m,
            source_isocentre_m: dot(sub(isocentre_m, self.source_m), n),
        }
    }

    /// The detector's unit normal, pointing away from the source, and the source-detector distance.
    pub(crate) fn sight(&self) -> (Vec3, f64) {
        let normal = cross(self.row_axis, self.column_axis);
        let distance = dot(sub(self.detector_centre_m, self.source_m), normal);
        if distance < 0.0 { (scale(normal, -1.0), -distance) } else { (normal, distance) }
    }
}
