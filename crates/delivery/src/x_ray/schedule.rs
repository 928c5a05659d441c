//! Which ticks are rendered: those due at the scene's frame rate and those that programs request.

use std::collections::VecDeque;

use messages::services::DRR_REQUEST;
use messages::{ControllerIndex, DrrRequest, DrrStatus, GeometryChoice, Tick};
use scene::{Drives, Mode, Scene};
use thiserror::Error;

use hub::rate_limit::Connection;

/// Requests that one program may have pending; further ones are refused as busy.
const MAX_WAITING_EACH: usize = 8;
/// Requests that all programs together may have pending: enough for every program that can connect.
const MAX_WAITING: usize = MAX_WAITING_EACH * DRR_REQUEST.max_publishers;

/// A frame to render now.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum DueFrame {
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
    pub end_tick: Tick,
    /// Index of the only controller that may move the C-arm; `None` if every program may.
    pub c_arm_driver: Option<ControllerIndex>,
}

impl ScheduleSettings {
    /// Takes the settings from a scene.
    pub fn of(scene: &Scene) -> ScheduleSettings {
        let drives_c_arm = |drives: &[Drives]| drives.contains(&Drives::CArm);
        ScheduleSettings {
            mode: scene.run.mode,
            period_ticks: scene.frame_period_ticks(),
            end_tick: Tick(scene.tick_count()),
            c_arm_driver: scene
                .controller
                .iter()
                .position(|controller| drives_c_arm(&controller.drives))
                .map(|index| ControllerIndex(index as u32)),
        }
    }
}

/// Why a frame request is refused.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum Refusal {
    /// The request names a controller that did not send it.
    #[error("`requester` is controller {claimed}, but another program sent the request")]
    OtherSender {
        /// The controller that it names.
        claimed: u32,
    },
    /// Only one controller may move the C-arm.
    #[error("the scene assigns the C-arm to another controller")]
    NotTheDriver,
    /// The requested C-arm is invalid; holds the reason.
    #[error("{0}")]
    Geometry(String),
    /// The requested tick is after the end of the run.
    #[error("`tick` is {tick}, the run ends at {end_tick}")]
    AfterTheEnd {
        /// The requested tick.
        tick: Tick,
        /// The last tick of the run.
        end_tick: Tick,
    },
    /// Too many pending requests, of this program or of all together.
    #[error("too many pending requests")]
    Busy,
    /// The run has ended, before the requested tick or before the request arrived.
    #[error("the run ended at tick {last_tick}")]
    RunEnded {
        /// The last state's tick.
        last_tick: Tick,
    },
}

impl Refusal {
    /// Returns the status of the reply.
    pub fn status(&self) -> DrrStatus {
        if *self == Refusal::Busy { DrrStatus::Busy } else { DrrStatus::Refused }
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
    next_tick: Tick,
    requests: VecDeque<Waiting>,
    /// The tick of the newest frame.
    shown_tick: Option<Tick>,
    /// The last state's tick, once the run has ended.
    ended_at: Option<Tick>,
}

impl Schedule {
    /// Creates a schedule at the start of a run.
    pub fn new(settings: ScheduleSettings) -> Schedule {
        Schedule {
            settings,
            next_tick: Tick::START,
            requests: VecDeque::new(),
            shown_tick: None,
            ended_at: None,
        }
    }

    /// Returns whether frames are also rendered without requests.
    pub fn is_periodic(&self) -> bool {
        self.settings.period_ticks.is_some()
    }

    /// Queues a request. `sender` is the controller that sent it, or `None` for any other program; `geometry`
    /// is the result of checking the requested C-arm. A request with an unknown `use_geometry` is treated as
    /// one for the scene's C-arm.
    ///
    /// # Errors
    /// The reason for the refusal; the schedule is then unchanged.
    pub fn request(
        &mut self,
        from: Connection,
        sender: Option<ControllerIndex>,
        request: DrrRequest,
        geometry: Result<(), String>,
    ) -> Result<(), Refusal> {
        if request.requester != DrrRequest::requester_of(sender) {
            return Err(Refusal::OtherSender { claimed: request.requester });
        }
        let moves_c_arm = request.use_geometry() == Ok(GeometryChoice::Request);
        if moves_c_arm && self.settings.c_arm_driver.is_some_and(|driver| sender != Some(driver)) {
            return Err(Refusal::NotTheDriver);
        }
        geometry.map_err(Refusal::Geometry)?;
        let (tick, end_tick) = (Tick(request.tick), self.settings.end_tick);
        if tick > end_tick {
            return Err(Refusal::AfterTheEnd { tick, end_tick });
        }
        if let Some(last_tick) = self.ended_at {
            return Err(Refusal::RunEnded { last_tick });
        }
        let own = self.requests.iter().filter(|waiting| waiting.from == from).count();
        if own >= MAX_WAITING_EACH || self.requests.len() >= MAX_WAITING {
            return Err(Refusal::Busy);
        }
        self.requests.push_back(Waiting { from, request });
        Ok(())
    }

