//! Converts between Slicer's patient frame (RAS, millimetres) and ours (LPS, metres).
//!
//! Both are right-handed: RAS is LPS turned by half a turn about the z axis.

use ipc_types::messages::Pose;
use nalgebra::{Matrix3, Quaternion, Rotation3, UnitQuaternion, Vector3};
use openigtlink::Transform;

const MM_PER_M: f64 = 1000.0;
/// Largest deviation of RᵀR from the identity, in any entry, at which a received matrix is still a rotation.
/// Allows for single precision and rounding by senders.
const ROTATION_TOLERANCE: f64 = 1e-3;

/// Converts a position of ours to Slicer's frame.
pub fn position_mm([x, y, z]: [f64; 3]) -> [f32; 3] {
    [-x, -y, z].map(|component| (MM_PER_M * component) as f32)
}

/// Converts a position of Slicer's to our frame.
pub fn position_m([x, y, z]: [f32; 3]) -> [f64; 3] {
    [-x, -y, z].map(|component| f64::from(component) / MM_PER_M)
}

/// Converts a direction to Slicer's frame.
pub fn direction([x, y, z]: [f64; 3]) -> [f32; 3] {
    [-x as f32, -y as f32, z as f32]
}

/// Converts a pose in the patient frame to one in Slicer's; the child's own axes are unchanged.
pub fn transform(t_world_child: &Pose) -> Transform {
    let [x, y, z, w] = t_world_child.orientation_xyzw;
    let rotation = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)).to_rotation_matrix();
    let column = |axis: usize| {
        let column = rotation.matrix().column(axis);
        direction([column[0], column[1], column[2]])
    };
    let columns = [column(0), column(1), column(2)];
    Transform {
        rotation: core::array::from_fn(|row| core::array::from_fn(|axis| columns[axis][row])),
        translation_mm: position_mm(t_world_child.position_m),
    }
}

/// Converts a pose in Slicer's patient frame; `None` if its matrix is not a rotation within 1e-3.
pub fn pose(t_ras_child: &Transform) -> Option<Pose> {
    let given = Matrix3::from_fn(|row, axis| f64::from(t_ras_child.rotation[row][axis]));
    let half_turn = Matrix3::from_diagonal(&Vector3::new(-1.0, -1.0, 1.0));
    let matrix = half_turn * given;
    let off = (matrix.transpose() * matrix - Matrix3::identity()).amax();
    // Written so that NaN fails.
    if !(off <= ROTATION_TOLERANCE && matrix.determinant() > 0.0) {
        return None;
    }
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix(&matrix));
    let [x, y, z, w] = [rotation.i, rotation.j, rotation.k, rotation.w];
    Some(Pose { position_m: position_m(t_ras_child.translation_mm), orientation_xyzw: [x, y, z, w] })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pose_survives_both_ways_and_left_becomes_minus_right() {
        let rotation = UnitQuaternion::from_euler_angles(0.3, -1.1, 2.0);
        let orientation_xyzw = [rotation.i, rotation.j, rotation.k, rotation.w];
        let ours = Pose { position_m: [0.1, 0.02, -0.3], orientation_xyzw };
        let theirs = transform(&ours);
        assert_eq!(theirs.translation_mm, [-100.0, -20.0, -300.0]);
        let back = pose(&theirs).unwrap();
        for (a, b) in back.orientation_xyzw.iter().zip(ours.orientation_xyzw) {
            // Single precision on the wire.
            assert!((a.abs() - b.abs()).abs() < 1e-6, "{back:?} {ours:?}");
        }
        for (a, b) in back.position_m.iter().zip(ours.position_m) {
            assert!((a - b).abs() < 1e-7);
        }
    }

    #[test]
    fn what_mirrors_or_stretches_is_no_pose() {
        let mut transform = Transform {
            rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            translation_mm: [0.0; 3],
        };
        assert!(pose(&transform).is_some());
        transform.rotation[2][2] = -1.0;
        assert!(pose(&transform).is_none(), "mirrored");
        transform.rotation[2][2] = 1.1;
        assert!(pose(&transform).is_none(), "stretched");
        transform.rotation[2][2] = f32::NAN;
        assert!(pose(&transform).is_none(), "not a number");
    }
}
