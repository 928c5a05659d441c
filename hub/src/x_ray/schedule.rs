//! Which ticks are rendered: those due at the scene's frame rate and those that programs request.

use std::collections::VecDeque;

use messages::services::DRR_REQUEST;
use messages::{DRR_BUSY, DRR_REFUSED, DrrRequest, GEOMETRY_REQUEST};
use scene::{Drives, Mode, Scene};
use thiserror::Error;

use crate::rate_limit::Connection;

/// Requests that one program may have pending; further ones are refused as busy.
const MAX_WAITING_EACH: usize = 8;
/// Requests that all programs together may have pending: enough for every program that can connect.
const MAX_WAITING: usize = MAX_WAITING_EACH * DRR_REQUEST.max_publishers;

/// A frame to render now.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Due {
    /// Due at the scene's frame rate.
    Scheduled,
    /// Requested by a program.
    Requested(DrrRequest),
}

/// Whether the renderer can start at once.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Renderer {
    /// Nothing to do.
    Idle,
    /// Rendering, or has jobs queued.
    Busy,
}

/// The scene settings that decide which frames are due.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ScheduleSettings {
    /// Real time or lockstep.
    pub mode: Mode,
    /// Ticks between two frames; `None` if frames are rendered only on request.
    pub period_ticks: Option<u64>,
    /// The last tick of the run.
    pub end_tick: u64,
    /// Index of the only controller that may move the C-arm; `None` if every program may.
    pub c_arm_driver: Option<u32>,
}

impl ScheduleSettings {
    /// The settings of a scene.
    pub fn of(scene: &Scene) -> ScheduleSettings {
        let drives_c_arm = |drives: &[Drives]| drives.contains(&Drives::CArm);
        ScheduleSettings {
            mode: scene.run.mode,
            period_ticks: scene.frame_period_ticks(),
            end_tick: scene.tick_count(),
            c_arm_driver: scene
                .controller
                .iter()
                .position(|controller| drives_c_arm(&controller.drives))
                .map(|index| index as u32),
        }
    }
}

/// Why a frame request is refused.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum Refusal {
    /// The request names a controller that did not send it.
    #[error("it says that controller {claimed} asks, but another program sent it")]
    OtherSender {
        /// The controller it names.
        claimed: u32,
    },
    /// Only one controller may move the C-arm.
    #[error("the scene gives the C-arm to another controller")]
    NotTheDriver,
    /// The requested C-arm is invalid, for this reason.
    #[error("{0}")]
    Geometry(String),
    /// The requested tick is after the end of the run.
    #[error("`tick` is {tick}, the run ends at {end_tick}")]
    AfterTheEnd {
        /// The requested tick.
        tick: u64,
        /// The last tick of the run.
        end_tick: u64,
    },
    /// Too many requests pending, from this program or from all.
    #[error("too many requests wait")]
    Busy,
}

impl Refusal {
    /// The code for `DrrReply.status`.
    pub fn status(&self) -> u32 {
        if *self == Refusal::Busy { DRR_BUSY } else { DRR_REFUSED }
    }
}

/// A request waiting for its tick.
#[derive(Debug)]
struct Waiting {
    from: Connection,
    request: DrrRequest,
}

/// Decides, state by state, which frames are due.
#[derive(Debug)]
pub struct Schedule {
    settings: ScheduleSettings,
    next_tick: u64,
    requests: VecDeque<Waiting>,
    /// The tick of the newest frame.
    shown_tick: Option<u64>,
}

impl Schedule {
    /// A schedule at the start of a run.
    pub fn new(settings: ScheduleSettings) -> Schedule {
        Schedule { settings, next_tick: 0, requests: VecDeque::new(), shown_tick: None }
    }

    /// Whether frames also come without requests.
    pub fn is_periodic(&self) -> bool {
        self.settings.period_ticks.is_some()
    }

