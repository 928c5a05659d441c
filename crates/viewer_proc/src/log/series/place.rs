//! Location of a field's values in the messages of its topic.

use ipc_types::messages::Command;
use ipc_types::messages::layout::{Description, Element, Message};
use run_log::fields::{Scalar, find};
use run_log::{Topic, command_topic};

use super::{FieldName, Lane};

/// Offset of a field's value in a message, and the tick that the message belongs to.
#[derive(Debug, Clone)]
pub(in crate::log) struct FieldPlace {
    ros_type: &'static str,
    offset: usize,
    size: usize,
    /// Offset of the message's tick; only in the timing lane, where the log time is when the recorder
    /// received the message.
    tick: Option<usize>,
}

impl FieldPlace {
    /// Finds a field.
    ///
    /// # Errors
    /// No such topic or field, or not a number.
    pub(in crate::log) fn of(name: &FieldName) -> Result<FieldPlace, String> {
        let FieldName { topic, field } = name;
        let description = description_of(topic).ok_or_else(|| format!("unknown topic `{topic}`"))?;
        let place = find(description, field)?;
        let (Element::Scalar(ros_type), None) = (place.element, place.array_length) else {
            return Err(format!(
                "`{field}` of `{topic}` is not a scalar: add an index or the name of one of its fields"
            ));
        };
        let tick = description.fields.iter().find(|field| field.name == "tick").map(|field| field.offset);
        let tick = tick.filter(|_| Lane::of(topic) == Lane::Timing);
        Ok(FieldPlace { ros_type, offset: place.offset, size: place.size, tick })
    }

    /// Returns the value, or `None` if the message is too short.
    pub(in crate::log) fn read(&self, body: &[u8]) -> Option<f64> {
        let bytes = body.get(self.offset..self.offset.checked_add(self.size)?)?;
        Scalar::read(self.ros_type, bytes).map(Scalar::nearest_f64)
    }

    /// Returns the simulated time that the message belongs to, ns.
    pub(in crate::log) fn time_ns(&self, body: &[u8], log_time_ns: u64, dt_ns: u64) -> u64 {
        let tick = self.tick.and_then(|at| body.get(at..at + 8)?.try_into().ok()).map(u64::from_le_bytes);
        tick.map_or(log_time_ns, |tick| tick.saturating_mul(dt_ns))
    }
}

fn description_of(topic: &str) -> Option<&'static Description> {
    let is_command = topic.starts_with(&command_topic(""));
    is_command.then_some(Command::DESCRIPTION).or_else(|| Topic::of_name(topic).map(Topic::description))
}
