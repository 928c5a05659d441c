//! `geometry_msgs` and `tf2_msgs`.

use messages::Pose;
use serde::{Deserialize, Serialize};

use super::Header;

/// `geometry_msgs/msg/Vector3` and `Point`, which have the same fields.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Vector3 {
    /// Component along x.
    pub x: f64,
    /// Component along y.
    pub y: f64,
    /// Component along z.
    pub z: f64,
}

impl From<[f64; 3]> for Vector3 {
    fn from([x, y, z]: [f64; 3]) -> Vector3 {
        Vector3 { x, y, z }
    }
}

impl From<Vector3> for [f64; 3] {
    fn from(vector: Vector3) -> [f64; 3] {
        [vector.x, vector.y, vector.z]
    }
}

/// `geometry_msgs/msg/Quaternion`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Quaternion {
    /// x of the vector part.
    pub x: f64,
    /// y of the vector part.
    pub y: f64,
    /// z of the vector part.
    pub z: f64,
    /// The scalar part.
    pub w: f64,
}

/// `geometry_msgs/msg/Pose`, and with the same fields `Transform`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct RosPose {
    /// Origin of the child frame in the parent frame, m.
    pub position: Vector3,
    /// Unit quaternion from child to parent axes.
    pub orientation: Quaternion,
}

impl From<&Pose> for RosPose {
    fn from(pose: &Pose) -> RosPose {
        let [x, y, z, w] = pose.orientation_xyzw;
        RosPose { position: pose.position_m.into(), orientation: Quaternion { x, y, z, w } }
    }
}

/// `geometry_msgs/msg/PoseStamped`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PoseStamped {
    /// Time and parent frame.
    pub header: Header,
    /// The pose.
    pub pose: RosPose,
}

/// `geometry_msgs/msg/PointStamped`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PointStamped {
    /// Time and frame.
    pub header: Header,
    /// The point.
    pub point: Vector3,
}

/// `geometry_msgs/msg/TwistStamped`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TwistStamped {
    /// Time, and the frame whose axes the components are along.
    pub header: Header,
    /// Linear velocity, m/s.
    pub linear: Vector3,
    /// Angular velocity, rad/s.
    pub angular: Vector3,
}

/// `geometry_msgs/msg/WrenchStamped`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct WrenchStamped {
    /// Time, and the frame whose axes the components are along and whose origin the torque is about.
    pub header: Header,
    /// Force, N.
    pub force: Vector3,
    /// Torque, N m.
    pub torque: Vector3,
}

/// `geometry_msgs/msg/TransformStamped`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TransformStamped {
    /// Time and parent frame.
    pub header: Header,
    /// The child frame.
    pub child_frame_id: String,
    /// Pose of the child frame in the parent frame.
    pub transform: RosPose,
}

/// `tf2_msgs/msg/TFMessage`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TfMessage {
    /// The transforms.
    pub transforms: Vec<TransformStamped>,
}
