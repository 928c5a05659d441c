//! `crtk_msgs`, `trajectory_msgs`, and `rmw_dds_common`, with which a ROS 2 node announces itself.

use serde::{Deserialize, Serialize};

use super::{Header, Time};

/// `crtk_msgs/msg/OperatingState`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct OperatingStateMessage {
    /// Simulated time.
    pub header: Header,
    /// `DISABLED`, `ENABLED`, `PAUSED` or `FAULT`.
    pub state: String,
    /// Always true: a simulated arm needs no homing.
    pub is_homed: bool,
    /// Whether a `move_*` is in progress.
    pub is_busy: bool,
}

/// `crtk_msgs/msg/StringStamped`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct StringStamped {
    /// Unused.
    pub header: Header,
    /// The text.
    pub string: String,
}

/// `trajectory_msgs/msg/JointTrajectoryPoint`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct JointTrajectoryPoint {
    /// Joint angles, rad.
    pub positions: Vec<f64>,
    /// Ignored, like all that follows but the time.
    pub velocities: Vec<f64>,
    /// Ignored.
    pub accelerations: Vec<f64>,
    /// Ignored.
    pub effort: Vec<f64>,
    /// Time after the start. A `Duration` has the fields of a time.
    pub time_from_start: Time,
}

/// `trajectory_msgs/msg/JointTrajectory`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct JointTrajectory {
    /// The stamp is ignored: a trajectory starts when it arrives.
    pub header: Header,
    /// Names of the joints.
    pub joint_names: Vec<String>,
    /// The points.
    pub points: Vec<JointTrajectoryPoint>,
}

/// `rmw_dds_common/msg/Gid` since Iron: the DDS GUID.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Gid {
    /// The GUID's bytes.
    pub data: [u8; 16],
}

/// `rmw_dds_common/msg/NodeEntitiesInfo`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct NodeEntitiesInfo {
    /// The node's namespace, `/`.
    pub node_namespace: String,
    /// The node's name.
    pub node_name: String,
    /// Its subscriptions.
    pub reader_gid_seq: Vec<Gid>,
    /// Its publishers.
    pub writer_gid_seq: Vec<Gid>,
}

/// `rmw_dds_common/msg/ParticipantEntitiesInfo`, on the topic `ros_discovery_info`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ParticipantEntitiesInfo {
    /// The DDS participant.
    pub gid: Gid,
    /// Its nodes.
    pub node_entities_info_seq: Vec<NodeEntitiesInfo>,
}
