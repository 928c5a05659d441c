//! The loop.

mod waiting;

use std::time::{Duration, Instant};

use ipc_types::identity::Sender;
use ipc_types::messages::{
    CONTROL_DONE, CONTROL_PAUSE, CONTROL_REFUSED, CONTROL_RESET, CONTROL_RESUME, CONTROL_STEP, CONTROL_STOP,
    EVENT_COMMAND_HELD, EVENT_COMMAND_REFUSED, EVENT_MESSAGES_LOST, EVENT_REQUEST_REFUSED, EVENT_RUN,
    EVENT_SAFE_COMMAND, Latched, MAX_CONTROLLERS, PHASE_CONNECTING, PHASE_PAUSED, PHASE_RUNNING, RunControl,
    RunControlReply, RunStatus, SEVERITY_INFO, SEVERITY_WARNING, SOURCE_FRESH, SOURCE_HELD, SOURCE_SAFE,
    TickTiming,
};
use ipc_types::ports::PortError;
use ipc_types::process::{EndRequest, Role, prioritise};
use ipc_types::ration::{LOOKED_AT, Ration, Remarks};
use ipc_types::scene::{Mode, Policy, Scene};
use ipc_types::services::COMMAND;

use super::PhysicsError;
use super::clock::{Sleeper, elapsed_ns, now_ns, wake_exactly};
use super::disturbance::Disturbances;
use super::late_notes::LateNotes;
use super::lead::recorder_lead_ticks;
use super::pacing::{Schedule, Start};
use super::ports::Ports;
use crate::latch::Latch;
use crate::simulation::Simulation;

/// In lockstep the physics runs no further ahead of a consumer than this; half of the state's queue.
const LEAD_TICKS: u64 = 256;
const STATUS_PERIOD: Duration = Duration::from_millis(100);
const PAUSE_LOOK: Duration = Duration::from_millis(20);

pub(super) struct Runner<'v> {
    simulation: Simulation<'v>,
    ports: Ports,
    end: EndRequest,
    latch: Latch,
    mode: Mode,
    policy: Policy,
    period_ns: u64,
    tick_count: u64,
    /// How far in front of the recorder the physics may run in real time; none: as far as it gets.
    recorder_lead_ticks: Option<u64>,
    controller_limit: Duration,
    tick: u64,
    /// Whether the initial state has been published.
    shown: bool,
    connected: bool,
    published: Instant,
    paused: bool,
    steps_left: u64,
    reset_asked: bool,
    stopped: bool,
    refused_commands: u64,
    missed_ticks: u64,
    control_ration: Ration,
    control_remarks: Remarks,
    status_sent: Option<Instant>,
    sleeper: Sleeper,
    disturbances: Disturbances,
    /// Facts of the tick that comes or is being made.
    timing: TickTiming,
    sources: [u32; MAX_CONTROLLERS],
    /// Of commands that begin to be held, and of safe commands.
    late_notes: [[LateNotes; 2]; MAX_CONTROLLERS],
}

