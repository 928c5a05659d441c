//! The DRR process in memory: decides with [`delivery::x_ray`] as `drr_proc` does, and renders by waiting.

use std::collections::VecDeque;

use delivery::x_ray::{
    DueFrame, FrameMark, RemovalLoss, Removals, RemovedBatch, Renderer, Schedule, ScheduleSettings,
};
use fastrand::Rng;
use hub::rate_limit::{LOOKED_AT, RateLimit};
use messages::services::DRR_REQUEST;
use messages::{DrrRequest, GeometryChoice, Removed, State, Tick};

use crate::oracle::x_ray::{Answer, FrameAccount, FrameCause, JOBS_WAITING};
use crate::plan::SchedulePlan;
use crate::x_ray_plan::SentRequest;

/// States taken before requests are checked again.
const STATES_PER_ROUND: usize = 32;

/// The part of a state that the process needs.
#[derive(Debug, Clone, Copy)]
struct Seen {
    tick: u64,
    removed_total: u64,
}

/// How a pass over the queues ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum QueuePass {
    /// Everything that waited has been taken.
    Done,
    /// The renderer's queue is full; the process is blocked until then.
    Blocked {
        /// When the next frame is finished.
        until_ns: u64,
    },
}

/// The DRR process.
#[derive(Debug)]
pub struct DrrProcess {
    schedule: Schedule,
    removals: Removals,
    rate_limit: RateLimit,
    random: Rng,
    render_ns: u64,
    /// Capacities of its queues.
    state_queue: usize,
    removed_queue: usize,
    states: VecDeque<Seen>,
    removed: VecDeque<RemovedBatch>,
    requests: VecDeque<SentRequest>,
    /// The newest state that it has taken.
    newest: Option<Seen>,
    /// It was blocked by the renderer's queue, so that more may be due at the newest state.
    stood_still: bool,
    /// Frames being rendered or waiting to be.
    jobs: VecDeque<Job>,
    sequence: u64,
    /// Frames that are published but not passed on yet.
    published: Vec<FrameMark>,
}

/// A frame being rendered or waiting to be.
#[derive(Debug)]
struct Job {
    finished_ns: u64,
    mark: FrameMark,
}

impl DrrProcess {
    /// Creates the process of a plan, at the beginning.
    pub fn new(plan: &SchedulePlan) -> DrrProcess {
        DrrProcess {
            schedule: Schedule::new(ScheduleSettings {
                mode: plan.mode,
                period_ticks: plan.x_ray.period_ticks,
                end_tick: Tick(plan.tick_count),
                c_arm_driver: plan.x_ray.c_arm_driver,
            }),
            removals: Removals::default(),
            rate_limit: RateLimit::default(),
            random: Rng::with_seed(plan.x_ray.seed),
            render_ns: plan.x_ray.render_ns,
            state_queue: plan.x_ray.state_queue,
            removed_queue: plan.x_ray.removed_queue,
            states: VecDeque::new(),
            removed: VecDeque::new(),
            requests: VecDeque::new(),
            newest: None,
            stood_still: false,
            jobs: VecDeque::new(),
            sequence: 0,
            published: Vec::new(),
        }
    }

    /// Puts removed voxels into its queue, which drops its oldest when full.
    pub fn receive_removed(&mut self, removed: &Removed, voxels: &[u32], account: &mut FrameAccount) {
        if self.removed.len() == self.removed_queue {
            self.removed.pop_front();
            account.removed_dropped = true;
        }
        self.removed.push_back(RemovedBatch {
            tick: Tick(removed.tick),
            sequence: removed.sequence,
            total: removed.removed_total,
            restores: removed.restores(),
            voxels: voxels.to_vec(),
        });
    }

    /// Puts a state into its queue, which drops its oldest when full.
    pub fn receive_state(&mut self, state: &State) {
        if self.states.len() == self.state_queue {
            self.states.pop_front();
        }
        self.states.push_back(Seen { tick: state.tick, removed_total: state.removed_total });
    }

    /// Puts a request into its sender's queue, which drops its oldest when full.
    pub fn receive_request(&mut self, asked: SentRequest) {
        let mut of_sender = self.requests.iter().enumerate().filter(|(_, other)| other.from == asked.from);
        let oldest = of_sender.next().map(|(index, _)| index);
        if oldest.is_some() && 1 + of_sender.count() >= DRR_REQUEST.queue_length {
            oldest.and_then(|index| self.requests.remove(index));
        }
        self.requests.push_back(asked);
    }

    /// Returns whether the process is blocked by the renderer's queue.
    pub fn is_blocked(&self) -> bool {
        self.jobs.len() > JOBS_WAITING + 1
    }

