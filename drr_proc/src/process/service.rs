//! The loop of the DRR process: messages in, jobs to the renderer, frames out.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, TrySendError, sync_channel};
use std::time::{Duration, Instant};

use delivery::x_ray::{
    DueFrame, Refusal, RemovalDelta, Removals, RemovedBatch, Renderer, Schedule, ScheduleSettings,
};
use hub::rate_limit::{Connection, LOOKED_AT, RateLimit, WarningLimit};
use ipc_types::clock::now_ns;
use ipc_types::messages::services::DRR_REQUEST;
use ipc_types::messages::{
    DrrReply, DrrRequest, DrrStatus, EventCode, FrameTiming, GeometryChoice, Phase, State, Tick,
};
use ipc_types::ports::PortError;
use ipc_types::process::EndRequest;
use ipc_types::scene::{Holder, Notch, Scene, ToolRadii};
use xray::frame::{Cache, Job, RenderedFrame, render_job};
use xray::from_scene::scene_isocentre_m;
use xray::message::{c_arm_message, c_arm_of};
use xray::surroundings::Surroundings;
use xray::{CArm, DrrError, DrrRenderer, VolumeView};
use zerocopy::FromBytes;

use super::DrrProcessError;
use super::ports::Ports;

/// Maximum number of jobs that wait for the renderer.
const QUEUE: usize = 2;
/// Longest wait for a message before the ports are polled again.
const POLL_PERIOD: Duration = Duration::from_millis(2);
/// Number of states to read before requests are polled again.
const STATES_PER_ROUND: usize = 32;
/// Number of passes that take all requests that the queues of all programs can hold.
const ROUNDS_OF_REQUESTS: usize = (DRR_REQUEST.max_publishers * DRR_REQUEST.queue_length).div_ceil(LOOKED_AT);
/// Maximum number of states between progress reports.
const PROGRESS_TICKS: u64 = 32;

/// A finished frame with its rendering time (wall time).
struct Finished {
    rendered: RenderedFrame,
    render_ns: u64,
}

type Outcome = Result<Finished, DrrError>;

/// Serves frames until the run ends.
pub(super) fn serve(
    scene: &Scene,
    ports: Ports,
    view: &VolumeView<'_>,
    mut renderer: DrrRenderer,
    c_arm: &CArm,
    around: Arc<Surroundings>,
    end: &EndRequest,
) -> Result<(), DrrProcessError> {
    let (jobs, job_queue) = sync_channel::<Job>(QUEUE);
    let (outcomes, outcome_queue) = sync_channel::<Outcome>(QUEUE + 2);
    std::thread::scope(|scope| {
        let render = move || {
            for job in job_queue {
                let began_ns = now_ns();
                let outcome = render_job(&mut renderer, view, &job)
                    .map(|rendered| Finished { rendered, render_ns: now_ns() - began_ns });
                // The main thread has ended, so this one ends too.
                if outcomes.send(outcome).is_err() {
                    break;
                }
            }
        };
        let thread = std::thread::Builder::new().name("render".to_owned());
        thread.spawn_scoped(scope, render).map_err(DrrProcessError::Worker)?;
        Service::new(scene, ports, *c_arm, around, jobs, outcome_queue).run(end)
    })
}

struct Service {
    ports: Ports,
    schedule: Schedule,
    c_arm: CArm,
    isocentre_m: [f64; 3],
    notch: Option<Notch>,
    noise_seed: u64,
    radii: ToolRadii,
    holder: Holder,
    around: Arc<Surroundings>,
    jobs: SyncSender<Job>,
    outcomes: Receiver<Outcome>,
    in_flight: usize,
    sequence: u64,
    rate_limit: RateLimit,
    warnings: WarningLimit,
    removals: Removals,
    newest: Option<Box<State>>,
    reported_tick: Tick,
}

/// Contents of a reply besides the request and the C-arm.
struct ReplyFacts {
    /// Number of the frame that follows; 0 if none does.
    frame_sequence: u64,
    tick: Tick,
    status: DrrStatus,
}

