//! Rules for the X-ray frames that controllers see.

use delivery::x_ray::FrameMark;
use messages::{ControllerIndex, Tick};
use scene::Mode;

use crate::plan::SchedulePlan;

/// The frames of one connection of a controller.
#[derive(Debug, Default)]
struct Seen {
    /// Frames that entered its queue, oldest first.
    delivered: Vec<FrameMark>,
    /// Those that the queue has dropped, oldest first.
    dropped: Vec<u64>,
    shown: Vec<FrameMark>,
    /// Number of dropped frames reported to the controller.
    told: u64,
}

/// A model of what controllers see, kept in parallel to [`delivery::x_ray::ControllerFrames`].
#[derive(Debug)]
pub struct SeenFrames {
    mode: Mode,
    period_ticks: Option<u64>,
    /// The first violated rule.
    pub failure: Option<String>,
    published: Vec<FrameMark>,
    controllers: Vec<Seen>,
    /// Frames shown so far.
    pub shown: u64,
}

impl SeenFrames {
    /// Creates the model of a plan.
    pub fn new(plan: &SchedulePlan) -> SeenFrames {
        SeenFrames {
            mode: plan.mode,
            period_ticks: plan.x_ray.period_ticks,
            failure: None,
            published: Vec::new(),
            controllers: plan.controllers.iter().map(|_| Seen::default()).collect(),
            shown: 0,
        }
    }

    fn fail(&mut self, what: String) {
        self.failure.get_or_insert(what);
    }

    /// Returns, in lockstep, the tick of the frame that controllers see at `tick`: half a period earlier.
    pub fn due_at(&self, tick: u64) -> Option<u64> {
        let period = self.period_ticks.filter(|_| self.mode == Mode::Lockstep)?;
        let frame = tick.checked_sub(self.delay_ticks())?;
        frame.is_multiple_of(period).then_some(frame)
    }

    fn delay_ticks(&self) -> u64 {
        self.period_ticks.map_or(0, |period| (period / 2).max(1))
    }

    /// Records that the DRR process publishes a frame.
    pub fn published(&mut self, frame: FrameMark) {
        let (sequence, expected) = (frame.sequence, self.published.len() as u64 + 1);
        expect!(self, sequence == expected, format!("frame {sequence}, expected {expected}"));
        let last = self.published.last().copied();
        let in_order = last
            .is_none_or(|last| last.tick < frame.tick || (last.tick == frame.tick && frame.request_id != 0));
        expect!(self, in_order, format!("{frame:?} after {last:?}"));
        self.published.push(frame);
    }

    /// Records that a controller connects or reconnects.
    pub fn joined(&mut self, index: ControllerIndex) {
        self.controllers[index.slot()] = Seen::default();
    }

    /// Records that a frame enters a controller's queue.
    pub fn delivered(&mut self, index: ControllerIndex, frame: FrameMark) {
        self.controllers[index.slot()].delivered.push(frame);
    }

    /// Records that a controller's queue is full and drops a frame.
    pub fn dropped(&mut self, index: ControllerIndex, frame: FrameMark) {
        self.controllers[index.slot()].dropped.push(frame.sequence);
    }

    /// Records that a controller sees a frame before it answers the state of this tick.
    pub fn showed(&mut self, index: ControllerIndex, tick: u64, frame: FrameMark) {
        self.shown += 1;
        let delay_ticks = self.delay_ticks();
        let seen = &mut self.controllers[index.slot()];
        let is_there = seen.delivered.contains(&frame) && !seen.dropped.contains(&frame.sequence);
        let is_new = seen.shown.last().is_none_or(|last| last.sequence < frame.sequence);
        seen.shown.push(frame);
        expect!(
            self,
            is_there && is_new,
            format!("tick {tick}, controller {index}: {frame:?} shown twice or not delivered")
        );
        let is_due = frame.request_id == 0 && frame.tick.0 + delay_ticks == tick;
        expect!(self, is_due || self.mode == Mode::Realtime, {
            format!("tick {tick}, controller {index}: {frame:?} is not what lockstep shows at this tick")
        });
    }

    /// Records that a controller has seen its frames before it answers the state of this tick, and that
    /// `lost` frames were reported to it as lost.
    pub fn answers(&mut self, index: ControllerIndex, tick: u64, lost: u64) {
        let due = self.due_at(tick);
        let published = due.and_then(|due| self.scheduled(due));
        let seen = &mut self.controllers[index.slot()];
        seen.told += lost;
        let Some(due) = due else {
            if self.mode == Mode::Realtime {
                self.answers_in_real_time(index, tick);
            }
            return;
        };
        let is_shown = seen.shown.last().is_some_and(|last| last.tick == Tick(due) && last.request_id == 0);
        // It was published before the controller connected, or lost.
        let cannot_be = published
            .is_some_and(|frame| !seen.delivered.contains(&frame) || seen.dropped.contains(&frame.sequence));
        expect!(self, is_shown || cannot_be, {
            format!("tick {tick}, controller {index}: answers without the frame of tick {due}")
        });
    }

    fn answers_in_real_time(&mut self, index: ControllerIndex, tick: u64) {
        let seen = &self.controllers[index.slot()];
        let left = seen
            .delivered
            .iter()
            .find(|frame| !seen.dropped.contains(&frame.sequence) && !seen.shown.contains(frame));
        let first = seen.shown.first().map_or(u64::MAX, |frame| frame.sequence);
        let last = seen.shown.last().map_or(0, |frame| frame.sequence);
        let between = seen.dropped.iter().filter(|sequence| (first..last).contains(*sequence)).count() as u64;
        let (left, told) = (left.copied(), seen.told);
        expect!(self, left.is_none(), format!("tick {tick}, controller {index}: {left:?} left unseen"));
        expect!(self, told == between, format!("controller {index}: {told} frames lost, expected {between}"));
    }

    fn scheduled(&self, tick: u64) -> Option<FrameMark> {
        self.published.iter().copied().find(|frame| frame.tick == Tick(tick) && frame.request_id == 0)
    }

    /// Records that a controller waits, with an empty queue, for the frame that it must see before it answers
    /// the state of this tick.
    pub fn waits(&mut self, index: ControllerIndex, tick: u64) {
        let due = self.due_at(tick);
        let is_out = due.is_some_and(|due| self.scheduled(due).is_some());
        expect!(self, due.is_some() && !is_out, {
            format!("tick {tick}, controller {index}: waits for the frame of tick {due:?}, already published")
        });
    }
}