    /// Processes all its queues.
    ///
    /// # Errors
    /// If removed voxels are missing, which ends the process.
    pub fn look(&mut self, now_ns: u64, account: &mut FrameAccount) -> Result<QueuePass, RemovalLoss> {
        self.publish_finished(now_ns, account);
        loop {
            if let Some(blocked) = self.take_requests(now_ns, account) {
                return Ok(blocked);
            }
            for _ in 0..STATES_PER_ROUND {
                let Some(state) = self.states.pop_front() else { return Ok(QueuePass::Done) };
                self.removed.drain(..).for_each(|batch| self.removals.receive(batch));
                self.removals.advance(Tick(state.tick), state.removed_total)?;
                self.newest = Some(state);
                if let Some(blocked) = self.serve_newest(now_ns, account) {
                    return Ok(blocked);
                }
            }
        }
    }

    /// Takes the requests that have arrived, after the remaining work of the newest state, and serves those
    /// that are due.
    pub fn take_requests(&mut self, now_ns: u64, account: &mut FrameAccount) -> Option<QueuePass> {
        self.publish_finished(now_ns, account);
        if self.is_blocked() {
            return self.blocked();
        }
        if std::mem::take(&mut self.stood_still)
            && let Some(blocked) = self.serve_newest(now_ns, account)
        {
            return Some(blocked);
        }
        self.answer_requests(now_ns, account);
        self.serve_newest(now_ns, account)
    }

    fn answer_requests(&mut self, now_ns: u64, account: &mut FrameAccount) {
        for _ in 0..LOOKED_AT {
            let Some(asked) = self.requests.pop_front() else { break };
            let SentRequest { from, sender, request } = asked;
            let answer = match self.rate_limit.allows(from, now_ns) {
                false => Answer::PassedOver,
                true => Answer::Given(self.schedule.request(from, sender, request, geometry_of(&request))),
            };
            account.request(&asked, &answer, now_ns);
        }
    }

    /// Starts what is due at the newest state.
    fn serve_newest(&mut self, now_ns: u64, account: &mut FrameAccount) -> Option<QueuePass> {
        let tick = self.newest?.tick;
        while let Some(due) = self.schedule.due(Tick(tick), self.renderer()) {
            self.start(tick, FrameCause::Due(due), now_ns, account);
            if self.is_blocked() {
                self.stood_still = true;
                return self.blocked();
            }
        }
        account.served(tick);
        None
    }

    fn blocked(&self) -> Option<QueuePass> {
        self.jobs.front().map(|job| QueuePass::Blocked { until_ns: job.finished_ns })
    }

    /// Renders everything due at the last state and all waiting requests that it can answer, and refuses the
    /// others; the requests `late` arrive meanwhile.
    pub fn finish(&mut self, now_ns: u64, late: Vec<SentRequest>, account: &mut FrameAccount) {
        if let Some(Seen { tick, .. }) = self.newest {
            while let Some(due) = self.schedule.last(Tick(tick)) {
                self.start(tick, FrameCause::Last(due), now_ns, account);
            }
        }
        self.end(account);
        late.into_iter().for_each(|asked| self.receive_request(asked));
        self.answer_requests(now_ns, account);
        self.publish_finished(u64::MAX, account);
    }

    /// Ends the process: it refuses the waiting requests.
    pub fn end(&mut self, account: &mut FrameAccount) {
        let last_tick = self.newest.map_or(Tick::START, |newest| Tick(newest.tick));
        let refused = self.schedule.end(last_tick);
        account.refused_at_end(&refused, last_tick);
    }

    /// Returns the frames published since the last call.
    pub fn take_published(&mut self) -> Vec<FrameMark> {
        std::mem::take(&mut self.published)
    }

    fn renderer(&self) -> Renderer {
        if self.jobs.is_empty() { Renderer::Idle } else { Renderer::Busy }
    }

    fn start(&mut self, tick: u64, cause: FrameCause, now_ns: u64, account: &mut FrameAccount) {
        account.frame(tick, cause, &self.removals.take());
        let begins_ns = self.jobs.back().map_or(now_ns, |last| now_ns.max(last.finished_ns));
        self.sequence += 1;
        let request_id = match cause {
            FrameCause::Due(DueFrame::Requested(request))
            | FrameCause::Last(DueFrame::Requested(request)) => request.request_id,
            FrameCause::Due(DueFrame::Scheduled) | FrameCause::Last(DueFrame::Scheduled) => 0,
        };
        self.jobs.push_back(Job {
            finished_ns: begins_ns + self.random.u64(self.render_ns / 4..=self.render_ns),
            mark: FrameMark { sequence: self.sequence, tick: Tick(tick), request_id },
        });
    }

    fn publish_finished(&mut self, now_ns: u64, account: &mut FrameAccount) {
        let finished = self.jobs.iter().take_while(|job| job.finished_ns <= now_ns).count();
        for job in self.jobs.drain(..finished) {
            self.published.push(job.mark);
            account.finished();
        }
    }
}

/// Checks whether a request's C-arm is valid.
fn geometry_of(request: &DrrRequest) -> Result<(), String> {
    let is_bad = request.use_geometry() == Ok(GeometryChoice::Request) && request.geometry.columns == 0;
    if is_bad { Err("columns is 0".to_owned()) } else { Ok(()) }
}
