//! The channels: the logs' topics, topics for Lichtblick, and topics that only the page reads.

use delivery::viewer::Policy;
use ipc_types::messages::layout::{Description, Message};
use ipc_types::messages::{Command, Frame};
use run_log::{RUN_TOPICS, Topic, command_topic, schema_of};

use crate::protocol::Advertisement;

/// The scene (JSON).
pub const INFO: &str = "/view/info";
/// The bone's surface, one message per block ([`crate::surface::mesh`]).
pub const SURFACE: &str = "/view/surface";
/// The same, coarse, for pages that render in software ([`crate::surface::coarse`]).
pub const COARSE_SURFACE: &str = "/view/surface_coarse";
/// The arm's links that have a mesh, one message per link, in the frame that it moves with
/// ([`crate::surface::mesh`]).
pub const ARM: &str = "/view/arm";
/// The critical structures, one message per structure ([`crate::surface::mesh`]).
pub const STRUCTURES: &str = "/view/structures";
/// The connected parts and their rates (JSON).
pub const PARTS: &str = "/view/parts";
/// Position on the time line (JSON; logs only).
pub const PLAYBACK: &str = "/view/playback";
/// The speed limit of a running session, or null (JSON; live only).
pub const PACE: &str = "/view/pace";
/// State at the position on the time line. A slow client gets it less often but never late (logs only).
pub const VIEW_STATE: &str = "/view/state";
/// Newest sensor reading at the position on the time line; in a scene with structures, that of the clearances
/// (logs only).
pub const VIEW_SENSOR: &str = "/view/sensor";
/// State of the tick at which the shown frame was taken, so that the tool can be drawn over it (logs only).
pub const FRAME_STATE: &str = "/view/frame_state";
/// Notices for the user (JSON).
pub const NOTICE: &str = "/view/notice";
/// Comparison of two logs (JSON; logs only).
pub const COMPARE: &str = "/view/compare";
/// Cause of a late tick, sent before its `TickTiming` (JSON): [`run_log::misses`].
pub const MISS: &str = "/view/miss";
/// The tool and its contacts for the 3D panel of Lichtblick and Foxglove (`foxglove.SceneUpdate`, JSON).
pub const SCENE: &str = "/view/scene";

/// A complete frame that a viewer client requested: `Frame` and its image. Scheduled frames do not replace it
/// (live only).
pub const ASKED_FRAME: &str = "/view/asked_frame";

/// Prefix of a second log's topics.
pub const SECOND: &str = "/second";
/// Topics shown from a second log.
pub const SECOND_TOPICS: [Topic; 3] = [Topic::State, Topic::DrrFrame, Topic::DrrImage];

/// One channel.
#[derive(Debug, Clone)]
pub struct Channel {
    /// The advertisement sent to clients.
    pub advertisement: Advertisement,
    /// What a slow client misses.
    pub policy: Policy,
}

/// The channels of a session or log, by number.
#[derive(Debug, Clone, Default)]
pub struct Channels(Vec<Channel>);

/// Schema of a channel's messages.
struct Schema<'a> {
    name: &'a str,
    text: String,
    encoding: &'a str,
}

impl Channels {
    /// Returns all channels: one command channel per controller, and the readings channel if the scene has
    /// sensors or structures.
    pub fn new(controllers: &[String], has_readings: bool) -> Channels {
        let mut channels = Channels::default();
        for topic in RUN_TOPICS {
            // Keyframes are internal to the physics; there is nothing to show.
            if topic != Topic::Keyframe {
                channels.logged(topic.name(), topic.description(), policy_of(topic));
            }
        }
        if has_readings {
            channels.logged(Topic::Sensor.name(), Topic::Sensor.description(), policy_of(Topic::Sensor));
        }
        for topic in TIMING {
            channels.logged(topic.name(), topic.description(), Policy::Stream);
        }
        for name in controllers {
            channels.logged(&command_topic(name), Command::DESCRIPTION, Policy::Stream);
        }
        for (topic, schema) in [
            (INFO, "trabecula.view.Info"),
            (PARTS, "trabecula.view.Parts"),
            (PLAYBACK, "trabecula.view.Playback"),
            (PACE, "trabecula.view.Pace"),
            (COMPARE, "trabecula.view.Compare"),
        ] {
            channels.json(topic, schema, Policy::Newest);
        }
        channels.json(NOTICE, "trabecula.view.Notice", Policy::Stream);
        channels.json(MISS, "trabecula.view.Miss", Policy::Stream);
        channels.json(SCENE, "foxglove.SceneUpdate", Policy::Newest);
        let (name, schema) = schema_of(Frame::DESCRIPTION);
        let schema = Schema { name, text: schema, encoding: "ros2msg" };
        channels.add(ASKED_FRAME, "trabecula.frame", schema, Policy::Newest);
        for topic in [SURFACE, COARSE_SURFACE, ARM, STRUCTURES] {
            let schema = Schema { name: "trabecula.view.Surface", text: String::new(), encoding: "" };
            channels.add(topic, "trabecula.mesh", schema, Policy::Newest);
        }
        channels
    }

