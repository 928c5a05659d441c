//! The `log_time` of a run lane's messages, which is simulated time and follows from the messages themselves.

use messages::{DrrReply, DrrStatus, Frame, ImagePrefix, Keyframe, Latched, Removed, SensorReading, State};
use zerocopy::FromBytes;

use crate::topics::Topic;

/// Returns the time that a message of `run.mcap` must have, in ns; `None` if its body does not determine it:
/// topics of the timing lane, and replies to refused requests, which may name a tick that never happens.
pub(crate) fn log_time_ns(topic: Topic, body: &[u8], dt_ns: u64) -> Option<u64> {
    let tick = match topic {
        Topic::Latched => Latched::read_from_prefix(body).ok()?.0.tick,
        Topic::State => State::read_from_prefix(body).ok()?.0.tick,
        Topic::Removed => Removed::read_from_prefix(body).ok()?.0.tick,
        Topic::Sensor => SensorReading::read_from_prefix(body).ok()?.0.tick,
        Topic::Keyframe => Keyframe::read_from_prefix(body).ok()?.0.tick,
        Topic::DrrFrame => Frame::read_from_prefix(body).ok()?.0.tick,
        Topic::DrrReply => {
            let reply = DrrReply::read_from_prefix(body).ok()?.0;
            (reply.status() == Ok(DrrStatus::Accepted)).then_some(reply.tick)?
        }
        Topic::DrrImage => {
            let image = ImagePrefix::read_from_prefix(body).ok()?.0;
            let seconds = u64::try_from(image.stamp_sec).ok()?;
            return Some(seconds * 1_000_000_000 + u64::from(image.stamp_nanosec));
        }
        Topic::TickTiming
        | Topic::FrameTiming
        | Topic::Event
        | Topic::RunControl
        | Topic::RunControlReply
        | Topic::RunStatus
        | Topic::DrrRequest => return None,
    };
    Some(tick.saturating_mul(dt_ns))
}
