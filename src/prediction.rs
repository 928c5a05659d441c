//! Predicts a run: steps its scene in this process and compares the result with the plan.
//!
//! The physics and the built-in controllers are those of a run in lockstep, so the prediction of such a run
//! is its result, bit for bit. Controllers that are programs of the user are left out: the parts that they
//! drive stay as they start.

use std::sync::Arc;

use ipc_types::scene::Scene;
use run_log::hash_text;
use serde_json::{Value, json};
use sim::{Drive, SharedScene, Sim, SimError};
use simulation::planned_time_s;
use voxel_grid::Ct;

use crate::failure::Failure;
use crate::report::anatomy::Anatomy;
use crate::report::course::{Course, distance_m};
use crate::report::outcome::findings;

/// Ticks that are always simulated: a minute of 1 ms.
const WHOLE_TICKS: u64 = 60_000;
/// Largest number of ticks that is simulated: ten minutes of 1 ms.
const MOST_TICKS: u64 = 600_000;
/// Time at rest after the plan's end after which a long run is not simulated any further, s.
const REST_S: f64 = 10.0;
/// Ticks between checks whether to give up.
const LOOK_TICKS: u64 = 64;
/// Distance between points of the predicted path, m.
const STEP_M: f64 = 1e-4;

/// How far a run was predicted.
#[derive(Debug, Clone, PartialEq)]
pub enum Reach {
    /// To its end.
    Whole,
    /// Until nothing moved any more after the end of the plan.
    AtRest,
    /// To the largest number of ticks.
    Limited,
    /// Until the simulation failed; holds the reason.
    Failed(String),
}

/// A predicted run.
#[derive(Debug)]
pub struct Prediction {
    /// Its states, reduced as those of a run.
    pub course: Course,
    /// How far it was predicted.
    pub reach: Reach,
    /// Path of the burr's centre, world frame, m, up to the deepest insertion.
    pub path_m: Vec<[f64; 3]>,
    /// What is most likely wrong with it.
    pub findings: Vec<String>,
    /// What was left out.
    pub notes: Vec<String>,
    dt_s: f64,
}

impl Prediction {
    /// Predicts the run of a checked scene with its volume.
    ///
    /// # Errors
    /// A controller's calibration does not fit (2); out of memory (1).
    pub fn of(scene: &Scene, ct: Option<Arc<Ct>>) -> Result<Prediction, Failure> {
        Self::unless(scene, ct, &mut || false)
    }

    /// As [`Prediction::of`], but gives up once `is_to_end` returns true; the prediction then ends there.
    ///
    /// # Errors
    /// As [`Prediction::of`].
    pub fn unless(
        scene: &Scene,
        ct: Option<Arc<Ct>>,
        is_to_end: &mut dyn FnMut() -> bool,
    ) -> Result<Prediction, Failure> {
        let shared = SharedScene::new(scene, ct);
        let failure = |error: SimError| Failure::by_kind(!error.is_of_the_machine(), error);
        let mut sim = Sim::new(&shared, &Drive::Nothing).map_err(failure)?;
        let mut follower = Follower::new(scene, &sim);
        let reach = match follower.follow(scene, &mut sim, is_to_end) {
            Ok(reach) => reach,
            Err(error) if matches!(error, SimError::Physics { .. }) && !error.is_of_the_machine() => {
                Reach::Failed(error.to_string())
            }
            Err(error) => return Err(failure(error)),
        };
        let Follower { mut course, path_m, .. } = follower;
        if let Some(anatomy) = Anatomy::of(scene, shared.ct().map(|ct| &ct.volume)) {
            course.note_drilled(&anatomy, sim.drilled());
        }
        let mut found = findings(scene, &course);
        if let Reach::Failed(cause) = &reach {
            found.insert(0, format!("the simulation fails: {cause}"));
        }
        if reach == Reach::AtRest && sim.driven().is_empty() {
            let moved_s = course.plan().moved_until_tick as f64 * scene.dt_s();
            let run_s = scene.run.duration_s;
            found.push(format!("nothing moves after {moved_s:.0} s of a run of {run_s} s"));
        }
        let notes = notes(&sim.driven(), &reach, course.ticks as f64 * scene.dt_s());
        Ok(Prediction { course, reach, path_m, findings: found, notes, dt_s: scene.dt_s() })
    }

    /// Returns the findings as warnings about `source`, and the notes, one line each.
    pub fn lines(&self, source: &dyn std::fmt::Display) -> Vec<String> {
        let warning = |finding: &String| format!("warning: {source}: predicted: {finding}");
        let note = |note: &String| format!("{source}: {note}");
        self.findings.iter().map(warning).chain(self.notes.iter().map(note)).collect()
    }