    /// Queues a request. `sender` is the index of the controller that sent it, or `u32::MAX` for any other program; `geometry` says whether
    /// the requested C-arm is valid.
    ///
    /// # Errors
    /// Why the request is refused; nothing has changed then.
    pub fn request(
        &mut self,
        from: Connection,
        sender: u32,
        request: DrrRequest,
        geometry: Result<(), String>,
    ) -> Result<(), Refusal> {
        if request.requester != sender {
            return Err(Refusal::OtherSender { claimed: request.requester });
        }
        let moves_c_arm = request.use_geometry == GEOMETRY_REQUEST;
        if moves_c_arm && self.settings.c_arm_driver.is_some_and(|driver| driver != sender) {
            return Err(Refusal::NotTheDriver);
        }
        geometry.map_err(Refusal::Geometry)?;
        let (tick, end_tick) = (request.tick, self.settings.end_tick);
        if tick > end_tick {
            return Err(Refusal::AfterTheEnd { tick, end_tick });
        }
        let own = self.requests.iter().filter(|waiting| waiting.from == from).count();
        if own >= MAX_WAITING_EACH || self.requests.len() >= MAX_WAITING {
            return Err(Refusal::Busy);
        }
        self.requests.push_back(Waiting { from, request });
        Ok(())
    }

    /// Returns a frame due at the state of this tick; the caller renders it and calls again until there is none. In lockstep every
    /// scheduled tick counts and the caller waits for the renderer; in real time a scheduled frame is due only when the renderer is idle.
    pub fn due(&mut self, tick: u64, renderer: Renderer) -> Option<Due> {
        if self.settings.mode == Mode::Realtime && renderer == Renderer::Busy {
            return None;
        }
        let due = self.scheduled(tick).or_else(|| self.requested(tick))?;
        self.shown_tick = Some(tick);
        Some(due)
    }

    /// The frame of the run's last state, unless a frame already shows it.
    pub fn last(&mut self, tick: u64) -> Option<Due> {
        (self.shown_tick.replace(tick) != Some(tick)).then_some(Due::Scheduled)
    }

    fn scheduled(&mut self, tick: u64) -> Option<Due> {
        let period = self.settings.period_ticks.filter(|_| tick >= self.next_tick)?;
        self.next_tick = (tick / period + 1) * period;
        Some(Due::Scheduled)
    }

