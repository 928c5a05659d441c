//! Rules for X-ray frames: which are rendered at which state, which requests are refused, and which voxels a
//! frame shows.

use std::collections::VecDeque;

use delivery::x_ray::{DueFrame, Refusal, RemovalDelta, RemovalLoss};
use hub::rate_limit::Connection;
use messages::{DrrRequest, DrrStatus, GeometryChoice, Restores, Tick};
use scene::Mode;

use super::{RATION, RATION_NS};
use crate::plan::SchedulePlan;
use crate::x_ray_plan::SentRequest;

/// Jobs that wait for the renderer. One more is being rendered, and in lockstep a blocked process holds one
/// more.
pub const JOBS_WAITING: usize = 2;
/// Requests of one connection that may wait, and of all connections.
const WAITING_EACH: usize = 8;
const WAITING: usize = 64;

/// Why a frame is rendered.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum FrameCause {
    /// It is due.
    Due(DueFrame),
    /// It is due at the last state of a run that is over.
    Last(DueFrame),
}

/// Outcome of a request.
#[derive(Debug, Clone, PartialEq)]
pub enum Answer {
    /// It exceeded its sender's rate limit and is not answered.
    PassedOver,
    /// It waits for its frame or is refused.
    Given(Result<(), Refusal>),
}

/// A set of voxels, identified by a sum over its members.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct VoxelSet {
    count: u64,
    sum: u64,
}

impl VoxelSet {
    fn add(&mut self, voxels: &[u32]) {
        let mixed = |voxel: &u32| {
            let word = (u64::from(*voxel) + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
            (word ^ word >> 29).wrapping_mul(0xbf58_476d_1ce4_e5b9)
        };
        self.count += voxels.len() as u64;
        self.sum = voxels.iter().map(mixed).fold(self.sum, u64::wrapping_add);
    }
}

/// A model of the frames, kept in parallel to [`delivery::x_ray`].
#[derive(Debug, Default)]
pub struct FrameAccount {
    plan: SchedulePlan,
    /// The first violated rule.
    pub failure: Option<String>,
    /// Whether the DRR process's queue of removed voxels overflowed.
    pub removed_dropped: bool,
    predrilled: VoxelSet,
    gone: VoxelSet,
    /// Voxels removed at each tick.
    gone_at: Vec<VoxelSet>,
    /// Voxels removed in the frames.
    rendered: VoxelSet,
    /// The next frame at the scene's rate is due in this period or later.
    next_period: u64,
    shown_tick: Option<u64>,
    waiting: VecDeque<SentRequest>,
    in_flight: usize,
    /// Frames so far.
    pub frames: u64,
    /// Requests that were refused.
    pub refused: u64,
    taken: Vec<(Connection, u64)>,
    /// The last state's tick, once the process has refused the waiting requests.
    over_at: Option<Tick>,
    /// A request that was refused at the end though the last state could have answered it.
    refused_though_due: Option<SentRequest>,
}

impl FrameAccount {
    /// Creates the model of a plan.
    pub fn new(plan: &SchedulePlan) -> FrameAccount {
        FrameAccount { plan: plan.clone(), ..FrameAccount::default() }
    }

    fn fail(&mut self, what: String) {
        self.failure.get_or_insert(what);
    }

    fn is_lockstep(&self) -> bool {
        self.plan.mode == Mode::Lockstep
    }

    /// Records that voxels are removed in the tick that the next state ends.
    pub fn removed(&mut self, restores: Restores, voxels: &[u32]) {
        if restores == Restores::Drilled {
            self.gone = self.predrilled;
        }
        self.gone.add(voxels);
    }

    /// Records that the hub has published x_k.
    pub fn state(&mut self) {
        if self.gone_at.is_empty() {
            self.predrilled = self.gone;
        }
        self.gone_at.push(self.gone);
    }

