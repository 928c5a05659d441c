use crate::message;

message! {
    /// A rigid pose `T_parent_child`: rotation as a unit quaternion (x y z w) and translation.
    /// Field names and order are those of geometry_msgs/msg/Pose, flattened.
    pub struct Pose = "trabecula_msgs/msg/Pose" {
        /// Origin of the child frame in the parent frame: x, y, z.
        position_m: [f64; 3],
        /// Unit quaternion from child to parent axes: x, y, z, w.
        orientation_xyzw: [f64; 4],
    }
}

impl Pose {
    /// The identity pose.
    pub const IDENTITY: Pose = Pose { position_m: [0.0; 3], orientation_xyzw: [0.0, 0.0, 0.0, 1.0] };
}

message! {
    /// A force and a torque in world axes.
    pub struct Wrench = "trabecula_msgs/msg/Wrench" {
        /// Force x, y, z.
        force_n: [f64; 3],
        /// Torque about the stated point x, y, z.
        torque_nm: [f64; 3],
    }
}
