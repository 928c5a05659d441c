//! Which ticks are rendered.

use std::collections::VecDeque;

use ipc_types::messages::DrrRequest;
use ipc_types::scene::Mode;
use ipc_types::services::DRR_REQUEST;

/// Requests of one program that may wait; further ones are refused as busy.
const MAX_WAITING_EACH: usize = 8;
/// Requests of all programs that may wait: of as many as may be connected.
const MAX_WAITING: usize = MAX_WAITING_EACH * DRR_REQUEST.max_publishers;

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
    /// With the connection that each came over.
    requests: VecDeque<(u128, DrrRequest)>,
}

impl Schedule {
    pub(super) fn new(mode: Mode, period_ticks: Option<u64>) -> Schedule {
        Schedule { mode, period_ticks, next_tick: 0, requests: VecDeque::new() }
    }

    /// Queues a request that came over this connection; false if too many wait.
    pub(super) fn request(&mut self, sender: u128, request: DrrRequest) -> bool {
        let own = self.requests.iter().filter(|(other, _)| *other == sender).count();
        if own >= MAX_WAITING_EACH || self.requests.len() >= MAX_WAITING {
            return false;
        }
        self.requests.push_back((sender, request));
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
        let index = self.requests.iter().position(|(_, request)| request.tick <= tick)?;
        self.requests.remove(index).map(|(_, request)| Due::Requested(request))
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
        assert!(schedule.request(1, request));
        assert_eq!(schedule.due(9, true), None);
        assert_eq!(schedule.due(10, true), Some(Due::Requested(request)));
        assert!((0..MAX_WAITING_EACH).all(|_| schedule.request(1, request)));
        assert!(!schedule.request(1, request));
    }

    /// All programs shared 16 places: one that asked for ticks far ahead took them from everybody.
    #[test]
    fn a_program_that_floods_takes_no_place_from_another() {
        let mut schedule = Schedule::new(Mode::Lockstep, None);
        let far = DrrRequest { tick: 1_000_000, ..DrrRequest::zeroed() };
        for sender in 0..DRR_REQUEST.max_publishers as u128 {
            let taken = (0..100).filter(|_| schedule.request(sender, far)).count();
            assert_eq!(taken, MAX_WAITING_EACH);
        }
    }
}
