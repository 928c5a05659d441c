//! Rigid placements as three axes and an origin. Trigonometry uses `libm`, so that every machine gives the
//! same bits.

use messages::Pose;

use crate::vector::{Vec3, add_scaled, cross, dot, norm, scale, sub};

/// Pose of a frame in a parent frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Placement {
    /// The frame's axes in the parent frame.
    axes: [Vec3; 3],
    origin_m: Vec3,
}

impl Placement {
    /// The parent frame itself.
    pub(crate) const IDENTITY: Self =
        Self { axes: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], origin_m: [0.0; 3] };

    /// Converts a pose with a unit quaternion.
    pub(crate) fn of_pose(pose: &Pose) -> Self {
        let (x, z) = (x_axis(&pose.orientation_xyzw), z_axis(&pose.orientation_xyzw));
        Self { axes: [x, cross(z, x), z], origin_m: pose.position_m }
    }

    /// Converts a position and rotations about the fixed axes x, y and z, in this order, as in URDF.
    pub(crate) fn of_roll_pitch_yaw(position_m: Vec3, [roll, pitch, yaw]: [f64; 3]) -> Self {
        let [x, y, z] = Self::IDENTITY.axes;
        Self { origin_m: position_m, ..Self::IDENTITY }.turned(z, yaw).turned(y, pitch).turned(x, roll)
    }

    /// Converts a position and a rotation vector (axis times angle, deg).
    pub(crate) fn of_rotation_vector(position_m: Vec3, rotation_vector_deg: Vec3) -> Self {
        let at = Self { origin_m: position_m, ..Self::IDENTITY };
        let angle_deg = norm(rotation_vector_deg);
        if angle_deg == 0.0 {
            return at;
        }
        at.turned(scale(rotation_vector_deg, 1.0 / angle_deg), angle_deg.to_radians())
    }

    /// The frame of these perpendicular unit axes and this origin.
    pub(crate) fn of_axes(axes: [Vec3; 3], origin_m: Vec3) -> Self {
        Self { axes, origin_m }
    }

    /// The frame's axes in the parent frame.
    pub(crate) fn axes(&self) -> [Vec3; 3] {
        self.axes
    }

    /// Transforms a point to the parent frame.
    pub(crate) fn point(&self, at_m: Vec3) -> Vec3 {
        add_scaled(self.direction(at_m), 1.0, self.origin_m)
    }

    /// Transforms a direction to the parent frame.
    pub(crate) fn direction(&self, [x, y, z]: Vec3) -> Vec3 {
        add_scaled(add_scaled(scale(self.axes[0], x), y, self.axes[1]), z, self.axes[2])
    }

    /// Composes with a placement in this frame; the result is in the parent frame.
    pub(crate) fn then(&self, next: &Self) -> Self {
        Self { axes: next.axes.map(|axis| self.direction(axis)), origin_m: self.point(next.origin_m) }
    }

    /// Returns the pose of the parent frame in this one.
    pub(crate) fn inverse(&self) -> Self {
        let [x, y, z] = self.axes;
        let axes = [0, 1, 2].map(|row| [x[row], y[row], z[row]]);
        let back = sub([0.0; 3], self.origin_m);
        Self { axes, origin_m: self.axes.map(|axis| dot(axis, back)) }
    }

    /// Returns the frame rotated about a unit vector given in the frame itself.
    pub(crate) fn turned(&self, about: Vec3, angle_rad: f64) -> Self {
        let (sin, cos) = libm::sincos(angle_rad);
        // Rodrigues' formula.
        let turn = |axis: Vec3| {
            let along = scale(about, dot(about, axis) * (1.0 - cos));
            add_scaled(add_scaled(along, cos, axis), sin, cross(about, axis))
        };
        Self { axes: Self::IDENTITY.axes.map(|axis| self.direction(turn(axis))), origin_m: self.origin_m }
    }
}

/// First column of the rotation matrix of a unit quaternion.
pub(crate) fn x_axis([x, y, z, w]: &[f64; 4]) -> Vec3 {
    [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + z * w), 2.0 * (x * z - y * w)]
}

/// Third column of the rotation matrix of a unit quaternion.
pub(crate) fn z_axis([x, y, z, w]: &[f64; 4]) -> Vec3 {
    [2.0 * (x * z + y * w), 2.0 * (y * z - x * w), 1.0 - 2.0 * (x * x + y * y)]
}
