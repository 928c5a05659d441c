//! Ends a run.
//!
//! Order: the physics exits once its consumers have received everything; the DRR process and the controllers
//! exit when the physics announces the end; the recorder is stopped last, after all publishers. A signal
//! shortens every wait except the recorder's, which must finish the log; a second signal ends that one too.

use std::time::{Duration, Instant};

use ipc_types::messages::EventCode;
use ipc_types::process::EndRequest;
use ipc_types::session::SessionHost;
use output_file::SavedFile;
use recorder_proc::reason_file;
use run_log::EndReason;

use super::hub::{DRR, PHYSICS, RECORDER};
use super::part::PartProcess;
use super::run::{Outcome, RunPlan, has_gap};
use super::running::{RunState, judge};

const POLL_PERIOD: Duration = Duration::from_millis(5);
/// Timeout for a part to end.
const END_LIMIT: Duration = Duration::from_secs(130);
/// The same limit after a failure.
const FAILED_LIMIT: Duration = Duration::from_secs(10);
/// The same limit after a signal: once for the physics, then once for all others together, which get half of
/// it before they receive SIGTERM.
const HURRIED_LIMIT: Duration = Duration::from_secs(1);
/// How long a controller that ignores the end of the run can continue before it receives SIGTERM.
const CONTROLLER_END_TIME: Duration = Duration::from_secs(3);
/// Timeout for the viewer to notify its clients that the run has ended; without clients it ends at once.
const VIEWER_LIMIT: Duration = Duration::from_secs(3);

/// A run that is ending.
pub(super) struct Ending<'a> {
    pub(super) plan: &'a RunPlan,
    pub(super) end: &'a EndRequest,
    /// The session's host.
    pub(super) host: &'a SessionHost,
    /// Whether the physics has reported a status. Before that, no part has anything to finish.
    pub(super) has_begun: bool,
}

/// Waits whose limit shrinks after a signal.
struct Wait<'a> {
    end: &'a EndRequest,
    began: Instant,
    hurried: Option<Instant>,
}

impl Wait<'_> {
    /// Returns whether a limit has expired. The hurried limit counts from the signal, or from the start of
    /// the wait if the signal arrived earlier.
    fn is_over(&mut self, limit: Duration, hurried_limit: Duration) -> bool {
        if self.hurried.is_none() && self.end.is_set() {
            self.hurried = Some(Instant::now());
        }
        self.began.elapsed() >= limit || self.hurried.is_some_and(|since| since.elapsed() >= hurried_limit)
    }
}

/// When a part receives SIGTERM.
#[derive(Clone, Copy, PartialEq, Eq)]
enum TerminationTiming {
    AtOnce,
    /// After it has had its own time to end, or at once if nothing depends on it.
    WhenDue,
}

