//! What the recorder costs the physics: the same real-time run with and without it, alternating.

use std::path::Path;

use ipc_types::messages::TickTiming;
use ipc_types::process::EndRequest;
use ipc_types::scene::{Mode, Scene};

use super::samples::{Samples, median};
use super::{complete_run, failed, row};
use trabecula::failure::Failure;
use trabecula::launcher::hub::View;
use trabecula::launcher::run::RunPlan;
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

    fn print(&self, name: &str) {
        row(&format!("{name}: physics step"), &self.step.line());
        row(&format!("{name}: hash and publish"), &self.publish.line());
        row(&format!("{name}: wake-up behind the deadline"), &self.late.line());
        row(&format!("{name}: missed ticks"), &format!("{} of {}", self.missed, self.ticks));
    }
}

/// Runs the scene in real time for `seconds`, `rounds` times, alternately without and with a recorder.
///
/// # Errors
/// An invalid scene (2); a run that fails.
pub fn run(scene: &SceneSource, seconds: f64, rounds: usize) -> Result<(), Failure> {
    let recorded = |scene: &Scene, end: &EndRequest, with: &mut Physics| {
        let folder = tempfile::tempdir_in(".").map_err(failed)?;
        one(scene, Some(folder.path()), None, end, with)?;
        Ok(std::fs::metadata(folder.path().join("run.mcap")).map_err(failed)?.len())
    };
    let scene = scene.load()?;
    in_turn("a recorder", [scene.clone(), scene], seconds, rounds, recorded, |bytes| {
        let megabytes = bytes * 1e-6;
        row("run.mcap", &format!("{megabytes:.1} MB a run, {:.2} MB/s", megabytes / seconds));
    })
}

/// Runs two scenes in real time, alternating, without and with something, and prints both and their ratios. `run_with`
/// makes one run of the second and returns a count; `tell` prints the mean count per run.
///
/// # Errors
/// A run that fails.
pub(super) fn in_turn(
    what: &str,
    mut scenes: [Scene; 2],
    seconds: f64,
    rounds: usize,
    mut run_with: impl FnMut(&Scene, &EndRequest, &mut Physics) -> Result<u64, Failure>,
    tell: impl FnOnce(f64),
) -> Result<(), Failure> {
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
    say!("scene {}, {rounds} rounds of {seconds} s in real time, each without and with {what}\n", scene.name);
    without.print("without");
    with.print("with");
    let ratio =
        |a: &[f64], b: &[f64]| median(&a.iter().zip(b).map(|(a, b)| a / b.max(1e-9)).collect::<Vec<f64>>());
    let line = format!("{:.3}", ratio(&with.step_p50_us, &without.step_p50_us));
    row("step, with / without (median of p50 ratios)", &line);
    let line = format!("{:.3}", ratio(&with.late_p50_us, &without.late_p50_us));
    row("wake-up, with / without (median of p50 ratios)", &line);
    tell(count as f64 / rounds.max(1) as f64);
    super::print_machine(&machine);
    Ok(())
}

/// One run, optionally recorded into a folder and shown at a port; returns the number of X-ray frames.
pub(super) fn one(
    scene: &Scene,
    output: Option<&Path>,
    view: Option<View>,
    end: &EndRequest,
    all: &mut Physics,
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