impl Service {
    fn new(
        scene: &Scene,
        ports: Ports,
        c_arm: CArm,
        around: Arc<Surroundings>,
        jobs: SyncSender<Job>,
        outcomes: Receiver<Outcome>,
    ) -> Service {
        Service {
            ports,
            schedule: Schedule::new(ScheduleSettings::of(scene)),
            c_arm,
            isocentre_m: scene_isocentre_m(scene),
            notch: scene.drr.as_ref().and_then(|drr| drr.notch),
            noise_seed: scene.run.seed,
            radii: scene.manipulator.radii(),
            holder: scene.arm.holder(),
            around,
            jobs,
            outcomes,
            in_flight: 0,
            sequence: 0,
            rate_limit: RateLimit::default(),
            warnings: WarningLimit::default(),
            removals: Removals::default(),
            newest: None,
            reported_tick: Tick::START,
        }
    }

    fn run(mut self, end: &EndRequest) -> Result<(), DrrProcessError> {
        self.ports.report_progress(Tick::START)?;
        let mut last_tick = None;
        while !end.is_set() {
            let ports = &self.ports;
            let arrived = || ports.states.has_message() || ports.requests.has_message();
            ports.waiter.wait_until(Instant::now() + POLL_PERIOD, arrived);
            self.take_requests()?;
            self.serve_newest()?;
            self.take_states()?;
            self.publish_finished()?;
            // A physics process that joins later must learn about this one.
            self.ports.progress.deliver_history()?;
            // In lockstep a controller that has reconnected waits for a published frame, and no other can
            // follow before it answers.
            self.ports.frames.deliver_history()?;
            if let Some(status) = self.ports.status.receive_newest()?
                && status.message().phase() == Ok(Phase::Ended)
            {
                last_tick = Some(Tick(status.message().tick));
            }
            if let (Some(last), Some(newest)) = (last_tick, &self.newest)
                && Tick(newest.tick) >= last
            {
                return self.finish();
            }
        }
        self.refuse_waiting()
    }

    /// Renders the last state and the frames requested of it, refuses all other requests, and waits for all
    /// frames.
    fn finish(mut self) -> Result<(), DrrProcessError> {
        (0..ROUNDS_OF_REQUESTS).try_for_each(|_| self.take_requests())?;
        if let Some(state) = self.newest.take() {
            // Announced before the first is rendered, so that requesters know that their frame follows.
            let mut jobs = Vec::new();
            while let Some(due) = self.schedule.last(Tick(state.tick)) {
                jobs.push(self.announce(&state, due)?);
            }
            self.newest = Some(state);
            self.refuse_waiting()?;
            jobs.into_iter().try_for_each(|job| self.queue(job))?;
        }
        while self.in_flight > 0 {
            self.take_requests()?;
            self.publish_finished()?;
            std::thread::sleep(Duration::from_millis(1));
        }
        Ok(())
    }

    /// Refuses the requests that can no longer get a frame, because the run is over.
    fn refuse_waiting(&mut self) -> Result<(), DrrProcessError> {
        for (request, refusal) in self.schedule.end(self.newest_tick()) {
            self.refuse(&request, &refusal)?;
        }
        (0..ROUNDS_OF_REQUESTS).try_for_each(|_| self.take_requests())
    }

    /// Answers a request with its refusal, and reports the reason.
    fn refuse(&mut self, request: &DrrRequest, refusal: &Refusal) -> Result<(), DrrProcessError> {
        let answer = ReplyFacts { frame_sequence: 0, tick: Tick(request.tick), status: refusal.status() };
        self.reply(request, answer, &self.c_arm)?;
        self.warn_within_limit(&format!("frame request {}: {refusal}; refused", request.request_id))
    }