    /// Records that the DRR process has taken a request.
    pub fn request(&mut self, asked: &SentRequest, answer: &Answer, now_ns: u64) {
        let SentRequest { from, request, .. } = asked;
        self.taken.retain(|(_, at_ns)| at_ns + RATION_NS > now_ns);
        let taken = self.taken.iter().filter(|(other, _)| other == from).count();
        let Answer::Given(given) = answer else {
            expect!(self, taken >= RATION, {
                format!("{request:?} is ignored, though its sender had only {taken} answers")
            });
            return;
        };
        // Two periods of the limit may adjoin.
        expect!(self, taken < 2 * RATION, format!("{taken} requests of a sender within {RATION_NS} ns"));
        self.taken.push((*from, now_ns));
        let expected = self.expected(asked);
        expect!(self, *given == expected, format!("{request:?}: {given:?}, expected {expected:?}"));
        match given {
            Ok(()) => self.waiting.push_back(*asked),
            Err(refusal) => {
                self.refused += 1;
                let status = if *refusal == Refusal::Busy { DrrStatus::Busy } else { DrrStatus::Refused };
                expect!(self, refusal.status() == status, format!("{refusal:?} is {:?}", refusal.status()));
            }
        }
    }

    fn expected(&self, asked: &SentRequest) -> Result<(), Refusal> {
        let SentRequest { from, sender, request } = asked;
        if request.requester != DrrRequest::requester_of(*sender) {
            return Err(Refusal::OtherSender { claimed: request.requester });
        }
        if request.use_geometry() == Ok(GeometryChoice::Request) {
            if self.plan.x_ray.c_arm_driver.is_some_and(|driver| *sender != Some(driver)) {
                return Err(Refusal::NotTheDriver);
            }
            if request.geometry.columns == 0 {
                return Err(Refusal::Geometry("columns is 0".to_owned()));
            }
        }
        if request.tick > self.plan.tick_count {
            return Err(Refusal::AfterTheEnd {
                tick: Tick(request.tick),
                end_tick: Tick(self.plan.tick_count),
            });
        }
        if let Some(last_tick) = self.over_at {
            return Err(Refusal::RunEnded { last_tick });
        }
        let own = self.waiting.iter().filter(|other| other.from == *from).count();
        if own >= WAITING_EACH || self.waiting.len() >= WAITING { Err(Refusal::Busy) } else { Ok(()) }
    }

    /// Returns the period whose scheduled frame is due at this tick, if it has not been shown.
    fn period_due(&self, tick: u64) -> Option<u64> {
        let period = tick / self.plan.x_ray.period_ticks?;
        (period >= self.next_period).then_some(period)
    }

    /// Records that the DRR process hands a frame of this tick to the renderer.
    pub fn frame(&mut self, tick: u64, cause: FrameCause, since: &RemovalDelta) {
        let most = if self.is_lockstep() { JOBS_WAITING + 1 } else { 0 };
        let (in_flight, is_last) = (self.in_flight, matches!(cause, FrameCause::Last(_)));
        expect!(self, is_last || in_flight <= most, {
            format!("tick {tick}: a frame queued after {in_flight} others, at most {most}")
        });
        let is_unshown = is_last && self.shown_tick != Some(tick) && !self.waits_for(tick);
        match cause {
            FrameCause::Due(DueFrame::Requested(request))
            | FrameCause::Last(DueFrame::Requested(request)) => {
                self.requested(tick, &request);
            }
            FrameCause::Last(DueFrame::Scheduled) if self.period_due(tick).is_none() => {
                expect!(self, is_unshown, format!("tick {tick} is shown a second time at the end"));
            }
            FrameCause::Due(DueFrame::Scheduled) | FrameCause::Last(DueFrame::Scheduled) => {
                self.scheduled(tick)
            }
        }
        self.in_flight += 1;
        self.frames += 1;
        self.shown_tick = Some(tick);
        if since.restores == Restores::Drilled {
            self.rendered = VoxelSet::default();
        }
        self.rendered.add(&since.voxels);
        let (shown, gone) = (self.rendered, self.gone_at.get(tick as usize).copied());
        expect!(self, Some(shown) == gone, {
            format!("the frame of tick {tick} shows the wrong voxels: {shown:?}, not {gone:?}")
        });
    }

