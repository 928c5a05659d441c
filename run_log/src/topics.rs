//! Topic names of the two logs.

use std::collections::BTreeMap;

use messages::layout::{Description, Element, Message};
use messages::{DrrReply, Frame, ImagePrefix, Keyframe, Latched, Removed, SENSOR_MSGS_IMAGE_SCHEMA, State};

/// u_k, before the state that it leads to.
pub const LATCHED: &str = "/latched";
/// The state after each tick, and the initial one.
pub const STATE: &str = "/state";
/// The voxels removed in a tick.
pub const REMOVED: &str = "/removed";
/// A periodic snapshot of everything that the physics keeps between ticks; a replay can start from it.
pub const KEYFRAME: &str = "/keyframe";
/// Which tick a frame will show.
pub const DRR_REPLY: &str = "/drr/reply";
/// Metadata of a frame.
pub const DRR_FRAME: &str = "/drr/frame";
/// The frame's pixels, as sensor_msgs/msg/Image.
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

/// The topics of `run.mcap`, in the order in which their channels are declared.
pub const RUN: [(&str, &Description); 7] = [
    (LATCHED, Latched::DESCRIPTION),
    (STATE, State::DESCRIPTION),
    (REMOVED, Removed::DESCRIPTION),
    (DRR_REPLY, DrrReply::DESCRIPTION),
    (DRR_FRAME, Frame::DESCRIPTION),
    (DRR_IMAGE, ImagePrefix::DESCRIPTION),
    (KEYFRAME, Keyframe::DESCRIPTION),
];

/// Schema name and text under which a message is logged: its own, except that images use sensor_msgs/msg/Image.
pub fn schema_of(description: &Description) -> (&'static str, String) {
    if description.name == ImagePrefix::DESCRIPTION.name {
        (IMAGE_SCHEMA_NAME, SENSOR_MSGS_IMAGE_SCHEMA.to_string())
    } else {
        (description.name, description.schema())
    }
}

/// Units by field-name suffix, longer suffixes first.
const UNITS: [(&str, &str); 10] = [
    ("_rad_per_s", "rad/s"),
    ("_m_per_s", "m/s"),
    ("_n_m", "N m"),
    ("_rad", "rad"),
    ("_ns", "ns"),
    ("_kg", "kg"),
    ("_m", "m"),
    ("_n", "N"),
    ("_j", "J"),
    ("_s", "s"),
];

/// A channel's metadata: the layout's hash, the unit of every field that has one, and the frame.
pub fn channel_metadata(description: &'static Description) -> BTreeMap<String, String> {
    let mut units = BTreeMap::new();
    collect_units(description, "", &mut units);
    let units: Vec<String> = units.iter().map(|(field, unit)| format!("{field}: {unit}")).collect();
    BTreeMap::from([
        ("layout_hash".to_string(), description.layout_hash()),
        ("units".to_string(), units.join("\n")),
        ("frame".to_string(), FRAME.to_string()),
    ])
}

/// Frame of all poses, points and vectors whose name does not say otherwise (`t_world_x`: x in the world).
const FRAME: &str =
    "world: patient, LPS (+x left, +y posterior, +z head), right-handed, metres; quaternions x y z w";

fn collect_units(description: &'static Description, prefix: &str, out: &mut BTreeMap<String, &'static str>) {
    for field in description.fields {
        let name = format!("{prefix}{}", field.name);
        if let Element::Message(nested) = field.element {
            collect_units(nested, &format!("{name}."), out);
        } else if let Some((_, unit)) = UNITS.iter().find(|(end, _)| field.name.ends_with(end)) {
            out.insert(name, unit);
        }
    }
}

/// This build's description for a logged schema name.
pub fn description_of(schema_name: &str) -> Option<&'static Description> {
    if schema_name == IMAGE_SCHEMA_NAME {
        return Some(ImagePrefix::DESCRIPTION);
    }
    messages::ALL.iter().copied().find(|description| description.name == schema_name)
}
