//! Assigns frames and replies a fixed place among the ticks, although their arrival depends on the renderer's
//! speed.

use std::collections::VecDeque;

use messages::services::{FRAME, STATE};
use messages::{DrrReply, DrrStatus, Frame, Tick};

use crate::header::{LogHeader, RunMode};

/// In real time a frame is written this long after the tick that it shows; rendering takes less.
const REAL_TIME_LAG_NS: u64 = 300_000_000;
/// Maximum total size of held images in bytes; above it, the oldest are written at once.
const MAX_HELD_BYTES: usize = 256 << 20;

/// Returns how many ticks after the tick it shows a frame is written.
///
/// In lockstep the physics waits for the renderer and the recorder, so neither lags by more than one state
/// queue, and twice that always suffices. In real time it is 300 ms, which keeps losses small if the recorder
/// is killed.
pub fn frame_lag_ticks(header: &LogHeader) -> u64 {
    match header.mode {
        RunMode::Lockstep => 2 * STATE.queue_length as u64,
        RunMode::RealTime => (REAL_TIME_LAG_NS / header.dt_ns.max(1)).max(FRAME.queue_length as u64),
    }
}

/// Which held messages to write now.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum WriteScope {
    /// Everything that belongs to a tick already written.
    AtItsTick,
    /// Everything held.
    All,
}

/// A waiting message, and the tick after which to write it.
#[derive(Debug)]
struct Held<T> {
    due: Tick,
    message: T,
}

/// A reply and its tick in the log.
#[derive(Debug)]
pub(crate) struct PlacedReply {
    pub tick: Tick,
    pub reply: DrrReply,
}

/// A frame, with its image if images are logged.
#[derive(Debug)]
pub(crate) struct FrameWithImage {
    pub frame: Frame,
    pub image: Option<Vec<u8>>,
}

/// Frames and replies that wait for their tick.
#[derive(Debug)]
pub(crate) struct FrameOrder {
    lag_ticks: u64,
    /// Tick of the last state written.
    tick: Option<Tick>,
    replies: VecDeque<Held<PlacedReply>>,
    frames: VecDeque<Held<FrameWithImage>>,
    held_bytes: usize,
}

impl FrameOrder {
    pub fn new(header: &LogHeader) -> FrameOrder {
        let lag_ticks = frame_lag_ticks(header);
        FrameOrder { lag_ticks, tick: None, replies: VecDeque::new(), frames: VecDeque::new(), held_bytes: 0 }
    }

    /// Notes that the state of this tick has been written.
    pub fn tick(&mut self, tick: Tick) {
        self.tick = Some(tick);
    }

    /// Queues a reply. Replies are written in order of arrival.
    ///
    /// A refusal may name a tick that never happens. It is written at the tick of its arrival, so that it
    /// does not block later replies.
    pub fn reply(&mut self, reply: &DrrReply) {
        let now = self.tick.unwrap_or(Tick::START);
        let comes = reply.status() == Ok(DrrStatus::Accepted)
            || Tick(reply.tick) <= now.saturating_add(self.lag_ticks);
        let tick = if comes { Tick(reply.tick) } else { now };
        let due = tick.saturating_add(self.lag_ticks);
        let due = self.replies.back().map_or(due, |earlier| due.max(earlier.due));
        self.replies.push_back(Held { due, message: PlacedReply { tick, reply: *reply } });
    }

    /// Queues a frame, with its image if images are logged. Frames are written in order of arrival.
    pub fn frame(&mut self, frame: &Frame, image: Option<&[u8]>) {
        let due = Tick(frame.tick).saturating_add(self.lag_ticks);
        let due = self.frames.back().map_or(due, |earlier| due.max(earlier.due));
        self.held_bytes += image.map_or(0, <[u8]>::len);
        let message = FrameWithImage { frame: *frame, image: image.map(<[u8]>::to_vec) };
        self.frames.push_back(Held { due, message });
    }

    /// The next reply that is due.
    pub fn next_reply(&mut self, due: WriteScope) -> Option<PlacedReply> {
        take_due(&mut self.replies, self.tick, due)
    }

    /// The next frame that is due, or the oldest one while the held images exceed the limit.
    pub fn next_frame(&mut self, due: WriteScope) -> Option<FrameWithImage> {
        let due = if self.held_bytes > MAX_HELD_BYTES { WriteScope::All } else { due };
        let frame = take_due(&mut self.frames, self.tick, due)?;
        self.held_bytes -= frame.image.as_ref().map_or(0, Vec::len);
        Some(frame)
    }
}

fn take_due<T>(held: &mut VecDeque<Held<T>>, tick: Option<Tick>, due: WriteScope) -> Option<T> {
    let first = held.front()?;
    let is_due = due == WriteScope::All || tick.is_some_and(|tick| first.due <= tick);
    if is_due { held.pop_front().map(|held| held.message) } else { None }
}

#[cfg(test)]
mod tests {
    use messages::{DrrReply, DrrStatus, Tick};

    use super::{FrameOrder, WriteScope};

    fn order() -> FrameOrder {
        FrameOrder {
            lag_ticks: 10,
            tick: Some(Tick(100)),
            replies: Default::default(),
            frames: Default::default(),
            held_bytes: 0,
        }
    }

    #[test]
    fn a_refusal_of_a_tick_that_never_comes_holds_no_later_reply() {
        let mut order = order();
        let refused = DrrStatus::Refused.code();
        let reply = |tick, status| DrrReply { tick, status, ..DrrReply::zeroed() };
        order.reply(&reply(u64::MAX, refused));
        order.reply(&reply(104, DrrStatus::Accepted.code()));
        order.reply(&reply(103, refused));
        let mut written = Vec::new();
        for tick in 101..120 {
            order.tick(Tick(tick));
            while let Some(placed) = order.next_reply(WriteScope::AtItsTick) {
                written.push((tick, placed.tick.0, placed.reply.tick));
            }
        }
        assert_eq!(written, [(110, 100, u64::MAX), (114, 104, 104), (114, 103, 103)]);
    }
}