    /// Returns a frame due at the state of this tick; the caller renders it and calls again until it returns
    /// `None`. In lockstep every scheduled tick counts and the caller waits for the renderer; in real time a
    /// scheduled frame is due only when the renderer is idle.
    pub fn due(&mut self, tick: Tick, renderer: Renderer) -> Option<DueFrame> {
        if self.settings.mode == Mode::Realtime && renderer == Renderer::Busy {
            return None;
        }
        let due = self.scheduled(tick).or_else(|| self.requested(tick))?;
        self.shown_tick = Some(tick);
        Some(due)
    }

    /// Returns a frame due at the run's last state, whether or not the renderer is busy; the caller calls
    /// again until it returns `None`. The last is that of the state itself, unless a frame already shows it.
    pub fn last(&mut self, tick: Tick) -> Option<DueFrame> {
        let due = self.scheduled(tick).or_else(|| self.requested(tick));
        let is_shown = self.shown_tick.replace(tick) == Some(tick);
        due.or_else(|| (!is_shown).then_some(DueFrame::Scheduled))
    }

    /// Ends the run with the state of this tick; returns the requests that can no longer get a frame, each to
    /// be answered with its refusal. Later requests are refused for the same reason.
    pub fn end(&mut self, last_tick: Tick) -> Vec<(DrrRequest, Refusal)> {
        self.ended_at = Some(last_tick);
        let refused = |waiting: Waiting| (waiting.request, Refusal::RunEnded { last_tick });
        self.requests.drain(..).map(refused).collect()
    }

    fn scheduled(&mut self, tick: Tick) -> Option<DueFrame> {
        let period = self.settings.period_ticks.filter(|_| tick >= self.next_tick)?;
        self.next_tick = Tick((tick.0 / period + 1) * period);
        Some(DueFrame::Scheduled)
    }

    fn requested(&mut self, tick: Tick) -> Option<DueFrame> {
        let index = self.requests.iter().position(|waiting| waiting.request.tick <= tick.0)?;
        self.requests.remove(index).map(|waiting| DueFrame::Requested(waiting.request))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn schedule(mode: Mode, period_ticks: Option<u64>) -> Schedule {
        Schedule::new(ScheduleSettings { mode, period_ticks, end_tick: Tick(1_000_000), c_arm_driver: None })
    }

    fn asked(tick: u64) -> DrrRequest {
        DrrRequest { request_id: 5, tick, requester: DrrRequest::requester_of(None), ..DrrRequest::zeroed() }
    }

    fn ask(schedule: &mut Schedule, from: u128, request: DrrRequest) -> Result<(), Refusal> {
        schedule.request(Connection(from), None, request, Ok(()))
    }

    #[test]
    fn lockstep_renders_every_scheduled_tick_and_no_other() {
        let mut schedule = schedule(Mode::Lockstep, Some(40));
        let due: Vec<u64> =
            (0..=120).filter(|tick| schedule.due(Tick(*tick), Renderer::Busy).is_some()).collect();
        assert_eq!(due, [0, 40, 80, 120]);
    }

    #[test]
    fn in_real_time_a_busy_renderer_delays_a_frame_and_does_not_bunch_them() {
        let mut schedule = schedule(Mode::Realtime, Some(40));
        assert_eq!(schedule.due(Tick(0), Renderer::Idle), Some(DueFrame::Scheduled));
        assert!((1..130).all(|tick| schedule.due(Tick(tick), Renderer::Busy).is_none()));
        assert_eq!(schedule.due(Tick(130), Renderer::Idle), Some(DueFrame::Scheduled));
        assert_eq!(schedule.due(Tick(131), Renderer::Idle), None);
        assert_eq!(schedule.due(Tick(160), Renderer::Idle), Some(DueFrame::Scheduled));
    }

    #[test]
    fn a_request_waits_for_its_tick_and_too_many_are_refused() {
        let mut schedule = schedule(Mode::Lockstep, None);
        assert_eq!(ask(&mut schedule, 1, asked(10)), Ok(()));
        assert_eq!(schedule.due(Tick(9), Renderer::Idle), None);
        assert_eq!(schedule.due(Tick(10), Renderer::Idle), Some(DueFrame::Requested(asked(10))));
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
            while let Some(due) = schedule.due(Tick(tick), Renderer::Idle) {
                order.push(match due {
                    DueFrame::Scheduled => (tick, 0),
                    DueFrame::Requested(request) => (tick, request.request_id),
                });
            }
        }
        assert_eq!(order, [(9, 0), (12, 0), (12, 1), (12, 2), (12, 3)]);
    }

