//! Watches a run in progress, and judges what ended it.

use std::os::unix::process::ExitStatusExt;
use std::time::{Duration, Instant};

use ipc_types::messages::{EventCode, Phase, RunStatus, Tick};
use ipc_types::process::EndRequest;
use ipc_types::scene::{Controller, Scene};
use rustix::process::Signal;

use super::hub::{Hub, PHYSICS, RECORDER};
use super::log_watch::LogWatch;
use super::part::PartProcess;
use super::replacements::Replacements;
use super::run::{Outcome, RunError, RunPlan, RunSnapshot};
use super::subscriptions::Subscriptions;

const POLL_PERIOD: Duration = Duration::from_millis(20);
/// Time that the physics takes at most from closing its ports to its exit, on a loaded machine.
const PHYSICS_EXIT_TIME: Duration = Duration::from_secs(1);

/// A run in progress.
pub(super) struct Running<'a> {
    pub plan: &'a RunPlan,
    pub end: &'a EndRequest,
    pub hub: &'a Hub,
    pub subscriptions: Subscriptions,
    pub parts: Vec<PartProcess>,
    pub replacements: Replacements,
    pub first_tick: Option<Instant>,
}

impl Running<'_> {
    /// Watches the parts until something ends the run.
    pub fn watch(&mut self, show: &mut impl FnMut(&RunSnapshot)) -> Result<Outcome, RunError> {
        let awaited = awaited(&self.plan.scene, self.hub);
        let has_ring = self.plan.scene.recording.ring_s > 0.0;
        let mut log = self.plan.output.as_deref().map(|folder| LogWatch::new(folder, has_ring));
        loop {
            self.hub.serve_late_joiners()?;
            self.subscriptions.poll()?;
            show(&self.subscriptions.snapshot(self.hub.folder(), &awaited, &self.parts));
            if self.first_tick.is_none() && self.subscriptions.status.is_some_and(has_started) {
                self.first_tick = Some(self.subscriptions.first_start().unwrap_or_else(Instant::now));
            }
            self.subscriptions.forget_shown();
            self.parts.iter_mut().for_each(PartProcess::measure);
            if self.end.is_set() {
                return Ok(Outcome::Interrupted);
            }
            if let Some(index) = self.parts.iter_mut().position(|part| part.ended().is_some()) {
                match self.part_ended(index)? {
                    Some(outcome) => return Ok(outcome),
                    None => continue,
                }
            }
            if let Some(how) = log.as_mut().and_then(LogWatch::check) {
                return Ok(Outcome::LogGone(how));
            }
            std::thread::sleep(POLL_PERIOD);
        }
    }

    /// Handles a part that has ended; returns the outcome if that ends the run.
    fn part_ended(&mut self, index: usize) -> Result<Option<Outcome>, RunError> {
        // The physics publishes the end before any part can exit because of it.
        self.subscriptions.poll()?;
        let succeeded = self.parts[index].ended().is_some_and(|status| status.success());
        let run_has_ended = self.subscriptions.has_ended() || (succeeded && self.physics_ends()?);
        // Other parts exit cleanly when the physics fails; its report may have been dropped with its ports.
        let failed = |part: &mut PartProcess| part.name == PHYSICS && part.ended().is_some();
        let physics = self.parts.iter_mut().position(failed).filter(|_| succeeded && !run_has_ended);
        let index = physics.unwrap_or(index);
        let tick = self.subscriptions.state.as_ref().map_or(Tick::START, |state| Tick(state.tick));
        let run = if run_has_ended { RunState::Ended } else { RunState::Open };
        let goes_on = match run {
            RunState::Ended => self.replacements.dismiss(self.plan, &mut self.parts, index),
            RunState::Open => self.replacements.replace(self.plan, self.hub, &mut self.parts, index, tick)?,
        };
        if goes_on {
            return Ok(None);
        }
        let outcome = judge(&mut self.parts[index], run);
        Ok(Some(self.blamed(&outcome).unwrap_or_else(|| self.told_apart(outcome))))
    }

    /// Returns whether the physics reports the end of the run or exits successfully within
    /// [`PHYSICS_EXIT_TIME`]; false as soon as it has failed. The transport drops unread messages with their
    /// sender, so the report is lost if the physics closes its ports before the next poll: the end of a short
    /// run was then taken for the early end of a controller.
    fn physics_ends(&mut self) -> Result<bool, RunError> {
        let limit = Instant::now() + PHYSICS_EXIT_TIME;
        loop {
            let mut physics = self.parts.iter_mut().filter(|part| part.name == PHYSICS);
            let status = physics.find_map(PartProcess::ended);
            if self.subscriptions.has_ended() || status.is_some_and(|status| status.success()) {
                return Ok(true);
            }
            if status.is_some() || Instant::now() >= limit || self.end.is_set() {
                return Ok(false);
            }
            std::thread::sleep(POLL_PERIOD);
            self.subscriptions.poll()?;
        }
    }

    /// Returns the outcome if the physics ended the run because of a controller or the simulation.
    fn blamed(&self, outcome: &Outcome) -> Option<Outcome> {
        let is_end = match outcome {
            Outcome::PartDied { name, .. } => name == PHYSICS || self.subscriptions.has_ended(),
            _ => true,
        };
        let mut blame = self.hub.host.session.blame().filter(|_| is_end)?;
        let Some(name) = &blame.controller else { return Some(Outcome::SimulationFailed(blame.text)) };
        let mut controllers = self.plan.scene.controller.iter();
        let controller = controllers.find(|controller| controller.name == *name)?;
        if controller.external && blame.code == EventCode::ControllerMissing {
            let how = self.hub.host.session.how_to_connect(&controller.name);
            blame.text += &format!("; it is external: start it with {how}");
        }
        Some(Outcome::ControllerFailed(blame))
    }

    /// Distinguishes a stopped run, which ended before its last tick, from a completed one.
    fn told_apart(&self, outcome: Outcome) -> Outcome {
        let cut = |status: RunStatus| self.subscriptions.has_ended() && status.tick < status.tick_count;
        match outcome {
            Outcome::Completed if self.subscriptions.status.is_some_and(cut) => Outcome::Stopped,
            other => other,
        }
    }
}

