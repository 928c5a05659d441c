//! Which ticks are rendered.

use std::collections::VecDeque;

use ipc_types::messages::DrrRequest;
use ipc_types::scene::Mode;

/// Requests that may wait; further ones are refused as busy.
const MAX_WAITING: usize = 16;

/// A frame to be rendered now.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Due {
    /// The scene's schedule wants it.
    Scheduled,
    /// Somebody asked for it.
    Requested(DrrRequest),
}

/// Decides, state by state, what is due.
#[derive(Debug)]
pub(super) struct Schedule {
    mode: Mode,
    period_ticks: Option<u64>,
    next_tick: u64,
    requests: VecDeque<DrrRequest>,
}

impl Schedule {
    pub(super) fn new(mode: Mode, period_ticks: Option<u64>) -> Schedule {
        Schedule { mode, period_ticks, next_tick: 0, requests: VecDeque::new() }
    }

    /// Queues a request; false if too many wait.
    pub(super) fn request(&mut self, request: DrrRequest) -> bool {
        if self.requests.len() >= MAX_WAITING {
            return false;
        }
        self.requests.push_back(request);
        true
    }

    /// What is due at the state of this tick, one frame at a time; `free` says whether the renderer is idle. In
    /// lockstep the exact tick counts and the caller waits for the renderer; in real time only a free renderer starts.
    pub(super) fn due(&mut self, tick: u64, free: bool) -> Option<Due> {
        if self.mode == Mode::Realtime && !free {
            return None;
        }
        if let Some(period) = self.period_ticks
            && tick >= self.next_tick
        {
            self.next_tick = (tick / period + 1) * period;
            return Some(Due::Scheduled);
        }
        let index = self.requests.iter().position(|request| request.tick <= tick)?;
        self.requests.remove(index).map(Due::Requested)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lockstep_renders_every_scheduled_tick_and_no_other() {
        let mut schedule = Schedule::new(Mode::Lockstep, Some(40));
        let due: Vec<u64> = (0..=120).filter(|tick| schedule.due(*tick, false).is_some()).collect();
        assert_eq!(due, [0, 40, 80, 120]);
    }

    #[test]
    fn in_real_time_a_busy_renderer_delays_a_frame_and_does_not_bunch_them() {
        let mut schedule = Schedule::new(Mode::Realtime, Some(40));
        assert_eq!(schedule.due(0, true), Some(Due::Scheduled));
        assert!((1..130).all(|tick| schedule.due(tick, false).is_none()));
        assert_eq!(schedule.due(130, true), Some(Due::Scheduled));
        assert_eq!(schedule.due(131, true), None);
        assert_eq!(schedule.due(160, true), Some(Due::Scheduled));
    }

    #[test]
    fn a_request_waits_for_its_tick_and_too_many_are_refused() {
        let mut schedule = Schedule::new(Mode::Lockstep, None);
        let request = DrrRequest { request_id: 5, tick: 10, ..DrrRequest::zeroed() };
        assert!(schedule.request(request));
        assert_eq!(schedule.due(9, true), None);
        assert_eq!(schedule.due(10, true), Some(Due::Requested(request)));
        assert!((0..MAX_WAITING).all(|_| schedule.request(request)));
        assert!(!schedule.request(request));
    }
}
