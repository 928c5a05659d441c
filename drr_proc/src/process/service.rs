//! The loop of the DRR process: messages in, jobs to the renderer, frames out.

use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, TrySendError, sync_channel};
use std::time::{Duration, Instant};

use hub::rate_limit::{Connection, LOOKED_AT, RateLimit, WarningLimit};
use hub::x_ray::{Due, Removals, RemovedBatch, RemovedSince, Renderer, Schedule, ScheduleSettings};
use ipc_types::clock::now_ns;
use ipc_types::messages::{
    DRR_ACCEPTED, DrrReply, DrrRequest, EVENT_REQUEST_REFUSED, FrameTiming, GEOMETRY_REQUEST, PHASE_ENDED,
    SEVERITY_WARNING, State,
};
use ipc_types::ports::PortError;
use ipc_types::process::EndRequest;
use ipc_types::scene::{Mode, Notch, Scene, ToolRadii};
use xray::frame::{Job, Rendered, render_job};
use xray::from_scene::scene_isocentre_m;
use xray::message::{c_arm_message, c_arm_of};
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
/// Maximum number of states between progress reports.
const PROGRESS_TICKS: u64 = 32;

/// A finished frame, and how long it took to render (wall time).
struct Finished {
    rendered: Rendered,
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
    end: &EndRequest,
) -> Result<(), DrrProcessError> {
    let (jobs, job_queue) = sync_channel::<Job>(QUEUE);
    let (outcomes, outcome_queue) = sync_channel::<Outcome>(QUEUE + 2);
    std::thread::scope(|scope| {
        scope.spawn(move || {
            for job in job_queue {
                let began_ns = now_ns();
                let outcome = render_job(&mut renderer, view, &job)
                    .map(|rendered| Finished { rendered, render_ns: now_ns() - began_ns });
                // The main thread has ended, so end this one too.
                if outcomes.send(outcome).is_err() {
                    break;
                }
            }
        });
        Service::new(scene, ports, *c_arm, jobs, outcome_queue).run(end)
    })
}

struct Service {
    ports: Ports,
    schedule: Schedule,
    mode: Mode,
    c_arm: CArm,
    isocentre_m: [f64; 3],
    notch: Option<Notch>,
    noise_seed: u64,
    radii: ToolRadii,
    jobs: SyncSender<Job>,
    outcomes: Receiver<Outcome>,
    in_flight: usize,
    sequence: u64,
    rate_limit: RateLimit,
    warnings: WarningLimit,
    removals: Removals,
    newest: Option<Box<State>>,
    reported_tick: u64,
}

impl Service {
    fn new(
        scene: &Scene,
        ports: Ports,
        c_arm: CArm,
        jobs: SyncSender<Job>,
        outcomes: Receiver<Outcome>,
    ) -> Service {
        Service {
            ports,
            schedule: Schedule::new(ScheduleSettings::of(scene)),
            mode: scene.run.mode,
            c_arm,
            isocentre_m: scene_isocentre_m(scene),
            notch: scene.drr.as_ref().and_then(|drr| drr.notch),
            noise_seed: scene.run.seed,
            radii: scene.manipulator.radii(),
            jobs,
            outcomes,
            in_flight: 0,
            sequence: 0,
            rate_limit: RateLimit::default(),
            warnings: WarningLimit::default(),
            removals: Removals::default(),
            newest: None,
            reported_tick: 0,
        }
    }

