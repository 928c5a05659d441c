//! Cost of the recorder for the physics: the same real-time run with and without it, alternating.

use std::path::Path;

use ipc_types::messages::TickTiming;
use ipc_types::process::EndRequest;
use ipc_types::scene::{Mode, Scene};

use serde_json::json;

use super::samples::{Samples, median};
use super::{complete_run, failed};
use crate::sheet::Sheet;
use trabecula::failure::Failure;
use trabecula::launcher::hub::View;
use trabecula::launcher::run::{RunPlan, RunSnapshot};
use trabecula::launcher::volume_source::VolumeFiles;
use trabecula::machine::Machine;
use trabecula::scenes::SceneSource;

/// Physics timings of all runs of one kind.
#[derive(Debug, Default)]
pub(super) struct Physics {
    step: Samples,
    publish: Samples,
    late: Samples,
    ticks: u64,
    missed: u64,
    /// Median of each run.
    step_p50_us: Vec<f64>,
    late_p50_us: Vec<f64>,
}

impl Physics {
    fn add(&mut self, timing: &TickTiming) {
        self.step.add(timing.step_ns);
        self.publish.add(timing.publish_ns);
        self.late.add(timing.wake_lateness_ns.unsigned_abs());
        self.ticks += 1;
        self.missed += u64::from(timing.missed);
    }

    /// `name` is `with` or `without`, and is the prefix of the keys.
    fn tell(&self, name: &str, sheet: &mut Sheet) {
        let key = |of: &str| format!("{name}_{of}");
        sheet.samples(&format!("{name}: physics step"), &key("step"), &self.step);
        sheet.samples(&format!("{name}: hash and publish"), &key("publish"), &self.publish);
        sheet.samples(&format!("{name}: wake-up behind the deadline"), &key("lateness"), &self.late);
        let (missed, ticks) = (self.missed, self.ticks);
        let figures = json!({"missed": missed, "ticks": ticks});
        sheet.row(&format!("{name}: missed ticks"), &format!("{missed} of {ticks}"), &key("ticks"), figures);
    }
}

/// Runs the scene in real time for `seconds`, `rounds` times, alternately without and with a recorder.
///
/// # Errors
/// An invalid scene (2); a run that fails.
pub fn run(scene: &SceneSource, seconds: f64, rounds: usize, sheet: &mut Sheet) -> Result<(), Failure> {
    let recorded = |scene: &Scene, end: &EndRequest, with: &mut Physics| {
        let folder = tempfile::tempdir_in(".").map_err(failed)?;
        one(scene, Some(folder.path()), None, end, with)?;
        Ok(std::fs::metadata(folder.path().join("run.mcap")).map_err(failed)?.len())
    };
    let scene = scene.load()?;
    let bytes = in_turn("a recorder", [scene.clone(), scene], seconds, rounds, recorded, sheet)?;
    let megabytes = bytes * 1e-6;
    let text = format!("{megabytes:.1} MB per run, {:.2} MB/s", megabytes / seconds);
    sheet.row("run.mcap", &text, "run_mcap_bytes", json!(bytes));
    Ok(())
}

/// Runs two scenes in real time, alternating, without and with a part, and prints both and their ratios.
/// `run_with` performs one run of the second and returns a count; returns the mean count per run.
///
/// # Errors
/// A run that fails.
pub(super) fn in_turn(
    what: &str,
    mut scenes: [Scene; 2],
    seconds: f64,
    rounds: usize,
    mut run_with: impl FnMut(&Scene, &EndRequest, &mut Physics) -> Result<u64, Failure>,
    sheet: &mut Sheet,
) -> Result<f64, Failure> {
    for scene in &mut scenes {
        scene.run.mode = Mode::Realtime;
        scene.run.duration_s = seconds;
    }
    let [scene, scene_with] = scenes;
    let end = EndRequest::install().map_err(failed)?;
    let machine = Machine::watch();
    let (mut without, mut with) = (Physics::default(), Physics::default());
    let mut count = 0;
    for _ in 0..rounds {
        one(&scene, None, None, &end, &mut without)?;
        count += run_with(&scene_with, &end, &mut with)?;
    }
    sheet.line(&format!(
        "scene {}, {rounds} rounds of {seconds} s in real time, each without and with {what}\n",
        scene.name
    ));
    sheet.set("scene", json!(scene.name));
    without.tell("without", sheet);
    with.tell("with", sheet);
    let ratio =
        |a: &[f64], b: &[f64]| median(&a.iter().zip(b).map(|(a, b)| a / b.max(1e-9)).collect::<Vec<f64>>());
    let step = ratio(&with.step_p50_us, &without.step_p50_us);
    let name = "step, with / without (median of p50 ratios)";
    sheet.row(name, &format!("{step:.3}"), "step_ratio", json!(step));
    let late = ratio(&with.late_p50_us, &without.late_p50_us);
    let name = "wake-up, with / without (median of p50 ratios)";
    sheet.row(name, &format!("{late:.3}"), "lateness_ratio", json!(late));
    sheet.machine(&machine);
    Ok(count as f64 / rounds.max(1) as f64)
}

/// Performs one run, optionally recorded to a folder and shown at a port; returns the number of X-ray frames.
pub(super) fn one(
    scene: &Scene,
    output: Option<&Path>,
    view: Option<View>,
    end: &EndRequest,
    all: &mut Physics,
) -> Result<u64, Failure> {
    one_seen(scene, output, view, end, all, |_| {})
}

/// Same; `see` is called with the run at every update.
pub(super) fn one_seen(
    scene: &Scene,
    output: Option<&Path>,
    view: Option<View>,
    end: &EndRequest,
    all: &mut Physics,
    mut see: impl FnMut(&RunSnapshot),
) -> Result<u64, Failure> {
    let plan = RunPlan {
        scene: scene.clone(),
        output: output.map(Path::to_owned),
        view,
        volume_files: VolumeFiles::default(),
    };
    let mut this = Physics::default();
    let mut frames = 0;
    complete_run(&plan, end, |snapshot| {
        see(snapshot);
        frames = snapshot.frames;
        snapshot.timings.iter().for_each(|timing| {
            this.add(timing);
            all.add(timing);
        });
    })?;
    all.step_p50_us.push(this.step.quantile_us(0.5));
    all.late_p50_us.push(this.late.quantile_us(0.5));
    Ok(frames)
}
