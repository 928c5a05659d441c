//! The topics of the two logs: their names, and which message each carries.

use std::collections::BTreeMap;
use std::fmt::{self, Display, Formatter};

use messages::layout::{Description, Element, Message};
use messages::{
    DrrReply, DrrRequest, Event, Frame, FrameTiming, ImagePrefix, Keyframe, Latched, Removed, RunControl,
    RunControlReply, RunStatus, SENSOR_MSGS_IMAGE_SCHEMA, SensorReading, State, TickTiming,
};

/// A message with exactly one topic. [`messages::Command`] has one topic per controller: `command`.
pub trait Logged: Message {
    /// Its topic.
    const TOPIC: Topic;
}

/// Declares the topics, each with its name and its message.
macro_rules! topics {
    ($($(#[$doc:meta])* $topic:ident: $message:ident = $name:literal;)*) => {
        /// A topic of the two logs. A controller's commands have topics named after it: `command`.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub enum Topic {
            $($(#[$doc])* $topic,)*
        }

        impl Topic {
            /// All of them.
            pub const ALL: &'static [Topic] = &[$(Topic::$topic),*];

            /// Its name in a log.
            pub const fn name(self) -> &'static str {
                match self {
                    $(Topic::$topic => $name,)*
                }
            }

            /// Its message.
            pub const fn description(self) -> &'static Description {
                match self {
                    $(Topic::$topic => $message::DESCRIPTION,)*
                }
            }
        }

        $(impl Logged for $message {
            const TOPIC: Topic = Topic::$topic;
        })*
    };
}

topics! {
    /// u_k, before the state that it leads to.
    Latched: Latched = "/latched";
    /// The state after each tick, and the initial one.
    State: State = "/state";
    /// The voxels removed in a tick.
    Removed: Removed = "/removed";
    /// Which tick a frame will show.
    DrrReply: DrrReply = "/drr/reply";
    /// Metadata of a frame.
    DrrFrame: Frame = "/drr/frame";
    /// The frame's pixels, as sensor_msgs/msg/Image.
    DrrImage: ImagePrefix = "/drr/image";
    /// A periodic snapshot of everything that the physics keeps between ticks; a replay can start from it.
    Keyframe: Keyframe = "/keyframe";
    /// `TickTiming` of the timing lane.
    TickTiming: TickTiming = "/timing/tick";
    /// `FrameTiming` of the timing lane.
    FrameTiming: FrameTiming = "/timing/frame";
    /// `Event` of the timing lane.
    Event: Event = "/event";
    /// `RunControl` of the timing lane.
    RunControl: RunControl = "/run/control";
    /// `RunControlReply` of the timing lane.
    RunControlReply: RunControlReply = "/run/control_reply";
    /// `RunStatus` of the timing lane.
    RunStatus: RunStatus = "/run/status";
    /// `DrrRequest` of the timing lane.
    DrrRequest: DrrRequest = "/drr/request";
    /// Sensor readings, in `run.mcap`; only for scenes with sensors.
    Sensor: SensorReading = "/sensor";
}

impl Topic {
    /// Returns the topic with this name; `None` for a controller's commands and for names unknown to this
    /// build.
    pub fn of_name(name: &str) -> Option<Topic> {
        Topic::ALL.iter().copied().find(|topic| topic.name() == name)
    }
}

impl Display for Topic {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// `Command` of one controller in the timing lane.
pub fn command_topic(controller: &str) -> String {
    format!("/command/{controller}")
}

/// Schema name of [`Topic::DrrImage`].
pub const IMAGE_SCHEMA_NAME: &str = "sensor_msgs/msg/Image";

/// The topics of `run.mcap`, in the order in which their channels are declared. [`Topic::Sensor`] follows
/// with the first reading.
pub const RUN_TOPICS: [Topic; 7] = [
    Topic::Latched,
    Topic::State,
    Topic::Removed,
    Topic::DrrReply,
    Topic::DrrFrame,
    Topic::DrrImage,
    Topic::Keyframe,
];

/// Returns the schema name and text under which a message is logged: its own, except that images use
/// sensor_msgs/msg/Image.
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

/// Returns the unit of a field, from the end of its name; `None` if it has none.
pub fn unit_of(field: &str) -> Option<&'static str> {
    UNITS.iter().find(|(suffix, _)| field.ends_with(suffix)).map(|(_, unit)| *unit)
}

/// Returns a channel's metadata: the layout's hash, the unit of every field that has one, and the frame.
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
        } else if let Some(unit) = unit_of(field.name) {
            out.insert(name, unit);
        }
    }
}

/// Returns this build's description for a logged schema name.
pub fn description_of(schema_name: &str) -> Option<&'static Description> {
    if schema_name == IMAGE_SCHEMA_NAME {
        return Some(ImagePrefix::DESCRIPTION);
    }
    messages::ALL.iter().copied().find(|description| description.name == schema_name)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Readers of logs (our earlier builds and other programs) know topics by these names.
    #[test]
    fn topics_have_the_names_that_logs_hold() {
        let names = [
            "/latched",
            "/state",
            "/removed",
            "/drr/reply",
            "/drr/frame",
            "/drr/image",
            "/keyframe",
            "/timing/tick",
            "/timing/frame",
            "/event",
            "/run/control",
            "/run/control_reply",
            "/run/status",
            "/drr/request",
            "/sensor",
        ];
        assert_eq!(Topic::ALL.iter().map(|topic| topic.name()).collect::<Vec<_>>(), names);
        assert_eq!(RUN_TOPICS.map(Topic::name), names[..RUN_TOPICS.len()]);
        for topic in Topic::ALL {
            assert_eq!(Topic::of_name(topic.name()), Some(*topic));
        }
        assert_eq!(Topic::of_name(&command_topic("drill")), None);
        assert_eq!(Frame::TOPIC.name(), "/drr/frame");
    }
}
