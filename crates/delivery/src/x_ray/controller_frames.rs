//! Which X-ray frames a controller sees before it answers a state.

use messages::{Frame, Tick};
use scene::Mode;
use thiserror::Error;

use hub::patience::ProcessTimeout;

/// How long a controller waits in lockstep for a frame that is due, ns.
const FRAME_LIMIT_NS: u64 = 120_000_000_000;

/// The properties of a frame that decide whether a controller sees it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FrameMark {
    /// `Frame.sequence`.
    pub sequence: u64,
    /// Tick of the state that it shows.
    pub tick: Tick,
    /// The request's number; 0 for a scheduled frame.
    pub request_id: u64,
}

impl From<&Frame> for FrameMark {
    fn from(frame: &Frame) -> FrameMark {
        FrameMark { sequence: frame.sequence, tick: Tick(frame.tick), request_id: frame.request_id }
    }
}

/// The next action for the frame at the head of the queue.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FrameStep {
    /// Show it to the controller, and take the next one.
    Show,
    /// Drop it, and take the next one.
    Skip,
    /// Keep it for a later state; the controller answers now.
    Keep,
    /// No frame to wait for: the controller answers now.
    Answer,
    /// Wait for a frame.
    Wait,
}

/// A frame that was due did not arrive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[error(
    "the frame of tick {tick} did not arrive within {} s; is the DRR process running?",
    FRAME_LIMIT_NS / 1_000_000_000
)]
pub struct FrameTimeout {
    /// Tick of the frame.
    pub tick: Tick,
}

/// The frames of one controller: in real time whatever has arrived, in lockstep the scheduled frame that is
/// due ([`Scene::frame_seen_at`](scene::Scene::frame_seen_at)), so that a run repeats bit for bit.
///
/// ```
/// use delivery::x_ray::{ControllerFrames, FrameMark, FrameStep};
/// use messages::Tick;
/// use scene::Mode;
///
/// let mut frames = ControllerFrames::new(Mode::Lockstep);
/// let frame = FrameMark { sequence: 1, tick: Tick(40), request_id: 0 };
/// // At 25 Hz the frame of tick 40 is seen at tick 60, however soon it is there.
/// frames.begin(None, 0);
/// assert_eq!(frames.step(Some(frame), 0), Ok(FrameStep::Keep));
/// frames.begin(Some(Tick(40)), 0);
/// assert_eq!(frames.step(None, 0), Ok(FrameStep::Wait));
/// assert_eq!(frames.step(Some(frame), 0), Ok(FrameStep::Show));
/// assert_eq!(frames.step(None, 0), Ok(FrameStep::Answer));
/// ```
#[derive(Debug)]
pub struct ControllerFrames {
    mode: Mode,
    /// Tick of the frame to wait for.
    due: Option<Tick>,
    patience: ProcessTimeout,
    /// Number of the newest frame taken.
    newest: Option<u64>,
    /// Tick of the newest dropped frame: no scheduled frame up to it can still arrive.
    skipped_tick: Option<Tick>,
    lost: u64,
}

impl ControllerFrames {
    /// Creates the state for a controller that has just connected.
    pub fn new(mode: Mode) -> ControllerFrames {
        let patience = ProcessTimeout::new(FRAME_LIMIT_NS, 0);
        ControllerFrames { mode, due: None, patience, newest: None, skipped_tick: None, lost: 0 }
    }

    /// Starts a state that the controller has taken; in lockstep it must see the frame of tick `due` first.
    /// Then call [`step`](ControllerFrames::step) until it answers.
    pub fn begin(&mut self, due: Option<Tick>, now_ns: u64) {
        // Frames arrive in the order of their ticks, the scheduled one of a tick first. A late controller
        // does not wait for a frame that has passed.
        let is_to_come = |due: &Tick| self.skipped_tick.is_none_or(|skipped| skipped < *due);
        self.due = due.filter(is_to_come).filter(|_| self.mode == Mode::Lockstep);
        self.patience = ProcessTimeout::new(FRAME_LIMIT_NS, now_ns);
    }

    /// Decides what to do with the next frame of the queue, or with an empty queue.
    ///
    /// # Errors
    /// [`FrameTimeout`].
    pub fn step(&mut self, next: Option<FrameMark>, now_ns: u64) -> Result<FrameStep, FrameTimeout> {
        let Some(frame) = next else {
            return match self.due {
                None => Ok(FrameStep::Answer),
                Some(tick) if self.patience.is_over(now_ns) => Err(FrameTimeout { tick }),
                Some(_) => Ok(FrameStep::Wait),
            };
        };
        // A kept frame is passed in a second time.
        let before = self.newest.replace(frame.sequence).unwrap_or(frame.sequence);
        self.lost += frame.sequence.saturating_sub(before + 1);
        Ok(match self.mode {
            Mode::Realtime => FrameStep::Show,
            Mode::Lockstep => self.lockstep_step(frame),
        })
    }