impl<'v> Runner<'v> {
    pub(super) fn new(
        scene: &Scene,
        simulation: Simulation<'v>,
        ports: Ports,
        end: EndRequest,
    ) -> Runner<'v> {
        Runner {
            simulation,
            ports,
            end,
            latch: Latch::new(scene),
            mode: scene.run.mode,
            policy: scene.run.policy,
            period_ns: scene.dt_ns(),
            tick_count: scene.tick_count(),
            recorder_lead_ticks: recorder_lead_ticks(scene),
            controller_limit: Duration::from_micros((scene.run.controller_limit_ms * 1e3) as u64),
            tick: 0,
            shown: false,
            connected: false,
            published: Instant::now(),
            paused: false,
            steps_left: 0,
            reset_asked: false,
            stopped: false,
            refused_commands: 0,
            missed_ticks: 0,
            control_ration: Ration::default(),
            control_remarks: Remarks::default(),
            status_sent: None,
            sleeper: Sleeper::new(scene.run.wait),
            disturbances: Disturbances::new(),
            timing: TickTiming::zeroed(),
            sources: [0; MAX_CONTROLLERS],
            late_notes: Default::default(),
        }
    }

    pub(super) fn run(mut self) -> Result<(), PhysicsError> {
        self.connect()?;
        self.lock_memory()?;
        self.prioritise()?;
        let mut schedule = Schedule::new(self.period_ns, now_ns());
        while self.tick < self.tick_count && !self.ends() {
            self.obey()?;
            if self.rests() {
                self.rest()?;
                schedule.go_on(now_ns());
                continue;
            }
            let start = self.await_start(&mut schedule)?;
            if self.ends() {
                break;
            }
            if self.rests() {
                continue;
            }
            self.make_tick(start)?;
            self.steps_left = self.steps_left.saturating_sub(1);
            self.send_status(PHASE_RUNNING, false)?;
        }
        self.finish()
    }

    fn ends(&self) -> bool {
        self.stopped || self.end.is_set()
    }

    /// Paused, with no step left to make.
    fn rests(&self) -> bool {
        self.paused && self.steps_left == 0
    }

    /// Keeps all memory of this process resident, where the system permits it.
    fn lock_memory(&mut self) -> Result<(), PhysicsError> {
        let flags = rustix::mm::MlockAllFlags::CURRENT | rustix::mm::MlockAllFlags::FUTURE;
        if let Err(cause) = rustix::mm::mlockall(flags) {
            let text = format!("memory is not locked ({cause}): page faults may delay ticks");
            self.ports.events.inform(self.tick, EVENT_RUN, &text)?;
        }
        Ok(())
    }

    /// In real time the tick comes first; what the scheduler grants is said.
    fn prioritise(&mut self) -> Result<(), PhysicsError> {
        if self.mode == Mode::Lockstep {
            return Ok(());
        }
        wake_exactly();
        let (wanted, got) = (Role::Physics.priority(self.policy), prioritise(Role::Physics, self.policy));
        if got != wanted {
            let text = format!(
                "priority: {wanted:?} is not permitted, the physics has {got:?}: see `trabecula doctor`"
            );
            self.ports.events.inform(self.tick, EVENT_RUN, &text)?;
        }
        Ok(())
    }

    fn await_start(&mut self, schedule: &mut Schedule) -> Result<Start, PhysicsError> {
        match self.mode {
            Mode::Realtime => {
                self.disturbances.work_ends();
                self.await_recorder(schedule.deadline_ns())?;
                if self.ends() || self.rests() {
                    return Ok(Start { lateness_ns: 0, missed: false });
                }
                while now_ns() < schedule.deadline_ns() && !self.ends() {
                    self.sleeper.wait_until(schedule.deadline_ns());
                }
                let woken_ns = now_ns();
                self.collect_commands()?;
                let start_ns = now_ns();
                let start = schedule.begin(start_ns);
                self.missed_ticks = schedule.missed();
                self.timing.collect_ns = start_ns - woken_ns;
                self.disturbances.tick_begins(start_ns, start.lateness_ns, start.missed, &mut self.timing);
                Ok(start)
            }
            Mode::Lockstep => {
                self.await_consumers(self.tick.saturating_sub(LEAD_TICKS), |_| true)?;
                self.await_answers()?;
                self.disturbances.count(&mut self.timing);
                Ok(Start { lateness_ns: 0, missed: false })
            }
        }
    }

    /// Takes the commands that have arrived; what is invalid is refused, said, and changes nothing. A controller that
    /// floods is read no longer than its queue is, so that it cannot hold up the tick, and its refusals are said together.
    fn collect_commands(&mut self) -> Result<(), PortError> {
        for index in 0..self.ports.controllers.len() {
            for _ in 0..COMMAND.queue_length {
                let port = &mut self.ports.controllers[index];
                let refusal = match port.commands.receive() {
                    Ok(None) => break,
                    Ok(Some(command)) => {
                        let sender = Some(command.sender());
                        if sender != port.sender {
                            (port.sender, port.seen_sequence) = (sender, 0);
                            self.latch.connect(index);
                        }
                        // A copy: what is checked must be what is latched, whatever its writer does meanwhile.
                        let command = *command.message();
                        if command.state_tick == self.tick && port.round_trip_ns == 0 {
                            port.round_trip_ns = elapsed_ns(self.published).max(1);
                        }
                        let lost = overwritten(&mut port.seen_sequence, command.sequence);
                        port.lost = port.lost.saturating_add(lost);
                        let outcome = self.latch.offer(index, &command, self.tick);
                        outcome.err().map(|cause| format!("command {}: {cause}", command.sequence))
                    }
                    Err(PortError::Length { service, bytes, expected }) => {
                        Some(format!("a message of {bytes} bytes on `{service}`, expected {expected}"))
                    }
                    Err(other) => return Err(other),
                };
                if let Some(reason) = refusal {
                    self.refused_commands += 1;
                    if self.ports.controllers[index].remarks.allows() {
                        self.warn(index, EVENT_COMMAND_REFUSED, &format!("{reason}; refused"))?;
                    }
                }
            }
            let port = &mut self.ports.controllers[index];
            if let Some(more) = port.remarks.unsaid() {
                self.warn(index, EVENT_COMMAND_REFUSED, &format!("{more} more commands refused"))?;
            }
            let port = &mut self.ports.controllers[index];
            if port.lost > 0 && port.remarks.allows() {
                let lost = std::mem::take(&mut port.lost);
                let length = COMMAND.queue_length;
                let text =
                    format!("{lost} commands never came: a queue holds {length}, or numbers were left out");
                self.warn(index, EVENT_MESSAGES_LOST, &text)?;
            }
        }
        Ok(())
    }

    fn warn(&mut self, controller: usize, code: u32, text: &str) -> Result<(), PortError> {
        let text = format!("controller `{}`: {text}", self.ports.controllers[controller].name);
        self.ports.events.send(self.tick, SEVERITY_WARNING, code, &text)
    }

    fn make_tick(&mut self, start: Start) -> Result<(), PhysicsError> {
        let start_ns = now_ns();
        let began = Instant::now();
        let reset = std::mem::take(&mut self.reset_asked);
        let latched = self.latch.latch(self.tick, reset);
        self.ports.latched.send(&latched)?;
        let latch_ns = elapsed_ns(began);
        let step_began = Instant::now();
        self.simulation
            .step(&latched)
            .map_err(|cause| PhysicsError::Simulation { tick: self.tick, cause })?;
        let step_ns = elapsed_ns(step_began);
        let publish_began = Instant::now();
        self.tick += 1;
        self.publish_tick(reset)?;
        self.ports.publish_keyframe(&self.simulation)?;
        let publish_ns = elapsed_ns(publish_began);
        let mut timing = TickTiming {
            tick: latched.tick,
            start_ns,
            wake_lateness_ns: start.lateness_ns,
            latch_ns,
            step_ns,
            publish_ns,
            missed: u32::from(start.missed),
            late_controllers: late_controllers(&latched),
            ..self.timing
        };
        for (slot, port) in timing.round_trip_ns.iter_mut().zip(&mut self.ports.controllers) {
            *slot = std::mem::take(&mut port.round_trip_ns);
        }
        self.ports.timing.send(&timing)?;
        self.report_sources(&latched)?;
        self.report_refusals()
    }

    fn publish_tick(&mut self, reset: bool) -> Result<(), PortError> {
        let removed_total = self.simulation.state().removed_total;
        let removed = self.simulation.removed();
        if reset || !removed.is_empty() {
            self.ports.publish_removed(self.tick, removed, removed_total, reset)?;
        }
        self.publish_state()
    }

    fn publish_state(&mut self) -> Result<(), PortError> {
        self.ports.state.send(self.simulation.state())?;
        self.published = Instant::now();
        self.ports.controllers.iter().for_each(|port| port.waker.wake());
        Ok(())
    }

    /// Says when a controller's command begins to be held, or is replaced by the safe one; see [`LateNotes`].
    fn report_sources(&mut self, latched: &Latched) -> Result<(), PhysicsError> {
        for (index, port) in self.ports.controllers.iter().enumerate() {
            let (source, before) = (latched.commands[index].source, self.sources[index]);
            self.sources[index] = source;
            let [held, safe] = &mut self.late_notes[index];
            let (notes, severity, code, what) =
                if source == SOURCE_SAFE && before != SOURCE_SAFE && self.mode == Mode::Realtime {
                    let what = "late for longer than `run.hold_ticks`: burr off, arm stopped";
                    (safe, SEVERITY_WARNING, EVENT_SAFE_COMMAND, what)
                } else if source == SOURCE_HELD && before == SOURCE_FRESH {
                    (held, SEVERITY_INFO, EVENT_COMMAND_HELD, "late: its last command is held")
                } else {
                    continue;
                };
            if let Some(more) = notes.add(latched.tick, self.period_ns) {
                let text = format!("controller `{}` is {what}{more}", port.name);
                self.ports.events.send(latched.tick, severity, code, &text)?;
            }
        }
        Ok(())
    }

    fn report_refusals(&mut self) -> Result<(), PhysicsError> {
        for refusal in self.simulation.refusals() {
            self.refused_commands += u64::from(!refusal.stopped_later);
            let port = &mut self.ports.controllers[refusal.controller_index as usize];
            // A goal that cannot be reached may come at every tick.
            if !port.remarks.allows() {
                continue;
            }
            let (name, end) = (&port.name, if refusal.stopped_later { "" } else { "; refused" });
            let text = format!("controller `{name}`: command {}: {}{end}", refusal.sequence, refusal.reason);
            self.ports.events.send(self.tick, SEVERITY_WARNING, EVENT_COMMAND_REFUSED, &text)?;
        }
        Ok(())
    }

    fn phase(&self) -> u32 {
        match (self.connected, self.paused) {
            (false, _) => PHASE_CONNECTING,
            (true, true) => PHASE_PAUSED,
            (true, false) => PHASE_RUNNING,
        }
    }

    /// Does what run control asks for; of each program no more than its ration, so that who floods holds nobody up.
    fn obey(&mut self) -> Result<(), PortError> {
        let mut asked = false;
        for _ in 0..LOOKED_AT {
            let Some((request, sender)) = self.next_request()? else { break };
            if !self.control_ration.allows(sender) {
                if self.control_remarks.allows() {
                    self.refuse_control("a program sends more than can be answered")?;
                }
                continue;
            }
            asked = true;
            let status = if self.obey_one(&request) { CONTROL_DONE } else { CONTROL_REFUSED };
            let reply = RunControlReply {
                request_id: request.request_id,
                tick: self.tick,
                action: request.action,
                status,
            };
            self.ports.control_reply.send(&reply)?;
        }
        if let Some(more) = self.control_remarks.unsaid() {
            self.refuse_control(&format!("{more} more requests"))?;
        }
        if asked { self.send_status(self.phase(), true) } else { Ok(()) }
    }

    /// The next request to run control; a message of a wrong length is none.
    fn next_request(&mut self) -> Result<Option<(RunControl, Sender)>, PortError> {
        let mut malformed = Vec::new();
        let request = self.ports.control.receive_valid(|error| malformed.push(error.to_string()))?;
        for reason in malformed {
            if self.control_remarks.allows() {
                self.refuse_control(&reason)?;
            }
        }
        Ok(request.map(|request| (*request.message(), request.sender())))
    }

    fn refuse_control(&mut self, reason: &str) -> Result<(), PortError> {
        let text = format!("run control: {reason}; refused");
        self.ports.events.send(self.tick, SEVERITY_WARNING, EVENT_REQUEST_REFUSED, &text)
    }

    fn obey_one(&mut self, request: &RunControl) -> bool {
        match request.action {
            // Steps that are not made yet are given up: what was asked for last counts.
            CONTROL_PAUSE => (self.paused, self.steps_left) = (true, 0),
            CONTROL_RESUME => (self.paused, self.steps_left) = (false, 0),
            CONTROL_STEP if self.paused => self.steps_left = self.steps_left.saturating_add(request.ticks),
            CONTROL_RESET => self.reset_asked = true,
            CONTROL_STOP => self.stopped = true,
            _ => return false,
        }
        true
    }

    /// Paused: looks again after a while.
    fn rest(&mut self) -> Result<(), PhysicsError> {
        self.send_status(PHASE_PAUSED, false)?;
        self.ports.state.deliver_history()?;
        self.collect_commands()?;
        self.ports.waiter.wait_until(Instant::now() + PAUSE_LOOK, || self.ports.control.has_message());
        Ok(())
    }

    fn send_status(&mut self, phase: u32, now: bool) -> Result<(), PortError> {
        if !now && self.status_sent.is_some_and(|sent| sent.elapsed() < STATUS_PERIOD) {
            return Ok(());
        }
        self.status_sent = Some(Instant::now());
        self.disturbances.note_steal();
        let strangers = self.ports.consumers.new_strangers();
        if strangers > 0 && self.control_remarks.allows() {
            let text = format!(
                "progress: {strangers} messages of a program that is neither the DRR process nor the recorder; passed over"
            );
            self.ports.events.send(self.tick, SEVERITY_WARNING, EVENT_REQUEST_REFUSED, &text)?;
        }
        self.ports.status.send(&RunStatus {
            tick: self.tick,
            tick_count: self.tick_count,
            missed_ticks: self.missed_ticks,
            refused_commands: self.refused_commands,
            removed_messages: self.ports.removed_messages(),
            phase,
            mode: u32::from(self.mode == Mode::Realtime),
        })
    }
}

/// Bit i: controller i's command is not of this tick.
fn late_controllers(latched: &Latched) -> u32 {
    let count = (latched.controller_count as usize).min(MAX_CONTROLLERS);
    let late = latched.commands[..count].iter().enumerate();
    late.filter(|(_, command)| command.source != SOURCE_FRESH).fold(0, |bits, (index, _)| bits | 1 << index)
}

/// Commands between the newest one seen and this one: a client numbers its commands without a gap, so these were overwritten.
fn overwritten(seen: &mut u64, sequence: u64) -> u64 {
    let gap = sequence.saturating_sub(seen.saturating_add(1));
    *seen = sequence.max(*seen);
    gap
}
