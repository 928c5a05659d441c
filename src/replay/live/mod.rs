//! Runs live controllers against a log: they receive its states, and their commands are compared with the
//! latched ones.
//!
//! Open loop: states and frames come from the log. Closed loop: the physics is stepped in lockstep with the
//! live commands, and frames are rendered. Both stop at the first difference; up to there, the controllers
//! see the same states in both.

mod answers;
mod stage;

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use hub::latch::Latch;
use ipc_types::messages::layout::Message;
use ipc_types::messages::{Command, ControllerIndex, Latched, Phase, State, Tick};
use ipc_types::ports::Publisher;
use ipc_types::process::EndRequest;
use ipc_types::scene::Mode;
use run_log::difference::compare;
use run_log::verify::compare_state;
use run_log::{RunMode, TickRecord, Topic};
use simulation::Simulation;
use zerocopy::IntoBytes;

use super::OpenedLog;
use super::frames::FrameReplay;
use crate::failure::{EXIT_INTERRUPTED, Failure};
use crate::launcher::hub::{Hub, Recording};
use crate::launcher::part::PartProcess;
use answers::LoggedCommands;
use stage::{Frames, Stage};

/// Timeout for a controller to connect.
const CONNECT_LIMIT: Duration = Duration::from_secs(60);
/// A longer wait is reported.
const SILENT_LIMIT: Duration = Duration::from_secs(2);
/// Timeout for a controller to end.
const END_LIMIT: Duration = Duration::from_secs(5);
const POLL_PERIOD: Duration = Duration::from_millis(20);

/// Which controllers are live, and how far to replay.
#[derive(Debug, Clone)]
pub struct LivePlan {
    /// Name in the scene, program and arguments of each controller.
    pub controllers: Vec<(String, Vec<String>)>,
    /// Whether the physics follows the live commands.
    pub closed_loop: bool,
    /// Last tick (`State.tick`).
    pub to_tick: Tick,
}

/// Runs the plan; returns how many commands of each controller were identical.
///
/// # Errors
/// The first difference; a controller that ends or does not reply; bad input, reported before anything
/// starts.
pub fn run(log: &OpenedLog, plan: &LivePlan) -> Result<Vec<(String, u64)>, Failure> {
    let indices = indices(log, plan)?;
    let mode = log.reader()?.header().mode;
    if mode == RunMode::RealTime && !plan.closed_loop && plan.controllers.len() > 1 {
        return Err(Failure::bad_input(
            "in a real-time log each controller saw different states: give one --controller at a time",
        ));
    }
    let end = EndRequest::install().map_err(Failure::signals)?;
    let answers = LoggedCommands::read(log, &indices)?;
    // In closed loop every tick needs a command.
    let asked = |expected: &BTreeMap<u64, Command>| match plan.closed_loop {
        true => plan.to_tick > Tick::START,
        false => expected.range(..plan.to_tick.0).next().is_some(),
    };
    if let Some(live) = answers.expected.iter().position(|expected| !asked(expected)) {
        return Err(nothing_to_compare(log, plan, live));
    }
    let mut scene = log.scene.clone();
    if plan.closed_loop {
        scene.run.mode = Mode::Lockstep;
    }
    let hub = Hub::create(&scene, log.ct.as_ref(), Recording::Off)?;
    let stage = Stage::open(&hub.host.session, &plan.controllers, &indices, &scene)?;
    let start =
        |(name, words): &(String, Vec<String>)| hub.start_program(name, words).map_err(Failure::failed);
    let parts = plan.controllers.iter().map(start).collect::<Result<Vec<_>, _>>()?;
    let limit = Duration::from_secs_f64(scene.run.controller_limit_ms * 1e-3);
    let threads = scene.drr.as_ref().map_or(1, |drr| drr.threads);
    let frames = Frames { replay: FrameReplay::new(log, threads)?, next: None, rendered: plan.closed_loop };
    let mut play = ReplayedSession {
        log,
        hub,
        stage,
        parts,
        answers,
        frames,
        limit,
        end,
        identical: vec![0; indices.len()],
    };
    let played = match plan.closed_loop {
        false => play.open_loop(plan.to_tick),
        true => play.closed_loop(plan.to_tick, Latch::new(&scene)),
    };
    play.finish();
    played?;
    if let Some(live) = play.identical.iter().position(|identical| *identical == 0) {
        return Err(nothing_to_compare(log, plan, live));
    }
    Ok(plan.controllers.iter().map(|(name, _)| name.clone()).zip(play.identical).collect())
}

