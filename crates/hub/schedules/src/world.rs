//! The hub's surroundings in memory: a clock driven by events, queues, and all programs at the other end of
//! them.

use std::cell::Cell;
use std::cmp::Reverse;
use std::collections::{BinaryHeap, VecDeque};
use std::rc::Rc;

use delivery::x_ray::FrameMark;
use fastrand::Rng;
use hub::rate_limit::Connection;
use hub::{IncomingMessage, Report, Wait, WakeCondition};
use messages::{ControlAction, ControllerIndex, Part, RunControl, Tick};
use scene::Drives;

use crate::actors::{Alarm, Consumer, Controller, FrameViewer};
use crate::drr::DrrProcess;
use crate::oracle::Oracle;
use crate::oracle::seen_frames::SeenFrames;
use crate::oracle::x_ray::FrameAccount;
use crate::plan::{FaultKind, MS, SchedulePlan, US};
use crate::plant::Handle;
use crate::recording::Recording;
use crate::viewer::Viewer;

// The environment that the hub sees.
mod environment;
// X-ray frames and the controllers that see them.
mod frames;
mod watching;

/// Longest sleep of a reader before it polls again by itself.
const LONGEST_SLEEP_NS: u64 = 10 * MS;
/// Time between two polls of a controller that waits for an X-ray frame.
const FRAME_POLL_NS: u64 = 500 * US;
/// Capacity of the queues of run control and of progress.
const QUEUE: usize = 256;
/// How often in a row the hub may wait for something that is already there, or for a time that has passed.
const IDLE_WAITS: u32 = 8;
/// Time after which the launcher notices that the DRR process has ended.
const LAUNCHER_NOTICES_NS: u64 = 20 * MS;

/// An event of the schedule.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Event {
    ControllerJoins(ControllerIndex),
    ControllerLooks(ControllerIndex, u64),
    ControllerAnswers(ControllerIndex, u64, u64),
    ConsumerLooks(usize, u64),
    Fault(usize),
    LauncherNotices,
    UserResumes,
    FramesAsked(usize),
    ViewerLooks,
    WatcherJoins(usize),
    WatcherLeaves(usize),
    WatcherServes(usize, u64),
    WatcherChanges(usize, usize),
}

/// Everything except the hub.
#[derive(Debug)]
pub struct World {
    plan: SchedulePlan,
    now_ns: Rc<Cell<u64>>,
    plant: Handle,
    random: Rng,
    events: BinaryHeap<Reverse<(u64, u64, Event)>>,
    order: u64,
    controllers: Vec<Controller>,
    consumers: Vec<Consumer>,
    /// The DRR process while it is alive.
    drr: Option<DrrProcess>,
    frame_requests: u64,
    /// Number of the plan's requests sent so far.
    asked: usize,
    /// The newest published frame.
    newest_frame: Option<FrameMark>,
    viewer: Option<Viewer>,
    watcher_alarms: Vec<Alarm>,
    control: VecDeque<IncomingMessage<RunControl>>,
    requests: u64,
    reports: VecDeque<Report>,
    foreign: u64,
    end_requested: bool,
    newest_tick: Option<u64>,
    stopped_ns: u64,
    idle_waits: u32,
    /// The log of the run, if the plan cuts it.
    pub recording: Option<Recording>,
    /// Checks the hub's rules.
    pub oracle: Oracle,
    /// Checks the rules of X-ray frames.
    pub frames: FrameAccount,
    /// Checks the rules of the frames that controllers see.
    pub seen_frames: SeenFrames,
}