    fn run(mut self, end: &EndRequest) -> Result<(), DrrProcessError> {
        self.ports.report_progress(0)?;
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
            if let Some(status) = self.ports.status.receive_newest()?
                && status.message().phase == PHASE_ENDED
            {
                last_tick = Some(status.message().tick);
            }
            if let (Some(last), Some(newest)) = (last_tick, &self.newest)
                && newest.tick >= last
            {
                return self.finish();
            }
        }
        Ok(())
    }

    /// Renders the last state, and waits for all frames.
    fn finish(mut self) -> Result<(), DrrProcessError> {
        if let Some(state) = self.newest.take()
            && let Some(due) = self.schedule.last(state.tick)
        {
            self.start(&state, due)?;
        }
        while self.in_flight > 0 {
            self.publish_finished()?;
            std::thread::sleep(Duration::from_millis(1));
        }
        Ok(())
    }

    fn take_states(&mut self) -> Result<(), DrrProcessError> {
        // In lockstep the physics runs as fast as states are read, so poll requests in between.
        for _ in 0..STATES_PER_ROUND {
            let Some(received) = self.ports.states.receive()? else { break };
            let state = Box::new(*received.message());
            drop(received);
            self.take_removals(&state)?;
            self.start_due(&state)?;
            if state.tick >= self.reported_tick + PROGRESS_TICKS {
                self.reported_tick = state.tick;
                self.ports.report_progress(state.tick)?;
            }
            self.newest = Some(state);
            self.publish_finished()?;
        }
        let newest = self.newest.as_ref().map_or(0, |state| state.tick);
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
                tick: message.tick,
                sequence: message.sequence,
                total: message.removed_total,
                restore_first: message.restore_first != 0,
                voxels,
            });
        }
        Ok(self.removals.advance(state.tick, state.removed_total)?)
    }

    /// Reads pending requests. They are rate-limited per program, so that a flooding program cannot delay frames.
    fn take_requests(&mut self) -> Result<(), DrrProcessError> {
        let mut refused = Vec::new();
        for _ in 0..LOOKED_AT {
            let malformed = |error: &PortError| refused.push(format!("{error}; refused"));
            let Some(request) = self.ports.requests.receive_valid(malformed)? else { break };
            let from = Connection(request.sender().number());
            if !self.rate_limit.allows(from, now_ns()) {
                refused.push("a program asks for more frames than can be answered; refused".to_owned());
                continue;
            }
            let sender = self.ports.requesters.controller_of(&request).map_or(u32::MAX, |index| index as u32);
            let request = *request.message();
            let geometry = self.geometry_of(&request).map(drop).map_err(|cause| cause.to_string());
            if let Err(refusal) = self.schedule.request(from, sender, request, geometry) {
                self.reply(&request, 0, request.tick, refusal.status(), &self.c_arm)?;
                refused.push(format!("request {} for a frame: {refusal}; refused", request.request_id));
            }
        }
        for text in refused {
            if self.warnings.allows(now_ns()) {
                self.warn(&text)?;
            }
        }
        match self.warnings.take_suppressed(now_ns()) {
            None => Ok(()),
            Some(more) => self.warn(&format!("{more} more requests for frames refused")),
        }
    }

    fn warn(&mut self, text: &str) -> Result<(), DrrProcessError> {
        let tick = self.newest.as_ref().map_or(0, |state| state.tick);
        Ok(self.ports.events.send(tick, SEVERITY_WARNING, EVENT_REQUEST_REFUSED, text)?)
    }

    fn renderer(&self) -> Renderer {
        if self.in_flight == 0 { Renderer::Idle } else { Renderer::Busy }
    }

    /// Serves requests that arrived after the state that they ask for: in lockstep no further state may arrive before
    /// they are answered.
    fn serve_newest(&mut self) -> Result<(), DrrProcessError> {
        let Some(state) = self.newest.take() else { return Ok(()) };
        self.start_due(&state)?;
        self.newest = Some(state);
        Ok(())
    }

    /// Starts every frame that is due at this state.
    fn start_due(&mut self, state: &State) -> Result<(), DrrProcessError> {
        while let Some(due) = self.schedule.due(state.tick, self.renderer()) {
            self.start(state, due)?;
        }
        Ok(())
    }

    fn geometry_of(&self, request: &DrrRequest) -> Result<CArm, DrrError> {
        if request.use_geometry != GEOMETRY_REQUEST {
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

    fn reply(
        &self,
        request: &DrrRequest,
        sequence: u64,
        tick: u64,
        status: u32,
        c_arm: &CArm,
    ) -> Result<(), DrrProcessError> {
        let geometry = c_arm_message(c_arm);
        let DrrRequest { request_id, requester, .. } = *request;
        Ok(self.ports.replies.send(&DrrReply {
            request_id,
            frame_sequence: sequence,
            tick,
            status,
            requester,
            geometry,
        })?)
    }

    /// Announces a frame of this state and queues it for the renderer.
    fn start(&mut self, state: &State, due: Due) -> Result<(), DrrProcessError> {
        let (request, c_arm) = match due {
            Due::Scheduled => (DrrRequest::zeroed(), self.c_arm),
            Due::Requested(request) => (request, self.geometry_of(&request)?),
        };
        self.sequence += 1;
        self.reply(&request, self.sequence, state.tick, DRR_ACCEPTED, &c_arm)?;
        let RemovedSince { restore_first, voxels } = self.removals.take();
        let mut job = Job {
            state: Box::new(*state),
            restore_first,
            removed: voxels,
            sequence: self.sequence,
            request_id: request.request_id,
            c_arm,
            // Without a frame rate every frame is a requested one, and the C-arm often stays the same.
            aside: self.schedule.is_periodic() && c_arm != self.c_arm,
            isocentre_m: self.isocentre_m,
            notch: self.notch,
            noise_seed: self.noise_seed,
            radii: self.radii,
        };
        self.in_flight += 1;
        loop {
            match self.jobs.try_send(job) {
                Ok(()) => return Ok(()),
                Err(TrySendError::Disconnected(_)) => return Err(DrrProcessError::WorkerGone),
                Err(TrySendError::Full(back)) => {
                    debug_assert!(
                        self.mode == Mode::Lockstep,
                        "in real time only a free renderer is given a job"
                    );
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
            let newest = self.newest.as_ref().map_or(0, |state| state.tick);
            self.ports.timing.send(&FrameTiming {
                frame_sequence: rendered.frame.sequence,
                tick: rendered.frame.tick,
                render_ns,
                rays: rendered.report.rays_traced as u64,
                age_ticks: newest.saturating_sub(rendered.frame.tick),
                full: u32::from(rendered.is_full()),
                reserved: 0,
            })?;
        }
    }
}
