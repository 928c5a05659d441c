//! Invariants of every schedule: a model of the run kept in parallel to the hub, using only what passes
//! between the hub and its surroundings.

use hub::rate_limit::Connection;
use hub::{IncomingMessage, Note, Report, Start};
use messages::{
    ControlAction, ControlStatus, ControllerIndex, EventCode, Keyframe, Latched, Part, Phase, Plant, Removed,
    RunControl, RunControlReply, RunStatus, SensorReading, Severity, State, TickTiming,
};
use scene::{Drives, Mode};

use crate::plan::{MS, SchedulePlan};
use crate::plant::{ChainPlant, INVALID_FROM, UNCUT, UNCUT_TICKS};
use controllers::Slot;

/// Requests of one connection that are answered within [`RATION_NS`]; further ones may be ignored.
const RATION: usize = 64;
const RATION_NS: u64 = 11 * MS;
/// Warnings of one kind in any tenth of a second: twice the limit, because two of its periods may adjoin.
const WARNINGS: usize = 34;
const PERIOD_NS: u64 = MS;

/// Records a violated rule; the text is created only then.
macro_rules! expect {
    ($oracle:ident, $holds:expr, $what:expr) => {
        if !$holds {
            let what: String = $what;
            $oracle.fail(what);
        }
    };
}

// After the macro, which they use.
mod controllers;
mod endings;
pub mod seen_frames;
pub mod viewer;
pub mod x_ray;

/// Model of the run.
#[derive(Debug, Default)]
pub struct Oracle {
    plan: SchedulePlan,
    drives: Vec<Vec<Drives>>,
    /// The first violated rule.
    pub failure: Option<String>,
    /// Steps with what is published, as a replay of the log would.
    shadow: ChainPlant,
    /// Tick of the newest state.
    pub tick: u64,
    shown: bool,
    /// u_k has been published, but x_{k+1} has not.
    latched: Option<bool>,
    removed_messages: u64,
    removed_in_tick: Option<usize>,
    readings_in_tick: usize,
    /// Events that report a reached capacity.
    capacity_notes: u32,
    /// Events that report an invalid model, those that were due, and whether none was sent since the start or
    /// a reset.
    invalid_notes: u64,
    invalid_due: u64,
    invalid_untold: bool,
    keyframe_parts: u64,
    keyframe_of_tick: bool,
    controllers: Vec<Slot>,
    taken: Vec<(Part, u64)>,
    /// Paused, with the remaining steps.
    pub paused: bool,
    steps_left: u64,
    reset_asked: bool,
    stopped: bool,
    /// Taken but not answered yet, with the time when it was taken.
    request: Option<(RunControl, Connection, u64)>,
    answered: Vec<(Connection, u64)>,
    refused: u64,
    plant_refused: bool,
    /// The plant cannot compute the tick whose commands were published last.
    plant_fails: bool,
    /// The reason that the hub stored for clients that see the end.
    blamed: Option<EventCode>,
    /// The last event that reports that the run ends.
    told: Option<EventCode>,
    missed: u64,
    deadline_ns: Option<u64>,
    state_ns: u64,
    began_ns: u64,
    end_ns: Option<u64>,
    ticks_after_end: u64,
    /// How long the hub was stopped since the request to end.
    stopped_ns: u64,
    /// Number of stops since the newest state, and their total length.
    stops: (u64, u64),
    ended: bool,
    warnings_ns: Vec<u64>,
}

/// The effect of the next tick on the plant.
#[derive(Debug, Clone, Copy)]
pub struct PlantPlan {
    /// It refuses part of the commands.
    pub refuses: bool,
    /// It cannot compute the tick.
    pub fails: bool,
}

impl Oracle {
    /// Creates the model of a plan whose controllers drive these parts.
    pub fn new(plan: &SchedulePlan, drives: &[Vec<Drives>], now_ns: u64) -> Oracle {
        Oracle {
            plan: plan.clone(),
            drives: drives.to_vec(),
            controllers: drives.iter().map(|_| Slot::default()).collect(),
            invalid_untold: true,
            state_ns: now_ns,
            began_ns: now_ns,
            ..Oracle::default()
        }
    }

    /// Records a violated rule; the first one counts.
    pub fn fail(&mut self, what: String) {
        self.failure.get_or_insert(what);
    }

    /// Records that the hub takes a request to run control.
    pub fn request(&mut self, incoming: &IncomingMessage<RunControl>, now_ns: u64) {
        self.passed_over();
        if let IncomingMessage::Message(request, connection) = incoming {
            self.request = Some((*request, *connection, now_ns));
        }
    }

