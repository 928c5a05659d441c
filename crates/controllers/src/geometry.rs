//! Conversions from a message's plain numbers to vectors, and between the C-arm's image and the world.

use messages::{CArmGeometry, Pose};
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion, Vector3};

/// Returns the origin of a pose.
pub fn position_m(pose: &Pose) -> Vector3<f64> {
    Vector3::from(pose.position_m)
}

/// Returns the rotation of a pose.
pub fn rotation(pose: &Pose) -> UnitQuaternion<f64> {
    let [x, y, z, w] = pose.orientation_xyzw;
    UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z))
}

/// Converts a pose to a transform.
pub fn isometry(pose: &Pose) -> Isometry3<f64> {
    Isometry3::from_parts(Translation3::from(position_m(pose)), rotation(pose))
}

/// Projects a world point; returns its column and row (pixel centres at integers) and the pixels per metre
/// there, or `None` behind the source.
pub fn project(c_arm: &CArmGeometry, point_m: &Vector3<f64>) -> Option<([f64; 2], f64)> {
    let source = Vector3::from(c_arm.source_m);
    let row_axis = Vector3::from(c_arm.row_axis);
    let column_axis = Vector3::from(c_arm.column_axis);
    let normal = row_axis.cross(&column_axis);
    let to_detector = Vector3::from(c_arm.detector_centre_m) - source;
    let to_point = point_m - source;
    let magnification = to_detector.dot(&normal) / to_point.dot(&normal);
    if !(magnification > 0.0 && magnification.is_finite()) {
        return None;
    }
    let on_detector = to_point * magnification - to_detector;
    let column = on_detector.dot(&row_axis) / c_arm.pixel_pitch_m[0] + 0.5 * f64::from(c_arm.columns - 1);
    let row = on_detector.dot(&column_axis) / c_arm.pixel_pitch_m[1] + 0.5 * f64::from(c_arm.rows - 1);
    Some(([column, row], magnification / c_arm.pixel_pitch_m[0]))
}

/// Intersects the ray through a pixel with the plane through `origin_m` with this normal; `None` if the ray
/// is nearly parallel to the plane.
pub fn back_project(
    c_arm: &CArmGeometry,
    pixel: [f64; 2],
    origin_m: &Vector3<f64>,
    normal: &Vector3<f64>,
) -> Option<Vector3<f64>> {
    let source = Vector3::from(c_arm.source_m);
    let across = (pixel[0] - 0.5 * f64::from(c_arm.columns - 1)) * c_arm.pixel_pitch_m[0];
    let down = (pixel[1] - 0.5 * f64::from(c_arm.rows - 1)) * c_arm.pixel_pitch_m[1];
    let on_detector = Vector3::from(c_arm.detector_centre_m)
        + Vector3::from(c_arm.row_axis) * across
        + Vector3::from(c_arm.column_axis) * down;
    let ray = on_detector - source;
    let slope = ray.dot(normal) / (ray.norm() * normal.norm());
    // Below this angle (about 6 degrees) a pixel error grows tenfold in the plane.
    if slope.abs() < 0.1 {
        return None;
    }
    Some(source + ray * ((origin_m - source).dot(normal) / ray.dot(normal)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn c_arm() -> CArmGeometry {
        CArmGeometry {
            source_m: [0.0, 0.7, 0.0],
            detector_centre_m: [0.0, -0.3, 0.0],
            row_axis: [1.0, 0.0, 0.0],
            column_axis: [0.0, 0.0, -1.0],
            pixel_pitch_m: [0.5e-3, 0.5e-3],
            columns: 301,
            rows: 201,
        }
    }

    #[test]
    fn a_point_is_magnified_by_the_ratio_of_distances() {
        let ([column, row], scale) = project(&c_arm(), &Vector3::new(0.007, 0.0, 0.014)).unwrap();
        // 1 m over 0.7 m, at 0.5 mm per pixel, from the centre (150, 100); +z is up in the image.
        assert!((column - 170.0).abs() < 1e-9 && (row - 60.0).abs() < 1e-9, "{column} {row}");
        assert!((scale - 1.0 / 0.7 / 0.5e-3).abs() < 1e-6);
    }

    #[test]
    fn back_projection_undoes_projection() {
        let point = Vector3::new(0.01, 0.02, -0.03);
        let (pixel, _) = project(&c_arm(), &point).unwrap();
        let back = back_project(&c_arm(), pixel, &point, &Vector3::new(0.1, 1.0, 0.2)).unwrap();
        assert!((back - point).norm() < 1e-12);
        assert!(back_project(&c_arm(), pixel, &point, &Vector3::x()).is_none());
    }
}