    fn lockstep_step(&mut self, frame: FrameMark) -> FrameStep {
        let is_scheduled = frame.request_id == 0;
        if is_scheduled && self.due == Some(frame.tick) {
            self.due = None;
            return FrameStep::Show;
        }
        self.due = self.due.filter(|due| frame.tick < *due);
        if is_scheduled && self.due.is_none() {
            return FrameStep::Keep;
        }
        self.skipped_tick = Some(frame.tick);
        FrameStep::Skip
    }

    /// Returns the number of frames that this controller's queue has dropped since the last call.
    pub fn take_lost(&mut self) -> u64 {
        std::mem::take(&mut self.lost)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scheduled(sequence: u64, tick: u64) -> FrameMark {
        FrameMark { sequence, tick: Tick(tick), request_id: 0 }
    }

    fn requested(sequence: u64, tick: u64) -> FrameMark {
        FrameMark { sequence, tick: Tick(tick), request_id: 9 }
    }

    fn step(frames: &mut ControllerFrames, next: Option<FrameMark>) -> FrameStep {
        frames.step(next, 0).unwrap()
    }

    #[test]
    fn in_real_time_a_controller_sees_what_has_arrived_and_is_told_what_it_lost() {
        let mut frames = ControllerFrames::new(Mode::Realtime);
        frames.begin(Some(Tick(40)), 0);
        assert_eq!(step(&mut frames, Some(scheduled(3, 0))), FrameStep::Show);
        assert_eq!(step(&mut frames, Some(requested(6, 50))), FrameStep::Show);
        assert_eq!(step(&mut frames, None), FrameStep::Answer);
        assert_eq!((frames.take_lost(), frames.take_lost()), (2, 0));
    }

    /// Regression: requested frames filled the queue between two scheduled ones and evicted the one that was
    /// due, for which the controller then waited.
    #[test]
    fn in_lockstep_requested_frames_do_not_pile_up_before_the_one_that_is_due() {
        let mut frames = ControllerFrames::new(Mode::Lockstep);
        frames.begin(None, 0);
        assert_eq!(step(&mut frames, Some(requested(2, 30))), FrameStep::Skip);
        assert_eq!(step(&mut frames, None), FrameStep::Answer);
        frames.begin(Some(Tick(40)), 0);
        assert_eq!(step(&mut frames, Some(scheduled(3, 40))), FrameStep::Show);
        assert_eq!(step(&mut frames, Some(requested(4, 41))), FrameStep::Skip);
        assert_eq!(step(&mut frames, None), FrameStep::Answer);
        assert_eq!(frames.take_lost(), 0);
    }

    /// Regression: it waited for two minutes, and the run failed.
    #[test]
    fn a_controller_that_connects_late_in_lockstep_waits_for_no_frame_that_has_passed() {
        for newer in [requested(8, 40), scheduled(9, 80)] {
            let mut frames = ControllerFrames::new(Mode::Lockstep);
            frames.begin(Some(Tick(40)), 0);
            assert_eq!(step(&mut frames, Some(scheduled(6, 0))), FrameStep::Skip);
            assert_eq!(step(&mut frames, None), FrameStep::Wait);
            let kept = if newer.request_id == 0 { FrameStep::Keep } else { FrameStep::Skip };
            assert_eq!(step(&mut frames, Some(newer)), kept);
            assert_eq!(step(&mut frames, None), FrameStep::Answer);
        }
        // A frame taken at an earlier state has the same effect.
        let mut frames = ControllerFrames::new(Mode::Lockstep);
        frames.begin(None, 0);
        assert_eq!(step(&mut frames, Some(requested(8, 40))), FrameStep::Skip);
        frames.begin(Some(Tick(40)), 0);
        assert_eq!(step(&mut frames, None), FrameStep::Answer);
    }

    #[test]
    fn a_frame_that_never_comes_is_an_error_that_names_it() {
        let mut frames = ControllerFrames::new(Mode::Lockstep);
        frames.begin(Some(Tick::START), 0);
        let outcome = (1..).map(|second| frames.step(None, second * 1_000_000_000)).find(Result::is_err);
        let error = outcome.unwrap().unwrap_err();
        assert_eq!(
            error.to_string(),
            "the frame of tick 0 did not arrive within 120 s; is the DRR process running?"
        );
    }
}