/// Error for a log without commands of this controller, so that there was nothing to compare.
fn nothing_to_compare(log: &OpenedLog, plan: &LivePlan, live: usize) -> Failure {
    let (name, log) = (&plan.controllers[live].0, log.path.display());
    Failure::bad_input(format!(
        "--controller `{name}`: {log}: no commands of this controller in this range of ticks"
    ))
}

/// Returns the indices of the live controllers in the scene.
fn indices(log: &OpenedLog, plan: &LivePlan) -> Result<Vec<ControllerIndex>, Failure> {
    let names = log.scene.controller_names();
    let find = |name: &String| {
        ControllerIndex::first(names.len()).find(|index| names[index.slot()] == *name).ok_or_else(|| {
            let names = names.join("`, `");
            Failure::bad_input(format!("--controller `{name}`: not in the log's scene, which has `{names}`"))
        })
    };
    plan.controllers.iter().map(|(name, _)| find(name)).collect()
}

struct ReplayedSession<'l> {
    log: &'l OpenedLog,
    hub: Hub,
    stage: Stage,
    parts: Vec<PartProcess>,
    answers: LoggedCommands,
    frames: Frames<'l>,
    limit: Duration,
    end: EndRequest,
    identical: Vec<u64>,
}

impl ReplayedSession<'_> {
    /// Publishes the log's states and compares the commands.
    fn open_loop(&mut self, to_tick: Tick) -> Result<(), Failure> {
        let mut ticks = self.log.reader()?;
        let mut state = Box::new(*ticks.initial());
        self.stage.say(Tick::START, Phase::Running).map_err(Failure::failed)?;
        while Tick(state.tick) < to_tick {
            self.show(&state)?;
            for live in 0..self.stage.live.len() {
                if let Some(expected) = self.answers.expected[live].get(&state.tick).copied() {
                    let answer = self.await_answer(live, Tick(state.tick))?;
                    self.compare_command(live, Tick(state.tick), &expected, &answer)?;
                }
            }
            let Some(record) = ticks.next() else { return Ok(()) };
            let record = record.map_err(Failure::failed)?;
            self.stage.latched.send(&record.latched).map_err(Failure::failed)?;
            *state = record.state;
        }
        Ok(())
    }

    /// Steps the physics with the live commands, and compares commands and states.
    fn closed_loop(&mut self, to_tick: Tick, mut latch: Latch) -> Result<(), Failure> {
        let mut ticks = self.log.reader()?;
        let mut simulation = self.log.simulation().map_err(Failure::failed)?;
        if let Some(divergence) = compare_state(ticks.initial(), simulation.state()) {
            return Err(self.differs(&divergence.to_string()));
        }
        self.stage.say(Tick::START, Phase::Running).map_err(Failure::failed)?;
        while Tick(simulation.state().tick) < to_tick {
            let Some(record) = ticks.next() else { return Ok(()) };
            let record = record.map_err(Failure::failed)?;
            self.show(simulation.state())?;
            let latched = self.latch(&record, &mut latch)?;
            self.step(&mut simulation, &latched, &record)?;
        }
        Ok(())
    }

    /// Returns u_k: live commands for live controllers, logged commands for all others.
    fn latch(&mut self, record: &TickRecord, latch: &mut Latch) -> Result<Latched, Failure> {
        let tick = Tick(record.latched.tick);
        for live in 0..self.stage.live.len() {
            let answer = self.await_answer(live, tick)?;
            let (name, index) = (&self.stage.live[live].name, self.stage.live[live].index);
            latch.offer(index, &answer, tick).map_err(|cause| {
                let text = format!("tick {tick}, controller `{name}`: invalid command: {cause}");
                Failure::failed(text)
            })?;
        }
        let decided = latch.latch(tick, record.latched.reset());
        let mut latched = record.latched;
        for live in 0..self.stage.live.len() {
            let index = self.stage.live[live].index;
            let (recorded, mut answered) =
                (record.latched.commands[index.slot()], decided.commands[index.slot()]);
            // The recorded controller may have restarted and reset its sequence numbers; the live one has
            // not.
            answered.command.sequence = recorded.command.sequence;
            self.compare_command(live, tick, &recorded.command, &answered.command)?;
            if (recorded.source, recorded.age_ticks) != (answered.source, answered.age_ticks) {
                let name = &self.stage.live[live].name;
                return Err(self.differs(&format!(
                    "first difference: tick {tick}, controller `{name}`, source and age_ticks: {} and {} vs \
                     {} and {}",
                    recorded.source, recorded.age_ticks, answered.source, answered.age_ticks
                )));
            }
            latched.commands[index.slot()] = answered;
        }
        Ok(latched)
    }

    fn step(
        &mut self,
        simulation: &mut Simulation<'_>,
        latched: &Latched,
        record: &TickRecord,
    ) -> Result<(), Failure> {
        self.stage.latched.send(latched).map_err(Failure::failed)?;
        simulation.step(latched).map_err(Failure::failed)?;
        match compare_state(&record.state, simulation.state()) {
            None => Ok(()),
            Some(divergence) => Err(self.differs(&divergence.to_string())),
        }
    }

    /// Publishes a state and the frames of its tick.
    fn show(&mut self, state: &State) -> Result<(), Failure> {
        self.stage.show(state).map_err(Failure::failed)?;
        while let Some(record) = self.frames.due(state.tick)? {
            if let Some(reply) = self.answers.replies.get(&record.frame.sequence) {
                self.stage.replies.send(reply).map_err(Failure::failed)?;
            }
            if let (Some(publisher), Some(image)) = (&self.stage.frames, &record.image) {
                let parts = [record.frame.as_bytes(), image.as_bytes(), &record.pixels];
                publisher.send_parts(&parts).map_err(Failure::failed)?;
            }
        }
        Ok(())
    }

    /// Waits for a live controller's command for the state of this tick.
    fn await_answer(&mut self, live: usize, tick: Tick) -> Result<Command, Failure> {
        let connects = self.identical[live] == 0;
        let began = Instant::now();
        let limit = began + if connects { CONNECT_LIMIT } else { self.limit };
        let mut told = !connects;
        loop {
            while let Some(command) = self.stage.live[live].commands.receive().map_err(Failure::failed)? {
                if command.message().state_tick == tick.0 {
                    return Ok(*command.message());
                }
            }
            let name = &self.stage.live[live].name;
            if self.end.is_set() {
                return Err(Failure { message: "interrupted".to_owned(), code: EXIT_INTERRUPTED });
            }
            if let Some(status) = self.parts[live].ended() {
                let words = self.parts[live].last_words().join("\n  ");
                let text =
                    format!("tick {tick}: controller `{name}` ended ({status}); its last output:\n  {words}");
                return Err(Failure::failed(text));
            }
            if !told && began.elapsed() >= SILENT_LIMIT {
                let seconds = CONNECT_LIMIT.as_secs();
                tell!(
                    "trabecula: waiting for the first command of controller `{name}`, for up to {seconds} s"
                );
                told = true;
            }
            if Instant::now() >= limit {
                let text = format!("tick {tick}: controller `{name}` sent no command for this state");
                return Err(Failure::failed(text));
            }
            self.hub.serve_late_joiners().map_err(Failure::failed)?;
            self.stage.states.deliver_history().map_err(Failure::failed)?;
            self.stage.status.deliver_history().map_err(Failure::failed)?;
            self.stage.frames.iter().try_for_each(Publisher::deliver_history).map_err(Failure::failed)?;
            let commands = &self.stage.live[live].commands;
            self.stage.waiter.wait_until(Instant::now() + POLL_PERIOD, || commands.has_message());
        }
    }

    fn compare_command(
        &mut self,
        live: usize,
        tick: Tick,
        expected: &Command,
        answer: &Command,
    ) -> Result<(), Failure> {
        let answer = Command { sequence: expected.sequence, ..*answer };
        let (a, b) = (expected.as_bytes(), answer.as_bytes());
        let Some(difference) = compare(Topic::Latched, tick, Command::DESCRIPTION, a, b) else {
            self.identical[live] += 1;
            return Ok(());
        };
        let name = &self.stage.live[live].name;
        let mut text = format!("first difference: tick {tick}, controller `{name}`, log vs live:");
        difference.differences.iter().for_each(|field| text.push_str(&format!("\n  {field}")));
        Err(self.differs(&text))
    }

    fn differs(&self, what: &str) -> Failure {
        Failure::failed(format!("{what}{}", self.log.label()))
    }

    /// Ends the controllers.
    fn finish(&mut self) {
        // Controllers that miss this message are killed.
        let _ = self.stage.say(Tick::START, Phase::Ended);
        for part in &mut self.parts {
            if !part.wait(END_LIMIT) {
                tell!("trabecula: controller `{}` did not end in time and was killed", part.name);
            }
        }
    }
}