    /// Handles a request that was not answered before anything else happened: it was beyond its sender's rate
    /// limit.
    pub fn passed_over(&mut self) {
        let Some((request, connection, asked_ns)) = self.request.take() else { return };
        let recent =
            |(other, at_ns): &&(Connection, u64)| *other == connection && at_ns + RATION_NS > asked_ns;
        let answered = self.answered.iter().filter(recent).count();
        expect!(self, answered >= RATION, {
            format!(
                "request {} was not answered, though its sender had only {answered} answers",
                request.request_id
            )
        });
    }

    /// Records that the hub answers a request.
    pub fn reply(&mut self, reply: &RunControlReply, now_ns: u64) {
        let Some((request, connection, _)) = self.request.take() else {
            return self.fail(format!("reply to {}, which was not requested", reply.request_id));
        };
        self.answered.push((connection, now_ns));
        let mut status = ControlStatus::Done;
        match request.action() {
            Ok(ControlAction::Pause) => (self.paused, self.steps_left) = (true, 0),
            Ok(ControlAction::Resume) => (self.paused, self.steps_left) = (false, 0),
            Ok(ControlAction::Step) if self.paused => self.steps_left += request.ticks,
            Ok(ControlAction::Reset) => self.reset_asked = true,
            Ok(ControlAction::Stop) => self.stopped = true,
            _ => status = ControlStatus::Refused,
        }
        let expected = RunControlReply {
            request_id: request.request_id,
            tick: self.tick,
            action: request.action,
            status: status.code(),
        };
        expect!(self, *reply == expected, format!("{reply:?}, expected {expected:?}"));
    }

    /// Records that the hub takes a report.
    pub fn report(&mut self, report: Report) {
        match self.taken.iter_mut().find(|(part, _)| *part == report.part) {
            Some((_, tick)) => *tick = report.tick.0,
            None => self.taken.push((report.part, report.tick.0)),
        }
    }

    fn taken(&self, part: Part) -> Option<u64> {
        self.taken.iter().find(|(other, _)| *other == part).map(|(_, tick)| *tick)
    }

    /// Records that the process is asked to end.
    pub fn end_requested(&mut self, now_ns: u64) {
        self.end_ns.get_or_insert(now_ns);
    }

    /// Records that the hub's process is stopped for a while.
    pub fn stopped(&mut self, for_ns: u64) {
        if for_ns == 0 {
            return;
        }
        if self.end_ns.is_some() {
            self.stopped_ns += for_ns;
        }
        self.stops.0 += 1;
        self.stops.1 += for_ns;
    }

    /// Returns whether the hub has waited for this long since the newest state. It may count up to half of
    /// the limit for each stop.
    fn has_waited(&self, limit_ns: u64, now_ns: u64) -> bool {
        let (count, stopped_ns) = self.stops;
        (now_ns - self.state_ns).saturating_sub(stopped_ns) + count * limit_ns / 2 >= limit_ns
    }

    /// Records that the hub publishes u_k.
    pub fn latch(&mut self, latched: &Latched, plant: PlantPlan, now_ns: u64) {
        self.passed_over();
        self.first_refusals_are_reported();
        expect!(
            self,
            self.shown && self.latched.is_none() && !self.ended,
            "u_k published out of order".to_owned()
        );
        let tick = latched.tick;
        expect!(self, tick == self.tick, format!("u_{tick} after x_{}", self.tick));
        expect!(self, tick < self.plan.tick_count, format!("tick {tick} beyond the run's end"));
        expect!(self, !self.stopped, format!("tick {tick} of a run that was stopped"));
        let rests = self.paused && self.steps_left == 0;
        expect!(self, !rests, format!("tick {tick} of a paused run"));
        self.steps_left = self.steps_left.saturating_sub(1);
        if self.paused {
            // The run may pause after this tick, and a pause ends with a new schedule.
            self.deadline_ns = None;
        }
        if self.end_ns.is_some() {
            self.ticks_after_end += 1;
            expect!(self, self.ticks_after_end <= 1, format!("tick {tick} after the request to end"));
        }
        let reset = std::mem::take(&mut self.reset_asked);
        expect!(self, latched.reset == u32::from(reset), format!("tick {tick}: reset is {}", latched.reset));
        self.check_lead(tick);
        for index in ControllerIndex::first(self.controllers.len()) {
            self.check_latched(index, latched, now_ns);
        }
        (self.plant_refused, self.plant_fails) = (plant.refuses, plant.fails);
        (self.latched, self.removed_in_tick, self.keyframe_of_tick) = (Some(reset), None, false);
        if let Err(cause) = self.shadow.step(latched) {
            self.fail(format!("a replay fails: {cause}"));
        }
    }