/// Returns whether every part had connected; a run that ends before that has run no tick.
fn has_started(status: RunStatus) -> bool {
    match status.phase() {
        Ok(Phase::Running | Phase::Paused) => true,
        Ok(Phase::Ended) => status.tick > 0,
        Ok(Phase::Connecting) | Err(_) => false,
    }
}

/// Whether the physics has published the end of the run.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum RunState {
    Open,
    Ended,
}

/// Judges how a part ended. Once the run is over, DRR and controllers may exit shortly before the physics
/// does. The physics exits cleanly only after the run is over, and no part may exit before that.
pub(super) fn judge(part: &mut PartProcess, run: RunState) -> Outcome {
    let status = part.ended();
    let succeeded = status.is_some_and(|status| status.success());
    if succeeded && (part.name == PHYSICS || (run == RunState::Ended && part.name != RECORDER)) {
        return Outcome::Completed;
    }
    let how = match status {
        Some(status) if status.signal() == Some(Signal::KILL.as_raw()) && part.may_have_lacked_memory() => {
            format!("{status}, probably by the kernel because memory ran out")
        }
        Some(status) if !status.success() => status.to_string(),
        _ => "ended before the run".to_owned(),
    };
    Outcome::PartDied { name: part.name.clone(), how, last_words: part.last_words() }
}

/// Returns one line per external controller: how long the run waits for it, and how to connect it.
fn awaited(scene: &Scene, hub: &Hub) -> Vec<String> {
    let line = |controller: &Controller| {
        let Controller { name, connect_limit_s, optional, .. } = controller;
        let wait = match optional {
            true => "may join at any time".to_owned(),
            false => format!("has {connect_limit_s} s to connect"),
        };
        let how = hub.host.session.how_to_connect(name);
        format!("controller `{name}` {wait}; start it with {how}")
    };
    scene.controller.iter().filter(|controller| controller.external).map(line).collect()
}