impl World {
    /// Creates the world of a plan whose controllers drive these parts.
    pub fn new(plan: &SchedulePlan, drives: &[Vec<Drives>], plant: Handle) -> World {
        let now_ns = Rc::clone(&plant.now_ns);
        let controllers = ControllerIndex::first(drives.len()).zip(drives);
        let consumers = [(Part::Drr, plan.drr_ns), (Part::Recorder, plan.recorder_ns)];
        let mut world = World {
            oracle: Oracle::new(plan, drives, now_ns.get()),
            frames: FrameAccount::new(plan),
            drr: plan.drr_ns.map(|_| DrrProcess::new(plan)),
            frame_requests: 0,
            asked: 0,
            newest_frame: None,
            viewer: plan.viewer.as_ref().map(|viewer| Viewer::new(viewer, plan.seed, now_ns.get())),
            watcher_alarms: Vec::new(),
            seen_frames: SeenFrames::new(plan),
            now_ns,
            plant,
            random: Rng::with_seed(plan.seed ^ 0x9e37_79b9_7f4a_7c15),
            events: BinaryHeap::new(),
            order: 0,
            controllers: controllers.map(|(index, drives)| Controller::new(plan, index, drives)).collect(),
            consumers: consumers
                .iter()
                .filter_map(|(part, look_ns)| Some(Consumer::new(*part, (*look_ns)?)))
                .collect(),
            control: VecDeque::new(),
            requests: 0,
            reports: VecDeque::new(),
            foreign: 0,
            end_requested: false,
            newest_tick: None,
            stopped_ns: 0,
            idle_waits: 0,
            recording: None,
            plan: plan.clone(),
        };
        world.recording = plan.log_cut.and_then(|cut| {
            let begun = Recording::begin(plan, cut);
            begun.map_err(|error| world.oracle.fail(format!("the recording: {error}"))).ok()
        });
        for index in ControllerIndex::first(world.controllers.len()) {
            let joins_ns = world.controllers[index.slot()].plan.joins_ns;
            world.after(joins_ns, Event::ControllerJoins(index));
        }
        for index in 0..world.consumers.len() {
            let look_ns = world.consumers[index].look_ns;
            world.after(look_ns, Event::ConsumerLooks(index, 0));
        }
        for index in 0..world.plan.faults.len() {
            world.after(world.plan.faults[index].at_ns, Event::Fault(index));
        }
        for index in 0..world.plan.x_ray.asks.len() {
            world.after(world.plan.x_ray.asks[index].at_ns, Event::FramesAsked(index));
        }
        world.plan_watching();
        let last_ns = world.plan.faults.iter().map(|fault| fault.at_ns).max().unwrap_or(0);
        if world.plan.has(|kind| matches!(kind, FaultKind::Control { .. })) {
            world.after(last_ns + 50 * MS, Event::UserResumes);
        }
        world
    }

    fn after(&mut self, delay_ns: u64, event: Event) {
        self.order += 1;
        self.events.push(Reverse((self.now_ns.get() + delay_ns, self.order, event)));
    }

    /// Processes all events that are due.
    fn catch_up(&mut self) {
        while let Some(Reverse((at_ns, _, event))) = self.events.peek().copied() {
            if at_ns > self.now_ns.get() {
                return;
            }
            self.events.pop();
            self.happen(event);
        }
    }

    /// Lets a moment pass in the hub while the other programs continue.
    fn moment(&mut self) {
        self.now_ns.set(self.now_ns.get() + self.random.u64(100..US));
        self.catch_up();
    }

    fn happen(&mut self, event: Event) {
        match event {
            Event::ControllerJoins(index) => {
                self.controllers[index.slot()].join();
                self.seen_frames.joined(index);
                self.look_soon(index, 0);
            }
            Event::ControllerLooks(index, alarm) => self.controller_looks(index, Alarm(alarm)),
            Event::ControllerAnswers(index, alarm, tick) => {
                if self.controllers[index.slot()].alive
                    && self.controllers[index.slot()].alarm == Alarm(alarm)
                {
                    self.controllers[index.slot()].answer(tick);
                    self.look_soon(index, 0);
                }
            }
            Event::ConsumerLooks(index, alarm) => self.consumer_looks(index, Alarm(alarm)),
            Event::Fault(index) => self.fault(index),
            Event::LauncherNotices => self.request_end(),
            Event::FramesAsked(index) => self.frames_asked(index),
            Event::ViewerLooks => self.viewer_looks(),
            Event::WatcherJoins(_)
            | Event::WatcherLeaves(_)
            | Event::WatcherServes(..)
            | Event::WatcherChanges(..) => self.watching_happens(event),
            Event::UserResumes => {
                if self.oracle.paused {
                    self.request(ControlAction::Resume.code(), 0);
                }
                self.after(50 * MS, Event::UserResumes);
            }
        }
    }

    fn look_soon(&mut self, index: ControllerIndex, delay_ns: u64) {
        let controller = &mut self.controllers[index.slot()];
        controller.alarm.0 += 1;
        let alarm = controller.alarm.0;
        self.after(delay_ns, Event::ControllerLooks(index, alarm));
    }