    /// Checks that no consumer is left further behind than its queue holds.
    fn check_lead(&mut self, tick: u64) {
        let (lead, parts): (u64, &[Part]) = match self.plan.mode {
            Mode::Lockstep => (self.plan.lead_ticks, &[Part::Drr, Part::Recorder]),
            Mode::Realtime if self.plan.waits_for_recorder => (self.plan.lead_ticks, &[Part::Recorder]),
            Mode::Realtime => return,
        };
        for part in parts {
            let here = match part {
                Part::Recorder => self.plan.recorder_ns.is_some(),
                _ => self.plan.drr_ns.is_some(),
            };
            let taken = self.taken(*part);
            expect!(self, !here || taken.is_some_and(|taken| taken + lead >= tick), {
                format!("tick {tick}: {part} has taken {taken:?}, with a permitted lead of {lead}")
            });
        }
    }

    /// Records that the hub publishes removed voxels.
    pub fn removed(&mut self, removed: &Removed, voxels: &[u32]) {
        self.removed_messages += 1;
        let (sequence, expected) = (removed.sequence, self.removed_messages);
        expect!(self, sequence == expected, format!("removed message {sequence}, expected {expected}"));
        if !self.shown {
            expect!(self, removed.tick == 0, "predrilled voxels after the start".to_owned());
            return;
        }
        let Some(reset) = self.latched else {
            return self.fail(format!("voxels of tick {} after its state", removed.tick));
        };
        let all = self.shadow.removed();
        let before = self.removed_in_tick.unwrap_or(0);
        let after = before + voxels.len();
        let right = removed.tick == self.tick + 1
            && removed.restore_first == u32::from(reset && self.removed_in_tick.is_none())
            && removed.removed_total
                == self.shadow.state().removed_total - all.len().saturating_sub(after) as u64
            && all.get(before..after) == Some(voxels)
            && voxels.len() <= messages::services::MAX_REMOVED_PER_MESSAGE;
        self.removed_in_tick = Some(after);
        expect!(self, right, format!("{removed:?} is not what the tick removed"));
    }

    /// Records that the hub publishes a reading.
    pub fn reading(&mut self, reading: &SensorReading) {
        let right =
            self.latched.is_some() && self.shadow.readings().get(self.readings_in_tick) == Some(reading);
        expect!(self, right, format!("reading {} published out of order", reading.sequence));
        self.readings_in_tick += 1;
    }

    /// Records that the hub publishes x_k.
    pub fn state(&mut self, state: &State, now_ns: u64) {
        if !self.shown {
            let predrilled = self.shadow.predrilled().len();
            let messages = predrilled.div_ceil(messages::services::MAX_REMOVED_PER_MESSAGE) as u64;
            let consumers = self.plan.drr_ns.iter().chain(&self.plan.recorder_ns).count();
            let (holes, here) = (self.removed_messages, self.taken.len());
            expect!(
                self,
                holes == messages,
                format!("{holes} messages of predrilled voxels, expected {messages}")
            );
            expect!(self, here == consumers, "x_0 before every consumer had connected".to_owned());
            self.shown = true;
        } else {
            let Some(reset) = self.latched.take() else {
                return self.fail(format!("x_{} without u", state.tick));
            };
            let removed = self.shadow.removed().len();
            let due = (reset || removed > 0).then_some(removed);
            let (tick, sent) = (state.tick, self.removed_in_tick);
            expect!(self, sent == due, format!("tick {tick}: voxels published: {sent:?}, expected {due:?}"));
            self.tick += 1;
            let (notes, notes_due) = (self.invalid_notes, self.invalid_due);
            expect!(self, notes == notes_due, format!("{notes} model warnings, expected {notes_due}"));
            let untold = self.invalid_untold || reset;
            self.invalid_untold = untold && self.tick < INVALID_FROM;
            self.invalid_due += u64::from(untold && self.tick >= INVALID_FROM);
        }
        // The plant runs out of memory in two ticks of one second: only the first is reported.
        let told = u32::from(self.tick > UNCUT_TICKS[0] && self.shown);
        expect!(self, self.capacity_notes == told, format!("{} capacity warnings", self.capacity_notes));
        let (sent, due) = (std::mem::take(&mut self.readings_in_tick), self.shadow.readings().len());
        expect!(self, sent == due, format!("tick {}: {sent} readings published, expected {due}", self.tick));
        let expected = self.shadow.state();
        let right = state.tick == self.tick && state.hash == expected.hash && state.tick == expected.tick;
        expect!(self, right, format!("x_{} differs from a replay of the log", state.tick));
        (self.state_ns, self.stops) = (now_ns, (0, 0));
    }

