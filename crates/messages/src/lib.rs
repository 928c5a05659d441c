//! The messages: every exchange between the hub's processes, and which service carries it.
//!
//! SI units and `f64`; the unit ends the field's name. The world is the patient frame (LPS, metres);
//! `t_parent_child` is the pose of the child frame in the parent frame. Codes of `uint32` fields are enums,
//! converted when a message is taken off its port (`codes.rs`).
//!
//! One declaration with [`message!`] yields the struct, its `ros2msg` schema, its field table and its layout
//! hash. The message reference, the C header and the Python declarations are also generated from it.
//!
//! **Boundary:** bytes and names only. The transport (`ipc_types`) moves messages; the hub and the plant act
//! on them.
//!
//! **Invariants:** a message has a fixed size, is little-endian and has no padding (the compiler proves it),
//! so its bytes after [`CDR_LITTLE_ENDIAN`](layout::CDR_LITTLE_ENDIAN) are a CDR message of its schema and no
//! byte is undefined. Field names are legal in ROS. A changed layout has a different hash, and a program with
//! a different hash is refused.
//!
//! ```
//! use messages::layout::Message;
//! use messages::{Command, TendonMode};
//! use zerocopy::{FromBytes, IntoBytes};
//!
//! let mut command = Command::zeroed();
//! command.tendon_mode = TendonMode::ServoJf.code();
//! command.tendon_force_n[0] = 5.0;
//! let bytes = command.as_bytes();
//! assert_eq!(Command::read_from_bytes(bytes).unwrap().tendon_force_n[0], 5.0);
//! assert!(Command::DESCRIPTION.check_length(&bytes[1..]).is_err());
//! assert!(Command::DESCRIPTION.schema().contains("float64[4] tendon_force_n"));
//! ```
//!
//! | module | what it holds |
//! |---|---|
//! | [`layout`] | declarations, schemas, layout hashes |
//! | [`services`] | names, writers, queues and lanes |
//! | [`part`], [`plant`] | the parts of a session; what a tick steps |

mod codes;
mod command;
mod geometry;
mod hub;
mod image;
mod index;
mod keyframe;
pub mod layout;
pub mod part;
mod participant;
pub mod plant;
mod sensor;
pub mod services;
mod state;
mod timing;
mod tip_jacobian;
mod volume;

pub use codes::*;
pub use command::*;
pub use geometry::*;
pub use hub::*;
pub use image::*;
pub use index::{ControllerIndex, Tick, TickRange};
pub use keyframe::*;
pub use part::Part;
pub use participant::*;
pub use plant::{Approach, ArmEntry, Breach, PastStop, Plant, Refusal};
pub use sensor::*;
pub use state::*;
pub use timing::*;
pub use tip_jacobian::*;
pub use volume::*;

use crate::layout::{Description, Message};

/// Maximum number of flexures, and so of links, in a `State`.
pub const MAX_JOINTS: usize = 32;
/// Maximum number of contacts listed in a `State`; `contact_total` counts all of them.
pub const MAX_CONTACTS: usize = 40;
/// Maximum number of rigid bodies in a scene.
pub const MAX_BODIES: usize = 4;
/// Maximum number of tendons of a manipulator.
pub const MAX_TENDONS: usize = 4;
/// Maximum number of joints of the arm.
pub const MAX_ARM_JOINTS: usize = 7;
/// Maximum number of sensors in a scene.
pub const MAX_SENSORS: usize = 8;
/// Maximum number of values in a sensor's reading: sixteen fibre-Bragg nodes with two each.
pub const MAX_SENSOR_VALUES: usize = 32;
/// Maximum number of controllers in a session.
pub const MAX_CONTROLLERS: usize = 4;

/// Arrays that are only partly used, and the field with the used length: message, array, count.
pub const USED_LENGTHS: [(&str, &str, &str); 14] = [
    ("State", "joint_position_rad", "joint_count"),
    ("State", "joint_velocity_rad_per_s", "joint_count"),
    ("State", "t_world_link", "joint_count"),
    ("State", "tendon_tension_n", "tendon_count"),
    ("State", "tendon_displacement_m", "tendon_count"),
    ("State", "arm_joint_position_rad", "arm_joint_count"),
    ("State", "arm_joint_velocity_rad_per_s", "arm_joint_count"),
    ("State", "arm_joint_deflection_rad", "arm_joint_count"),
    ("State", "contacts", "contact_count"),
    ("SensorReading", "value", "value_count"),
    ("State", "t_world_body", "body_count"),
    ("State", "wrench_on_body", "body_count"),
    ("State", "applied", "controller_count"),
    ("Latched", "commands", "controller_count"),
];

/// Every message that travels on a service, in the order of the message reference.
pub const ALL: &[&Description] = &[
    State::DESCRIPTION,
    Command::DESCRIPTION,
    Latched::DESCRIPTION,
    Removed::DESCRIPTION,
    SensorReading::DESCRIPTION,
    TipJacobian::DESCRIPTION,
    Keyframe::DESCRIPTION,
    Volume::DESCRIPTION,
    Frame::DESCRIPTION,
    DrrRequest::DESCRIPTION,
    DrrReply::DESCRIPTION,
    RunControl::DESCRIPTION,
    RunControlReply::DESCRIPTION,
    RunStatus::DESCRIPTION,
    Event::DESCRIPTION,
    Progress::DESCRIPTION,
    TickTiming::DESCRIPTION,
    FrameTiming::DESCRIPTION,
];