    /// Returns whether a request waits for a frame of this tick.
    fn waits_for(&self, tick: u64) -> bool {
        self.waiting.iter().any(|asked| asked.request.tick <= tick)
    }

    fn requested(&mut self, tick: u64, request: &DrrRequest) {
        let unshown = self.period_due(tick);
        expect!(self, unshown.is_none(), format!("tick {tick}: a request before the scheduled frame"));
        let index = self.waiting.iter().position(|asked| asked.request.tick <= tick);
        let first = index.and_then(|index| self.waiting.remove(index)).map(|asked| asked.request);
        expect!(self, first == Some(*request), {
            format!("tick {tick}: a frame for {request:?}, expected one for {first:?}")
        });
    }

    fn scheduled(&mut self, tick: u64) {
        let Some(period) = self.period_due(tick) else {
            return self.fail(format!("tick {tick}: a scheduled frame is not due"));
        };
        let ticks = self.plan.x_ray.period_ticks.unwrap_or(1);
        let on_time = tick.is_multiple_of(ticks) && period == self.next_period;
        expect!(self, on_time || !self.is_lockstep(), {
            format!("lockstep shows tick {tick}, not tick {}", self.next_period * ticks)
        });
        self.next_period = period + 1;
    }

    /// Records that the DRR process has finished with the state of this tick.
    pub fn served(&mut self, tick: u64) {
        if !self.is_lockstep() && self.in_flight > 0 {
            return;
        }
        let unshown = self.period_due(tick);
        expect!(self, unshown.is_none(), format!("tick {tick} is due but not shown"));
        let unserved = self.waiting.iter().find(|asked| asked.request.tick <= tick).copied();
        expect!(self, unserved.is_none(), format!("tick {tick}: {unserved:?} is due but waits"));
    }

    /// Records that a frame is finished.
    pub fn finished(&mut self) {
        let in_flight = self.in_flight.checked_sub(1);
        expect!(self, in_flight.is_some(), "a frame is finished that was not started".to_owned());
        self.in_flight = in_flight.unwrap_or(0);
    }

    /// Records that the DRR process ends because removed voxels are missing.
    pub fn failed(&mut self, lost: &RemovalLoss) {
        let dropped = self.removed_dropped;
        expect!(self, dropped, format!("ended though nothing was lost: {lost}"));
    }

    /// Records that the DRR process refuses the waiting requests, because the run is over with the state of
    /// this tick.
    pub fn refused_at_end(&mut self, refused: &[(DrrRequest, Refusal)], last_tick: Tick) {
        self.refused_though_due =
            self.waiting.iter().copied().find(|asked| asked.request.tick <= last_tick.0);
        let refusal = Refusal::RunEnded { last_tick };
        let expected: Vec<_> = self.waiting.drain(..).map(|asked| (asked.request, refusal.clone())).collect();
        expect!(self, refused == expected, format!("at the end: {refused:?}, expected {expected:?}"));
        self.refused += refused.len() as u64;
        self.over_at = Some(last_tick);
    }

    /// Records that the DRR process has reached the end of the run, whose last state is that of this tick.
    pub fn ended(&mut self, tick: u64) {
        let (shown, in_flight) = (self.shown_tick, self.in_flight);
        expect!(self, shown == Some(tick), format!("the last frame shows tick {shown:?}, expected {tick}"));
        expect!(self, in_flight == 0, format!("{in_flight} frames are never finished"));
        let refused = self.refused_though_due;
        expect!(self, refused.is_none(), format!("{refused:?} is due at the last state but has no frame"));
    }
}