    fn take_states(&mut self) -> Result<(), DrrProcessError> {
        // In lockstep the physics runs as fast as states are read, so poll requests in between.
        for _ in 0..STATES_PER_ROUND {
            let Some(received) = self.ports.states.receive()? else { break };
            let state = Box::new(*received.message());
            drop(received);
            self.take_removals(&state)?;
            self.start_due(&state)?;
            let tick = Tick(state.tick);
            if tick >= self.reported_tick.saturating_add(PROGRESS_TICKS) {
                self.reported_tick = tick;
                self.ports.report_progress(tick)?;
            }
            self.newest = Some(state);
            self.publish_finished()?;
        }
        let newest = self.newest_tick();
        if newest > self.reported_tick {
            self.reported_tick = newest;
            self.ports.report_progress(newest)?;
        }
        Ok(())
    }

    /// Reads the removals up to this state; all of them were published before it.
    fn take_removals(&mut self, state: &State) -> Result<(), DrrProcessError> {
        while let Some(removed) = self.ports.removed.receive()? {
            let voxels =
                removed.tail().chunks_exact(4).filter_map(|bytes| u32::read_from_bytes(bytes).ok()).collect();
            let message = removed.message();
            self.removals.receive(RemovedBatch {
                tick: Tick(message.tick),
                sequence: message.sequence,
                total: message.removed_total,
                restores: message.restores(),
                voxels,
            });
        }
        Ok(self.removals.advance(Tick(state.tick), state.removed_total)?)
    }

    /// Reads pending requests. They are rate-limited per program, so that a flooding program cannot delay
    /// frames.
    fn take_requests(&mut self) -> Result<(), DrrProcessError> {
        let mut refused = Vec::new();
        for _ in 0..LOOKED_AT {
            let malformed = |error: &PortError| refused.push(format!("{error}; refused"));
            let Some(request) = self.ports.requests.receive_valid(malformed)? else { break };
            let from = Connection(request.sender().number());
            if !self.rate_limit.allows(from, now_ns()) {
                refused.push("a program requests frames faster than the rate limit; refused".to_owned());
                continue;
            }
            let sender = self.ports.requesters.controller_of(&request);
            let request = *request.message();
            let geometry = self.geometry_of(&request).map(drop).map_err(|cause| cause.to_string());
            if let Err(refusal) = self.schedule.request(from, sender, request, geometry) {
                self.refuse(&request, &refusal)?;
            }
        }
        refused.iter().try_for_each(|text| self.warn_within_limit(text))?;
        match self.warnings.take_suppressed(now_ns) {
            None => Ok(()),
            Some(more) => self.warn(&format!("{more} more frame requests refused")),
        }
    }

    fn warn_within_limit(&mut self, text: &str) -> Result<(), DrrProcessError> {
        if self.warnings.allows(now_ns()) { self.warn(text) } else { Ok(()) }
    }

    fn warn(&mut self, text: &str) -> Result<(), DrrProcessError> {
        Ok(self.ports.events.warn(self.newest_tick(), EventCode::RequestRefused, text)?)
    }

    fn newest_tick(&self) -> Tick {
        self.newest.as_ref().map_or(Tick::START, |state| Tick(state.tick))
    }

    fn renderer(&self) -> Renderer {
        if self.in_flight == 0 { Renderer::Idle } else { Renderer::Busy }
    }

    /// Serves requests that arrived after the state that they refer to: in lockstep no further state may
    /// arrive before they are answered.
    fn serve_newest(&mut self) -> Result<(), DrrProcessError> {
        let Some(state) = self.newest.take() else { return Ok(()) };
        self.start_due(&state)?;
        self.newest = Some(state);
        Ok(())
    }

    /// Starts every frame that is due at this state.
    fn start_due(&mut self, state: &State) -> Result<(), DrrProcessError> {
        while let Some(due) = self.schedule.due(Tick(state.tick), self.renderer()) {
            self.start(state, due)?;
        }
        Ok(())
    }