    /// Returns what will happen, in lines.
    pub fn text(&self) -> String {
        let plan = self.course.plan();
        let mut lines = Vec::new();
        let mut row = |name: &str, text: String| lines.push(format!("{name:<13}{text}"));
        let seconds = |tick: u64| tick as f64 * self.dt_s;
        let moved_s = seconds(plan.moved_until_tick);
        row(
            "predicted",
            format!(
                "{:.3} s of simulated time; the tool moves until {moved_s:.3} s",
                seconds(self.course.ticks)
            ),
        );
        if let Some(tool) = self.course.tool()
            && let Some(error_mm) = tool.target_error_mm
        {
            row(
                "target",
                format!("{error_mm:.2} mm off at the deepest insertion, {:.1} deg bent", tool.bend_deg),
            );
        }
        if let Some((most_mm, at_mm)) = plan.path_deviation_mm.zip(plan.path_deviation_at_mm) {
            row("path", format!("up to {most_mm:.2} mm off the planned one, {at_mm:.1} mm along it"));
        }
        let radius = |mm: Option<f64>| mm.map_or("none".to_owned(), |mm| format!("{mm:.1} mm"));
        let [least, planned, possible] =
            [plan.least_radius_mm, plan.planned_radius_mm, plan.possible_radius_mm].map(radius);
        row("radius", format!("{least} at the tightest; planned {planned}, possible {possible}"));
        for (name, peak) in
            [("burr", plan.forces.burr), ("walls", plan.forces.walls), ("flange", plan.forces.flange)]
        {
            if peak.force_n > 0.0 {
                row(name, format!("up to {}", peak.text()));
            }
        }
        for structure in self.course.clearances.summaries() {
            if let Some(least_mm) = structure.least_clearance_mm {
                row("clearance", format!("{}: {least_mm:.2} mm at tick {}", structure.name, structure.tick));
            }
            if let Some(removed) = structure.removed_text() {
                row("removed", removed);
            }
        }
        let count = |count: u64| if count == 0 { "none".to_owned() } else { count.to_string() };
        row("stops", count(plan.protective_stops));
        let area = self.course.drilling().and_then(|drilling| drilling.breach_area_text());
        let area = area.map_or(String::new(), |text| format!("; {text}"));
        row("breaches", count(self.course.breach_count) + &area);
        lines.join("\n")
    }

    /// Returns the prediction as JSON.
    pub fn json(&self) -> Value {
        let reach = match &self.reach {
            Reach::Whole => "whole".to_owned(),
            Reach::AtRest => "at_rest".to_owned(),
            Reach::Limited => "limited".to_owned(),
            Reach::Failed(cause) => format!("failed: {cause}"),
        };
        json!({
            "reach": reach,
            "ticks": self.course.ticks,
            "simulated_s": self.course.ticks as f64 * self.dt_s,
            "final_hash": self.course.last.as_ref().map(|state| hash_text(state.hash)),
            "tool": self.course.tool(),
            "plan": self.course.plan(),
            "drilling": self.course.drilling(),
            "breaches": self.course.breaches,
            "structures": self.course.clearances.summaries(),
            "findings": self.findings,
            "notes": self.notes,
        })
    }
}

/// Follows a simulation.
struct Follower {
    course: Course,
    path_m: Vec<[f64; 3]>,
    deepest_tick: u64,
}

impl Follower {
    fn new(scene: &Scene, sim: &Sim) -> Follower {
        let spacing_m = sim.shared().volume().map(|volume| volume.spacing_m);
        let mut course = Course::of(scene, spacing_m);
        course.add(sim.state());
        sim.readings().iter().for_each(|reading| course.clearances.add(reading));
        Follower { course, path_m: vec![sim.state().t_world_burr.position_m], deepest_tick: 0 }
    }

    fn follow(
        &mut self,
        scene: &Scene,
        sim: &mut Sim,
        is_to_end: &mut dyn FnMut() -> bool,
    ) -> Result<Reach, SimError> {
        let commands = vec![ipc_types::messages::Command::zeroed(); sim.driven().len()];
        let (total, dt_s) = (scene.tick_count(), scene.dt_s());
        let rest_ticks = (REST_S / dt_s) as u64;
        let plan_ticks = ((planned_time_s(scene) / dt_s) as u64).saturating_add(rest_ticks);
        for tick in 1..=total.min(MOST_TICKS) {
            if tick.is_multiple_of(LOOK_TICKS) && is_to_end() {
                return Ok(Reach::Limited);
            }
            sim.step(&commands, 1)?;
            self.course.add(sim.state());
            self.course.note_breach(sim.breach());
            sim.readings().iter().for_each(|reading| self.course.clearances.add(reading));
            self.note_path(sim);
            let is_over = total > WHOLE_TICKS && tick > plan_ticks && tick.is_multiple_of(1000);
            if is_over && tick - self.course.plan().moved_until_tick > rest_ticks {
                return Ok(Reach::AtRest);
            }
        }
        Ok(if total > MOST_TICKS { Reach::Limited } else { Reach::Whole })
    }

    /// Adds the burr's place to the path, while the tool goes deeper.
    fn note_path(&mut self, sim: &Sim) {
        let deepest_tick = self.course.deepest.as_ref().map_or(0, |state| state.tick);
        let has_advanced = std::mem::replace(&mut self.deepest_tick, deepest_tick) != deepest_tick;
        let burr_m = sim.state().t_world_burr.position_m;
        let is_new = self.path_m.last().is_none_or(|last_m| distance_m(*last_m, burr_m) > STEP_M);
        if has_advanced && is_new {
            self.path_m.push(burr_m);
        }
    }
}

fn notes(left_out: &[String], reach: &Reach, simulated_s: f64) -> Vec<String> {
    let program = |name: &String| {
        format!(
            "controller `{name}` is not built in and was left out of the prediction: the parts that it drives stay as they start"
        )
    };
    let mut notes: Vec<String> = left_out.iter().map(program).collect();
    match reach {
        Reach::Limited => {
            notes.push(format!("the prediction ends after {simulated_s:.0} s of simulated time"))
        }
        Reach::AtRest => notes.push(format!(
            "the prediction ends after {simulated_s:.0} s of simulated time: nothing moves any more"
        )),
        Reach::Whole | Reach::Failed(_) => {}
    }
    notes
}
