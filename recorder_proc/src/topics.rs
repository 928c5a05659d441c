//! Topic names of the two logs.

use ipc_types::layout::{Description, Message};
use ipc_types::messages::{
    DrrReply, Frame, ImagePrefix, Keyframe, Latched, Removed, SENSOR_MSGS_IMAGE_SCHEMA, State,
};

/// u_k, before the state that it leads to.
pub const LATCHED: &str = "/latched";
/// The state after each tick, and the initial one.
pub const STATE: &str = "/state";
/// The voxels that a tick removed.
pub const REMOVED: &str = "/removed";
/// Everything that the physics keeps between ticks, now and then: where a replay can begin.
pub const KEYFRAME: &str = "/keyframe";
/// Which tick a frame will show.
pub const DRR_REPLY: &str = "/drr/reply";
/// What a frame shows.
pub const DRR_FRAME: &str = "/drr/frame";
/// Its pixels, as sensor_msgs/msg/Image.
pub const DRR_IMAGE: &str = "/drr/image";

/// `TickTiming` of the timing lane.
pub const TICK_TIMING: &str = "/timing/tick";
/// `FrameTiming` of the timing lane.
pub const FRAME_TIMING: &str = "/timing/frame";
/// `Event` of the timing lane.
pub const EVENT: &str = "/event";
/// `RunControl` of the timing lane.
pub const RUN_CONTROL: &str = "/run/control";
/// `RunControlReply` of the timing lane.
pub const RUN_CONTROL_REPLY: &str = "/run/control_reply";
/// `RunStatus` of the timing lane.
pub const RUN_STATUS: &str = "/run/status";
/// `DrrRequest` of the timing lane.
pub const DRR_REQUEST: &str = "/drr/request";

/// `Command` of one controller in the timing lane.
pub fn command(controller: &str) -> String {
    format!("/command/{controller}")
}

/// Schema name of [`DRR_IMAGE`].
pub const IMAGE_SCHEMA_NAME: &str = "sensor_msgs/msg/Image";

/// The topics of `run.mcap` in the order in which their channels are declared.
pub const RUN: [(&str, &Description); 7] = [
    (LATCHED, Latched::DESCRIPTION),
    (STATE, State::DESCRIPTION),
    (REMOVED, Removed::DESCRIPTION),
    (DRR_REPLY, DrrReply::DESCRIPTION),
    (DRR_FRAME, Frame::DESCRIPTION),
    (DRR_IMAGE, ImagePrefix::DESCRIPTION),
    (KEYFRAME, Keyframe::DESCRIPTION),
];

/// Schema name and text under which a message is logged: its own, but for images that of sensor_msgs/msg/Image.
pub fn schema_of(description: &Description) -> (&'static str, String) {
    if description.name == ImagePrefix::DESCRIPTION.name {
        (IMAGE_SCHEMA_NAME, SENSOR_MSGS_IMAGE_SCHEMA.to_string())
    } else {
        (description.name, description.schema())
    }
}

/// This build's description of a logged schema name.
pub fn description_of(schema_name: &str) -> Option<&'static Description> {
    if schema_name == IMAGE_SCHEMA_NAME {
        return Some(ImagePrefix::DESCRIPTION);
    }
    ipc_types::messages::ALL.iter().copied().find(|description| description.name == schema_name)
}