    fn geometry_of(&self, request: &DrrRequest) -> Result<CArm, DrrError> {
        if request.use_geometry() != Ok(GeometryChoice::Request) {
            return Ok(self.c_arm);
        }
        let c_arm = c_arm_of(&request.geometry)?;
        // A frame's shared memory has the size of the scene's detector.
        if (c_arm.columns, c_arm.rows) == (self.c_arm.columns, self.c_arm.rows) {
            return Ok(c_arm);
        }
        let value = f64::from(c_arm.columns) * f64::from(c_arm.rows);
        Err(DrrError::OutOfRange {
            field: "columns x rows",
            given: value,
            expected: "those of the scene's detector",
        })
    }

    fn reply(&self, request: &DrrRequest, answer: ReplyFacts, c_arm: &CArm) -> Result<(), DrrProcessError> {
        let geometry = c_arm_message(c_arm);
        let DrrRequest { request_id, requester, .. } = *request;
        Ok(self.ports.replies.send(&DrrReply {
            request_id,
            frame_sequence: answer.frame_sequence,
            tick: answer.tick.0,
            status: answer.status.code(),
            requester,
            geometry,
        })?)
    }

    /// Announces a frame of this state and queues it for the renderer.
    fn start(&mut self, state: &State, due: DueFrame) -> Result<(), DrrProcessError> {
        let job = self.announce(state, due)?;
        self.queue(job)
    }

    /// Announces a frame of this state; the caller must queue it.
    fn announce(&mut self, state: &State, due: DueFrame) -> Result<Job, DrrProcessError> {
        let (request, c_arm) = match due {
            DueFrame::Scheduled => (DrrRequest::zeroed(), self.c_arm),
            DueFrame::Requested(request) => (request, self.geometry_of(&request)?),
        };
        self.sequence += 1;
        let (frame_sequence, tick) = (self.sequence, Tick(state.tick));
        let answer = ReplyFacts { frame_sequence, tick, status: DrrStatus::Accepted };
        self.reply(&request, answer, &c_arm)?;
        let RemovalDelta { restores, voxels } = self.removals.take();
        Ok(Job {
            state: Box::new(*state),
            restores,
            removed: voxels,
            sequence: self.sequence,
            request_id: request.request_id,
            c_arm,
            // Without a frame rate every frame is a requested one, and the C-arm often stays the same.
            cache: match self.schedule.is_periodic() && c_arm != self.c_arm {
                true => Cache::Kept,
                false => Cache::Follows,
            },
            isocentre_m: self.isocentre_m,
            notch: self.notch,
            noise_seed: self.noise_seed,
            radii: self.radii,
            holder: self.holder,
            around: Arc::clone(&self.around),
        })
    }

    /// Queues a frame for the renderer; in lockstep and at the end it waits for room.
    fn queue(&mut self, mut job: Job) -> Result<(), DrrProcessError> {
        self.in_flight += 1;
        loop {
            match self.jobs.try_send(job) {
                Ok(()) => return Ok(()),
                Err(TrySendError::Disconnected(_)) => return Err(DrrProcessError::WorkerGone),
                Err(TrySendError::Full(back)) => {
                    job = back;
                    self.publish_finished()?;
                    std::thread::sleep(Duration::from_millis(1));
                }
            }
        }
    }

    fn publish_finished(&mut self) -> Result<(), DrrProcessError> {
        loop {
            let Finished { rendered, render_ns } = match self.outcomes.try_recv() {
                Ok(outcome) => outcome?,
                Err(TryRecvError::Empty) => return Ok(()),
                Err(TryRecvError::Disconnected) if self.in_flight == 0 => return Ok(()),
                Err(TryRecvError::Disconnected) => return Err(DrrProcessError::WorkerGone),
            };
            self.in_flight -= 1;
            self.ports.frames.send_parts(&rendered.parts())?;
            let newest = self.newest_tick();
            self.ports.timing.send(&FrameTiming {
                frame_sequence: rendered.frame.sequence,
                tick: rendered.frame.tick,
                render_ns,
                rays: rendered.report.rays_traced as u64,
                age_ticks: newest.since(Tick(rendered.frame.tick)),
                full: u32::from(rendered.is_full()),
                reserved: 0,
            })?;
        }
    }
}