    fn controller_looks(&mut self, index: ControllerIndex, alarm: Alarm) {
        let now_ns = self.now_ns.get();
        let controller = &mut self.controllers[index.slot()];
        if !controller.alive || controller.alarm != alarm {
            return;
        }
        controller.asleep = false;
        if controller.stalled_until_ns > now_ns {
            let delay_ns = controller.stalled_until_ns - now_ns;
            return self.look_soon(index, delay_ns);
        }
        let waits_at = controller.sight.as_ref().and_then(|sight| sight.waits_at);
        match waits_at.or_else(|| controller.take_state()) {
            None => {
                controller.asleep = true;
                self.look_soon(index, LONGEST_SLEEP_NS);
            }
            Some(tick) => {
                let waits = |sight: &mut FrameViewer| sight.look(index, tick, now_ns, &mut self.seen_frames);
                if controller.sight.as_mut().is_some_and(waits) {
                    return self.look_soon(index, FRAME_POLL_NS);
                }
                let longest_ns = controller.plan.answer_ns;
                controller.alarm.0 += 1;
                let alarm = controller.alarm.0;
                let answer_ns = self.random.u64(longest_ns / 4..=longest_ns);
                self.after(answer_ns, Event::ControllerAnswers(index, alarm, tick));
            }
        }
    }

    fn consumer_looks(&mut self, index: usize, alarm: Alarm) {
        let (now_ns, newest_tick) = (self.now_ns.get(), self.newest_tick.unwrap_or(0));
        let consumer = &mut self.consumers[index];
        if !consumer.alive || consumer.alarm != alarm {
            return;
        }
        let mut delay_ns = consumer.look_ns;
        let part = consumer.part;
        if consumer.stalled_until_ns > now_ns {
            delay_ns = consumer.stalled_until_ns - now_ns;
            consumer.asleep = false;
        } else if let Some(until_ns) = self.stands_still_until(part) {
            delay_ns = until_ns.saturating_sub(now_ns);
            self.consumers[index].asleep = false;
        } else if self.consumers[index].alive {
            let consumer = &mut self.consumers[index];
            consumer.asleep = true;
            if let Some(tick) = consumer.take(newest_tick) {
                if self.reports.len() == QUEUE {
                    self.reports.pop_front();
                }
                self.reports.push_back(Report { part: consumer.part, tick: Tick(tick) });
            }
        }
        let consumer = &mut self.consumers[index];
        consumer.alarm.0 += 1;
        let alarm = consumer.alarm.0;
        self.after(delay_ns, Event::ConsumerLooks(index, alarm));
    }

    /// Kills a consumer, which the launcher notices after a time.
    fn kill(&mut self, part: Part, noticed_after_ns: u64) {
        let mut died = false;
        for consumer in self.consumers.iter_mut().filter(|consumer| consumer.part == part) {
            (consumer.alive, consumer.asleep, died) = (false, false, true);
        }
        if part == Part::Drr {
            self.drr = None;
        }
        if died {
            self.after(noticed_after_ns, Event::LauncherNotices);
        }
    }

    fn fault(&mut self, index: usize) {
        let now_ns = self.now_ns.get();
        match self.plan.faults[index].kind.clone() {
            FaultKind::ControllerDies { index, back_after_ns } => {
                let controller = &mut self.controllers[index];
                (controller.alive, controller.asleep) = (false, false);
                controller.alarm.0 += 1;
                controller.states.clear();
                if let Some(back_after_ns) = back_after_ns {
                    self.after(back_after_ns, Event::ControllerJoins(ControllerIndex(index as u32)));
                }
            }
            FaultKind::ControllerStalls { index, for_ns } => {
                self.controllers[index].stalled_until_ns = now_ns + for_ns;
                self.controllers[index].asleep = false;
            }
            FaultKind::BadCommand { index, bad } => {
                if self.controllers[index].alive {
                    self.controllers[index].misbehave(bad);
                }
            }
            FaultKind::CommandFlood { index, count } => {
                let tick = self.newest_tick.unwrap_or(0);
                if self.controllers[index].alive {
                    (0..count).for_each(|_| self.controllers[index].answer(tick));
                }
            }
            FaultKind::ConsumerStalls { recorder, for_ns } => {
                for consumer in self.consumers.iter_mut().filter(|c| (c.part == Part::Recorder) == recorder) {
                    (consumer.stalled_until_ns, consumer.asleep) = (now_ns + for_ns, false);
                }
            }
            FaultKind::ConsumerDies { recorder, noticed_after_ns } => {
                self.kill(if recorder { Part::Recorder } else { Part::Drr }, noticed_after_ns);
            }
            FaultKind::Control { action, ticks, count } => {
                (0..count).for_each(|_| self.request(action, ticks))
            }
            FaultKind::MalformedControl { count } => {
                (0..count).for_each(|_| self.push_control(IncomingMessage::Malformed("3 bytes".to_owned())));
            }
            FaultKind::ForeignReport => self.foreign += 1,
            FaultKind::HubStops { for_ns } => self.stopped_ns += for_ns,
            FaultKind::SlowTick { for_ns } => self.plant.slow_ns.set(for_ns),
            FaultKind::PlantRefuses => self.plant.refuses.set(true),
            FaultKind::PlantFails => self.plant.fails.set(true),
            FaultKind::EndRequest => self.request_end(),
        }
    }