    fn keyframe_is_due(&self) -> bool {
        self.plan.recorder_ns.is_some()
            && self.plan.keyframe_period_ticks.is_some_and(|period| self.tick.is_multiple_of(period))
    }

    /// Records that the hub publishes a part of a keyframe.
    pub fn keyframe(&mut self, keyframe: &Keyframe, part: &[u8]) {
        self.keyframe_parts += 1;
        let due = self.keyframe_is_due();
        let (sequence, expected) = (keyframe.sequence, self.keyframe_parts);
        let placed = self.latched.is_none() && keyframe.tick == self.tick && due && !self.keyframe_of_tick;
        expect!(self, placed && sequence == expected, format!("{keyframe:?} published out of order"));
        self.keyframe_of_tick = true;
        let mut copy = ChainPlant::default();
        let restored = copy.restore_keyframe(part).is_ok() && copy.state().hash == self.shadow.state().hash;
        expect!(self, restored, format!("the keyframe of tick {} does not restore it", keyframe.tick));
    }

    /// Records that a tick begins in real time.
    pub fn tick_begins(&mut self, start_ns: u64, start: Start) {
        let lateness_ns = start.lateness_ns;
        expect!(self, lateness_ns >= 0, format!("tick {} begins {} ns early", self.tick, -lateness_ns));
        let deadline_ns = self.deadline_ns.unwrap_or(start_ns - lateness_ns.max(0) as u64);
        expect!(self, start_ns as i64 - lateness_ns == deadline_ns as i64, {
            format!(
                "tick {}: late by {lateness_ns} ns at {start_ns}, its deadline was {deadline_ns}",
                self.tick
            )
        });
        let missed = lateness_ns > PERIOD_NS as i64;
        expect!(self, missed == start.missed, format!("tick {}: missed is {}", self.tick, start.missed));
        self.missed += u64::from(missed);
        self.deadline_ns = Some(if missed { start_ns } else { deadline_ns } + PERIOD_NS);
    }

    /// Records that the hub publishes a tick's timing.
    pub fn timing(&mut self, timing: &TickTiming) {
        let due = self.keyframe_is_due();
        let sent = self.keyframe_of_tick;
        expect!(self, sent == due, format!("tick {}: keyframe sent: {sent}, expected {due}", self.tick));
        let expected = self.tick.checked_sub(1);
        expect!(
            self,
            Some(timing.tick) == expected,
            format!("timing of {}, expected {expected:?}", timing.tick)
        );
        self.refused += u64::from(std::mem::take(&mut self.plant_refused));
    }

    /// Records that the hub publishes the run's status.
    pub fn status(&mut self, status: &RunStatus) {
        let counts = [status.tick, status.missed_ticks, status.refused_commands, status.removed_messages];
        let expected = [self.tick, self.missed, self.refused, self.removed_messages];
        expect!(self, counts == expected, {
            format!("status: ticks, missed, refused, removed messages {counts:?}, expected {expected:?}")
        });
        expect!(self, !self.ended, "a status after the last one".to_owned());
        self.ended = status.phase() == Ok(Phase::Ended);
        if status.phase() == Ok(Phase::Paused) {
            // A pause ends with a new schedule.
            self.deadline_ns = None;
        }
    }

    /// Records that the hub sends an event.
    pub fn event(&mut self, note: &Note<'_>, now_ns: u64) {
        if note.severity == Severity::Error {
            self.told = Some(note.code);
        }
        if note.code == EventCode::CapacityReached {
            self.capacity_notes += 1;
            let text = format!("out of memory: {UNCUT} voxels");
            expect!(self, note.text.starts_with(&text), format!("an event reads `{}`", note.text));
        }
        self.invalid_notes += u64::from(note.code == EventCode::ModelNotValid);
        if note.code == EventCode::CommandRefused {
            self.refusal_is_reported(note.text);
        }
        let limited = [EventCode::CommandRefused, EventCode::MessagesLost, EventCode::RequestRefused];
        if !limited.contains(&note.code) {
            return;
        }
        self.warnings_ns.retain(|at_ns| at_ns + 100 * MS > now_ns);
        self.warnings_ns.push(now_ns);
        let (count, most) = (self.warnings_ns.len(), WARNINGS * (self.controllers.len() + 1));
        expect!(self, count <= most, format!("{count} warnings in a tenth of a second, at most {most}"));
    }
}