    fn requested(&mut self, tick: u64) -> Option<Due> {
        let index = self.requests.iter().position(|waiting| waiting.request.tick <= tick)?;
        self.requests.remove(index).map(|waiting| Due::Requested(waiting.request))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const OTHER_PROGRAM: u32 = u32::MAX;

    fn schedule(mode: Mode, period_ticks: Option<u64>) -> Schedule {
        Schedule::new(ScheduleSettings { mode, period_ticks, end_tick: 1_000_000, c_arm_driver: None })
    }

    fn asked(tick: u64) -> DrrRequest {
        DrrRequest { request_id: 5, tick, requester: OTHER_PROGRAM, ..DrrRequest::zeroed() }
    }

    fn ask(schedule: &mut Schedule, from: u128, request: DrrRequest) -> Result<(), Refusal> {
        schedule.request(Connection(from), OTHER_PROGRAM, request, Ok(()))
    }

    #[test]
    fn lockstep_renders_every_scheduled_tick_and_no_other() {
        let mut schedule = schedule(Mode::Lockstep, Some(40));
        let due: Vec<u64> = (0..=120).filter(|tick| schedule.due(*tick, Renderer::Busy).is_some()).collect();
        assert_eq!(due, [0, 40, 80, 120]);
    }

    #[test]
    fn in_real_time_a_busy_renderer_delays_a_frame_and_does_not_bunch_them() {
        let mut schedule = schedule(Mode::Realtime, Some(40));
        assert_eq!(schedule.due(0, Renderer::Idle), Some(Due::Scheduled));
        assert!((1..130).all(|tick| schedule.due(tick, Renderer::Busy).is_none()));
        assert_eq!(schedule.due(130, Renderer::Idle), Some(Due::Scheduled));
        assert_eq!(schedule.due(131, Renderer::Idle), None);
        assert_eq!(schedule.due(160, Renderer::Idle), Some(Due::Scheduled));
    }

    #[test]
    fn a_request_waits_for_its_tick_and_too_many_are_refused() {
        let mut schedule = schedule(Mode::Lockstep, None);
        assert_eq!(ask(&mut schedule, 1, asked(10)), Ok(()));
        assert_eq!(schedule.due(9, Renderer::Idle), None);
        assert_eq!(schedule.due(10, Renderer::Idle), Some(Due::Requested(asked(10))));
        assert!((0..MAX_WAITING_EACH).all(|_| ask(&mut schedule, 1, asked(10)).is_ok()));
        assert_eq!(ask(&mut schedule, 1, asked(10)), Err(Refusal::Busy));
    }

    #[test]
    fn a_scheduled_frame_comes_before_the_requests_and_these_in_their_order() {
        let mut schedule = schedule(Mode::Lockstep, Some(10));
        for (tick, request_id) in [(12, 1), (10, 2), (11, 3)] {
            ask(&mut schedule, 1, DrrRequest { request_id, ..asked(tick) }).unwrap();
        }
        let mut order = Vec::new();
        for tick in [9, 12] {
            while let Some(due) = schedule.due(tick, Renderer::Idle) {
                order.push(match due {
                    Due::Scheduled => (tick, 0),
                    Due::Requested(request) => (tick, request.request_id),
                });
            }
        }
        assert_eq!(order, [(9, 0), (12, 0), (12, 1), (12, 2), (12, 3)]);
    }

    /// One program that requests ticks far ahead must not use up the other programs' places.
    #[test]
    fn a_program_that_floods_takes_no_place_from_another() {
        let mut schedule = schedule(Mode::Lockstep, None);
        for sender in 0..DRR_REQUEST.max_publishers as u128 {
            let taken = (0..100).filter(|_| ask(&mut schedule, sender, asked(1_000_000)).is_ok()).count();
            assert_eq!(taken, MAX_WAITING_EACH);
        }
    }

    #[test]
    fn a_refused_request_says_why_and_takes_no_place() {
        let settings = ScheduleSettings {
            mode: Mode::Lockstep,
            period_ticks: None,
            end_tick: 100,
            c_arm_driver: Some(1),
        };
        let mut schedule = Schedule::new(settings);
        let moving = DrrRequest { use_geometry: GEOMETRY_REQUEST, requester: 0, ..asked(10) };
        let bad = || Err("columns is 0".to_owned());
        let cases = [
            (2, moving, bad(), Refusal::OtherSender { claimed: 0 }),
            (0, moving, bad(), Refusal::NotTheDriver),
            (1, DrrRequest { requester: 1, ..moving }, bad(), Refusal::Geometry("columns is 0".to_owned())),
            (
                0,
                DrrRequest { use_geometry: 0, tick: 101, ..moving },
                Ok(()),
                Refusal::AfterTheEnd { tick: 101, end_tick: 100 },
            ),
        ];
        for (sender, request, geometry, want) in cases {
            let refused = schedule.request(Connection(3), sender, request, geometry).unwrap_err();
            assert_eq!((refused.status(), &refused), (DRR_REFUSED, &want));
        }
        assert_eq!(Refusal::Busy.status(), DRR_BUSY);
        assert_eq!(schedule.due(200, Renderer::Idle), None);
        let driver = DrrRequest { requester: 1, ..moving };
        assert_eq!(schedule.request(Connection(3), 1, driver, Ok(())), Ok(()));
    }

    #[test]
    fn the_last_state_is_shown_once() {
        let mut schedule = schedule(Mode::Realtime, Some(40));
        assert_eq!(schedule.due(80, Renderer::Idle), Some(Due::Scheduled));
        assert_eq!(schedule.last(80), None);
        assert_eq!(schedule.last(97), Some(Due::Scheduled));
    }
}