    fn request_end(&mut self) {
        self.end_requested = true;
        self.oracle.end_requested(self.now_ns.get());
    }

    fn request(&mut self, action: u32, ticks: u64) {
        self.requests += 1;
        let request = RunControl { request_id: self.requests, ticks, action, reserved: 0 };
        self.push_control(IncomingMessage::Message(request, Connection(7)));
    }

    fn push_control(&mut self, incoming: IncomingMessage<RunControl>) {
        if self.control.len() == QUEUE {
            self.control.pop_front();
        }
        self.control.push_back(incoming);
    }

    /// Processes the events that happen while the hub waits.
    pub fn wait(&mut self, wait: Wait) {
        self.check_sleepers(wait);
        let began_ns = self.now_ns.get();
        // A signal can end any wait early.
        let interrupted_ns =
            if self.random.u8(..32) == 0 { began_ns + self.random.u64(..5 * MS) } else { u64::MAX };
        let until_ns = wait.until_ns.min(interrupted_ns);
        while !self.is_ready(wait.on) && self.now_ns.get() < until_ns {
            match self.events.peek().copied() {
                Some(Reverse((at_ns, _, event))) if at_ns <= until_ns => {
                    self.events.pop();
                    self.now_ns.set(self.now_ns.get().max(at_ns));
                    self.happen(event);
                }
                _ => self.now_ns.set(until_ns),
            }
        }
        self.idle_waits = if self.now_ns.get() == began_ns { self.idle_waits + 1 } else { 0 };
        if self.idle_waits > IDLE_WAITS {
            self.oracle.fail(format!("the hub spins: {wait:?} at {began_ns}"));
        }
        let oversleep_ns =
            [self.random.u64(..2 * US), self.random.u64(..60 * US)][usize::from(self.random.u8(..8) == 0)];
        let stopped_ns = std::mem::take(&mut self.stopped_ns);
        self.oracle.stopped(stopped_ns);
        self.now_ns.set(self.now_ns.get() + oversleep_ns + stopped_ns);
        self.catch_up();
    }

    /// Checks that a sleeping reader has nothing to do or has been woken.
    fn check_sleepers(&mut self, wait: Wait) {
        if let Some(index) = self.controllers.iter().position(|c| c.asleep && !c.states.is_empty()) {
            self.oracle.fail(format!("controller {index} sleeps although a state waits: it was not woken"));
        }
        self.check_frame_waits();
        self.oracle.first_refusals_are_reported();
        let waits = wait.on == WakeCondition::Report;
        if waits && self.consumers.iter().any(|consumer| consumer.asleep && consumer.waiting > 0) {
            self.oracle.fail("the hub waits for a consumer that was not woken".to_owned());
        }
        if wait.until_ns > self.now_ns.get() + 250 * MS {
            self.oracle.fail(format!("{wait:?} polls nothing for too long"));
        }
    }

    fn is_ready(&self, on: WakeCondition) -> bool {
        match on {
            WakeCondition::Nothing | WakeCondition::Deadline => false,
            WakeCondition::Control => !self.control.is_empty(),
            WakeCondition::Report => !self.reports.is_empty(),
            WakeCondition::Command(index) => !self.controllers[index.slot()].commands.is_empty(),
        }
    }
}