    /// One program that requests ticks far ahead must not use up the other programs' slots.
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
            end_tick: Tick(100),
            c_arm_driver: Some(ControllerIndex(1)),
        };
        let mut schedule = Schedule::new(settings);
        let moving = DrrRequest { use_geometry: GeometryChoice::Request.code(), requester: 0, ..asked(10) };
        let bad = || Err("columns is 0".to_owned());
        let cases = [
            (2, moving, bad(), Refusal::OtherSender { claimed: 0 }),
            (0, moving, bad(), Refusal::NotTheDriver),
            (1, DrrRequest { requester: 1, ..moving }, bad(), Refusal::Geometry("columns is 0".to_owned())),
            (
                0,
                DrrRequest { use_geometry: 0, tick: 101, ..moving },
                Ok(()),
                Refusal::AfterTheEnd { tick: Tick(101), end_tick: Tick(100) },
            ),
        ];
        for (sender, request, geometry, want) in cases {
            let refused = schedule
                .request(Connection(3), Some(ControllerIndex(sender)), request, geometry)
                .unwrap_err();
            assert_eq!((refused.status(), &refused), (DrrStatus::Refused, &want));
        }
        assert_eq!(Refusal::Busy.status(), DrrStatus::Busy);
        assert_eq!(schedule.due(Tick(200), Renderer::Idle), None);
        let driver = DrrRequest { requester: 1, ..moving };
        assert_eq!(schedule.request(Connection(3), Some(ControllerIndex(1)), driver, Ok(())), Ok(()));
    }

    #[test]
    fn the_last_state_is_shown_once() {
        let mut schedule = schedule(Mode::Realtime, Some(40));
        assert_eq!(schedule.due(Tick(80), Renderer::Idle), Some(DueFrame::Scheduled));
        assert_eq!(schedule.last(Tick(80)), None);
        assert_eq!(schedule.last(Tick(97)), Some(DueFrame::Scheduled));
        assert_eq!(schedule.last(Tick(97)), None);
    }

    /// Regression: a request that waited for a busy renderer when a real-time run ended got no answer.
    #[test]
    fn every_request_that_waits_at_the_end_has_its_frame_or_a_refusal() {
        for mode in [Mode::Lockstep, Mode::Realtime] {
            let mut schedule = schedule(mode, Some(40));
            assert_eq!(schedule.due(Tick::START, Renderer::Idle), Some(DueFrame::Scheduled));
            let due = [asked(90), DrrRequest { request_id: 6, ..asked(97) }];
            let beyond = DrrRequest { request_id: 7, ..asked(98) };
            for request in [due[0], beyond, due[1]] {
                ask(&mut schedule, 1, request).unwrap();
            }
            let frames: Vec<DueFrame> = std::iter::from_fn(|| schedule.last(Tick(97))).collect();
            assert_eq!(
                frames,
                [DueFrame::Scheduled, DueFrame::Requested(due[0]), DueFrame::Requested(due[1])]
            );
            let refusal = Refusal::RunEnded { last_tick: Tick(97) };
            assert_eq!(schedule.end(Tick(97)), [(beyond, refusal.clone())]);
            assert_eq!(refusal.to_string(), "the run ended at tick 97");
            assert_eq!(ask(&mut schedule, 1, asked(0)), Err(refusal));
            assert_eq!(schedule.end(Tick(97)), []);
        }
    }
}
