//! Gives frames and replies, whose moment depends on the renderer's speed, a fixed place among the ticks.

use std::collections::VecDeque;

use ipc_types::messages::{DRR_ACCEPTED, DrrReply, Frame};
use ipc_types::services::{FRAME, STATE};

use crate::header::{LogHeader, RunMode};

/// In real time a frame is written this long after the tick that it shows: longer than a frame takes to render.
const REAL_TIME_LAG_NS: u64 = 300_000_000;
/// Most bytes of held images; beyond, the oldest are written at once.
const MAX_HELD_BYTES: usize = 256 << 20;

/// Number of ticks by which frames are written behind the tick that they show.
///
/// In lockstep the physics waits for the renderer and for the recorder, so that neither is more than a state queue
/// behind: twice that makes a frame's place certain. In real time it is 300 ms, so that a killed recorder loses few.
pub fn frame_lag_ticks(header: &LogHeader) -> u64 {
    match header.mode {
        RunMode::Lockstep => 2 * STATE.queue_length as u64,
        RunMode::RealTime => (REAL_TIME_LAG_NS / header.dt_ns.max(1)).max(FRAME.queue_length as u64),
    }
}

/// Frames and replies that wait for their tick.
#[derive(Debug)]
pub(crate) struct FrameOrder {
    lag_ticks: u64,
    /// Tick of the last state written.
    tick: Option<u64>,
    /// When each is due, the tick at which it stands, the reply.
    replies: VecDeque<(u64, u64, DrrReply)>,
    frames: VecDeque<(u64, Frame, Option<Vec<u8>>)>,
    held_bytes: usize,
}

impl FrameOrder {
    pub fn new(header: &LogHeader) -> FrameOrder {
        let lag_ticks = frame_lag_ticks(header);
        FrameOrder { lag_ticks, tick: None, replies: VecDeque::new(), frames: VecDeque::new(), held_bytes: 0 }
    }

    /// A state of this tick has been written.
    pub fn tick(&mut self, tick: u64) {
        self.tick = Some(tick);
    }

    /// Takes a reply. None overtakes an earlier one.
    ///
    /// A refusal may carry a tick that never comes: it then stands where it came, and holds no later one.
    pub fn reply(&mut self, reply: &DrrReply) {
        let now = self.tick.unwrap_or(0);
        let comes = reply.status == DRR_ACCEPTED || reply.tick <= now.saturating_add(self.lag_ticks);
        let tick = if comes { reply.tick } else { now };
        let due = tick.saturating_add(self.lag_ticks);
        let due = self.replies.back().map_or(due, |(earlier, _, _)| due.max(*earlier));
        self.replies.push_back((due, tick, *reply));
    }

    /// Takes a frame, with its image if that is logged. None overtakes an earlier one.
    pub fn frame(&mut self, frame: &Frame, image: Option<&[u8]>) {
        let due = frame.tick.saturating_add(self.lag_ticks);
        let due = self.frames.back().map_or(due, |(earlier, _, _)| due.max(*earlier));
        self.held_bytes += image.map_or(0, <[u8]>::len);
        self.frames.push_back((due, *frame, image.map(<[u8]>::to_vec)));
    }

    /// The next reply whose tick has come, with the tick at which it stands; with `last`, any.
    pub fn next_reply(&mut self, last: bool) -> Option<(u64, DrrReply)> {
        let due = self.replies.front()?.0;
        let (_, tick, reply) = self.is_due(due, last).then(|| self.replies.pop_front())??;
        Some((tick, reply))
    }

    /// The next frame whose tick has come; with `last` or too many held, any.
    pub fn next_frame(&mut self, last: bool) -> Option<(Frame, Option<Vec<u8>>)> {
        let any = last || self.held_bytes > MAX_HELD_BYTES;
        let due = self.frames.front()?.0;
        let (_, frame, image) = self.is_due(due, any).then(|| self.frames.pop_front())??;
        self.held_bytes -= image.as_ref().map_or(0, Vec::len);
        Some((frame, image))
    }

    fn is_due(&self, due: u64, any: bool) -> bool {
        any || self.tick.is_some_and(|tick| due <= tick)
    }
}

#[cfg(test)]
mod tests {
    use ipc_types::messages::{DRR_ACCEPTED, DrrReply};

    use super::FrameOrder;

    fn order() -> FrameOrder {
        FrameOrder {
            lag_ticks: 10,
            tick: Some(100),
            replies: Default::default(),
            frames: Default::default(),
            held_bytes: 0,
        }
    }

    #[test]
    fn a_refusal_of_a_tick_that_never_comes_holds_no_later_reply() {
        let mut order = order();
        let refused = DRR_ACCEPTED + 1;
        let reply = |tick, status| DrrReply { tick, status, ..DrrReply::zeroed() };
        order.reply(&reply(u64::MAX, refused));
        order.reply(&reply(104, DRR_ACCEPTED));
        order.reply(&reply(103, refused));
        let mut written = Vec::new();
        for tick in 101..120 {
            order.tick(tick);
            while let Some((stands, reply)) = order.next_reply(false) {
                written.push((tick, stands, reply.tick));
            }
        }
        assert_eq!(written, [(110, 100, u64::MAX), (114, 104, 104), (114, 103, 103)]);
    }
}
