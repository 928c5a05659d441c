//! `crtk_msgs`, and `rmw_dds_common`, with which a ROS 2 node announces itself.

use serde::{Deserialize, Serialize};

use super::Header;

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