impl Ending<'_> {
    fn wait(&self) -> Wait<'_> {
        Wait { end: self.end, began: Instant::now(), hurried: None }
    }

    /// Ends all parts in order; returns when the physics ended, and the outcome, which the other parts can
    /// worsen.
    pub(super) fn end_parts(&self, outcome: Outcome, parts: &mut [PartProcess]) -> (Instant, Outcome) {
        let mut outcome = outcome;
        let mut reason = None;
        self.write_reason(&mut reason, &outcome, parts);
        let stops = !outcome.is_regular();
        // In a run that never started, parts have nothing to finish and do not listen yet.
        let is_deaf = stops && !self.has_begun;
        let limit = match (is_deaf, &outcome) {
            (true, _) => Duration::ZERO,
            (false, Outcome::Completed | Outcome::Stopped | Outcome::Interrupted) => END_LIMIT,
            (false, _) => FAILED_LIMIT,
        };
        self.end_physics(
            limit,
            if stops { TerminationTiming::AtOnce } else { TerminationTiming::WhenDue },
            parts,
        );
        let over = Instant::now();
        let untold = stops && outcome != Outcome::Interrupted;
        self.end_others(
            limit,
            if untold { TerminationTiming::AtOnce } else { TerminationTiming::WhenDue },
            parts,
        );
        if outcome.is_regular() && self.end.is_set() {
            outcome = Outcome::Interrupted;
        }
        if !is_deaf {
            outcome = self.with_end_of(DRR, outcome, parts);
        }
        self.write_reason(&mut reason, &outcome, parts);
        if let Some(recorder) = parts.iter_mut().find(|part| part.name == RECORDER) {
            recorder.ask_to_end();
            // Never cut short: everything that was published must reach the log.
            if !recorder.wait(END_LIMIT) {
                self.tell_killed(recorder);
            }
        }
        if let Some(reason) = reason {
            // A recorder that died has not read the file.
            let _ = reason.remove();
        }
        (over, if is_deaf { outcome } else { self.with_end_of(RECORDER, outcome, parts) })
    }

    /// Ends the physics. It waits until the DRR process and the recorder have received everything; if one of
    /// them dies, or after a signal, it is asked to stop waiting.
    fn end_physics(&self, limit: Duration, ask: TerminationTiming, parts: &mut [PartProcess]) {
        let (mut wait, mut asked) = (self.wait(), false);
        loop {
            let mut has_died = |name: &str| {
                let part = parts.iter_mut().find(|part| part.name == name);
                part.and_then(PartProcess::ended).is_some_and(|status| !status.success())
            };
            let nobody_comes = has_died(DRR) || has_died(RECORDER);
            let Some(physics) = parts.iter_mut().find(|part| part.name == PHYSICS) else { return };
            if physics.ended().is_some() {
                return;
            }
            if !asked && (ask == TerminationTiming::AtOnce || nobody_comes || self.end.is_set()) {
                physics.ask_to_end();
                asked = true;
            }
            if wait.is_over(limit, HURRIED_LIMIT) {
                physics.kill();
                self.tell_killed(physics);
                return;
            }
            physics.measure();
            std::thread::sleep(POLL_PERIOD);
        }
    }

    /// Ends the DRR process and the controllers in parallel. With [`TerminationTiming::AtOnce`], they have
    /// not been notified that the run is over.
    fn end_others(&self, limit: Duration, ask: TerminationTiming, parts: &mut [PartProcess]) {
        let mut others: Vec<(&mut PartProcess, bool)> = parts
            .iter_mut()
            .filter(|part| part.name != PHYSICS && part.name != RECORDER)
            .map(|part| (part, false))
            .collect();
        let mut wait = self.wait();
        loop {
            others.retain_mut(|(part, _)| part.ended().is_none());
            if others.is_empty() {
                return;
            }
            let is_over = wait.is_over(limit, HURRIED_LIMIT);
            for (part, asked) in &mut others {
                // The physics notifies the DRR process and the controllers when it ends, but some controllers
                // ignore it.
                let own_time = if part.name == DRR { END_LIMIT } else { CONTROLLER_END_TIME };
                if !*asked && (ask == TerminationTiming::AtOnce || wait.is_over(own_time, HURRIED_LIMIT / 2))
                {
                    part.ask_to_end();
                    *asked = true;
                }
                if is_over {
                    part.kill();
                    self.tell_killed(part);
                }
                part.measure();
            }
            std::thread::sleep(POLL_PERIOD);
        }
    }

    /// Waits for the viewer to end, or kills it. After a regular recorded run it shows the log while a page
    /// is open, and is returned.
    pub(super) fn end_viewer(&self, mut viewer: PartProcess, outcome: &Outcome) -> Option<PartProcess> {
        let may_stay = self.plan.output.is_some() && outcome.is_regular();
        let mut wait = self.wait();
        while viewer.ended().is_none() {
            if wait.is_over(VIEWER_LIMIT, HURRIED_LIMIT / 2) {
                if may_stay && !self.end.is_set() {
                    return Some(viewer);
                }
                viewer.kill();
            }
            std::thread::sleep(POLL_PERIOD);
        }
        None
    }

    fn tell_killed(&self, part: &PartProcess) {
        if self.has_begun && !self.end.is_urgent() {
            tell!("trabecula: {} did not end in time and was killed", part.name);
        }
    }

    /// Returns the outcome given how a part ended. A run with an unfinished log or missing last frames has
    /// failed even if all ticks were run; an interrupted run may lack frames.
    fn with_end_of(&self, name: &str, outcome: Outcome, parts: &mut [PartProcess]) -> Outcome {
        let expected = self.end.is_urgent() || (name == DRR && outcome == Outcome::Interrupted);
        let found = parts.iter_mut().find(|part| part.name == name);
        let Some(part) = found.filter(|_| !expected && outcome.death().is_none()) else { return outcome };
        if has_gap(part) || part.ended().is_none_or(|status| status.success()) {
            return outcome;
        }
        let died = judge(part, RunState::Open);
        died.death().iter().for_each(|death| tell!("trabecula: {death}"));
        died
    }

    /// Passes the end reason for the log to the recorder through a file in the session's folder, or in the
    /// run's folder if the former was removed.
    fn write_reason(&self, in_output: &mut Option<SavedFile>, outcome: &Outcome, parts: &[PartProcess]) {
        let reason = match outcome {
            Outcome::Completed => EndReason::Completed,
            Outcome::Stopped => EndReason::Stopped,
            Outcome::ControllerFailed(blame) => {
                let name = blame.controller.clone().unwrap_or_default();
                match blame.code {
                    EventCode::ControllerLate => EndReason::ControllerLate(name),
                    _ => EndReason::ControllerMissing(name),
                }
            }
            Outcome::SimulationFailed(text) => EndReason::SimulationFailed(text.clone()),
            Outcome::Interrupted => EndReason::Interrupted,
            Outcome::PartDied { name, .. } => EndReason::PartDied(name.clone()),
            // The end of a removed log is never read.
            Outcome::LogGone(_) => EndReason::LogMoved,
        };
        let reason = reason.text();
        let Some(output) = &self.plan.output else { return };
        if in_output.is_none() && self.host.write(reason_file::IN_SESSION, reason.as_bytes()).is_ok() {
            return;
        }
        let Some(recorder) = parts.iter().find(|part| part.name == RECORDER) else { return };
        // If neither folder works, the log's end names the launcher; exit code and message are still correct.
        if in_output.is_none() {
            *in_output = SavedFile::create(&reason_file::in_output(output, recorder.pid())).ok();
        }
        let _ = in_output.as_mut().map(|file| file.save(reason));
    }
}