    /// Adds the channels that only logs have: [`VIEW_STATE`], [`VIEW_SENSOR`] with readings, [`FRAME_STATE`],
    /// and those of a second log, shown next to the first under the prefix [`SECOND`].
    pub fn add_log(&mut self, has_second: bool) {
        self.logged(VIEW_STATE, Topic::State.description(), Policy::Newest);
        if self.id(Topic::Sensor.name()).is_some() {
            self.logged(VIEW_SENSOR, Topic::Sensor.description(), Policy::Newest);
        }
        self.logged(FRAME_STATE, Topic::State.description(), Policy::Newest);
        if !has_second {
            return;
        }
        self.logged(&format!("{SECOND}{VIEW_STATE}"), Topic::State.description(), Policy::Newest);
        for topic in RUN_TOPICS.into_iter().filter(|topic| SECOND_TOPICS.contains(topic)) {
            self.logged(&format!("{SECOND}{topic}"), topic.description(), policy_of(topic));
        }
    }

    /// Returns the channel with this number.
    pub fn get(&self, id: u32) -> Option<&Channel> {
        self.0.get((id as usize).checked_sub(1)?)
    }

    /// Returns a topic's channel number.
    pub fn id(&self, topic: &str) -> Option<u32> {
        self.0.iter().find(|channel| channel.advertisement.topic == topic).map(|c| c.advertisement.id)
    }

    /// The advertisements sent to clients.
    pub fn advertisements(&self) -> Vec<Advertisement> {
        self.0.iter().map(|channel| channel.advertisement.clone()).collect()
    }

    fn logged(&mut self, topic: &str, description: &'static Description, policy: Policy) {
        let (name, text) = schema_of(description);
        self.add(topic, "cdr", Schema { name, text, encoding: "ros2msg" }, policy);
    }

    fn json(&mut self, topic: &str, schema_name: &str, policy: Policy) {
        let text = "{\"type\":\"object\",\"properties\":{}}".to_owned();
        self.add(topic, "json", Schema { name: schema_name, text, encoding: "jsonschema" }, policy);
    }

    fn add(&mut self, topic: &str, encoding: &str, schema: Schema<'_>, policy: Policy) {
        let advertisement = Advertisement {
            id: self.0.len() as u32 + 1,
            topic: topic.to_owned(),
            encoding: encoding.to_owned(),
            schema_name: schema.name.to_owned(),
            schema: schema.text,
            schema_encoding: schema.encoding.to_owned(),
        };
        self.0.push(Channel { advertisement, policy });
    }
}

/// Returns the policy of a logged topic: clients get only the newest frame, but every message of all other
/// topics.
fn policy_of(topic: Topic) -> Policy {
    match topic {
        Topic::DrrFrame | Topic::DrrImage => Policy::Newest,
        _ => Policy::Stream,
    }
}

/// The topics of `timing.mcap`, except the commands.
pub const TIMING: [Topic; 7] = [
    Topic::TickTiming,
    Topic::FrameTiming,
    Topic::Event,
    Topic::RunControl,
    Topic::RunControlReply,
    Topic::RunStatus,
    Topic::DrrRequest,
];
