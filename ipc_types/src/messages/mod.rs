//! The messages: every exchange between the hub's processes.
//!
//! SI units and `f64`; the unit ends the field's name. The world is the patient frame (LPS, metres); `t_parent_child`
//! is the pose of the child frame in the parent frame. Codes of `uint32` fields are constants beside their message.

mod command;
mod geometry;
mod hub;
mod image;
mod keyframe;
mod state;
mod timing;
mod volume;

pub use command::*;
pub use geometry::*;
pub use hub::*;
pub use image::*;
pub use keyframe::*;
pub use state::*;
pub use timing::*;
pub use volume::*;

use crate::layout::{Description, Message};

/// Most flexures (and so links) that a `State` carries.
pub const MAX_JOINTS: usize = 32;
/// Most contacts that a `State` lists; `contact_total` counts all of them.
pub const MAX_CONTACTS: usize = 40;
/// Most rigid bodies of a scene.
pub const MAX_BODIES: usize = 4;
/// Most tendons of a manipulator.
pub const MAX_TENDONS: usize = 4;
/// Joints of the arm.
pub const ARM_JOINTS: usize = 6;
/// Most controllers of one session.
pub const MAX_CONTROLLERS: usize = 4;

/// Every message that travels on a service, in the order of the message reference.
pub const ALL: &[&Description] = &[
    State::DESCRIPTION,
    Command::DESCRIPTION,
    Latched::DESCRIPTION,
    Removed::DESCRIPTION,
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
