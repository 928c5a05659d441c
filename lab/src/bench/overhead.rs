//! The hub's own overhead: a multi-process lockstep tick minus its physics step, alternating with a bare
//! ping-pong.

use ipc_types::messages::TickTiming;
use ipc_types::process::EndRequest;
use ipc_types::scene::{Mode, Scene};

use serde_json::json;

use super::ping_pong::{self, Wait};
use super::samples::{Samples, median};
use super::{complete_run, failed};
use crate::sheet::Sheet;
use trabecula::failure::Failure;
use trabecula::launcher::run::RunPlan;
use trabecula::launcher::volume_source::VolumeFiles;
use trabecula::machine::Machine;
use trabecula::scenes::SceneSource;

/// Breakdown of the time of lockstep ticks.
#[derive(Debug, Default)]
struct Ticks {
    whole: Samples,
    overhead: Samples,
    latch: Samples,
    step: Samples,
    publish: Samples,
    answer: Samples,
    /// The previous tick, which ends where the next one starts.
    last: Option<TickTiming>,
}

impl Ticks {
    /// Adds a tick's timing. Skips a tick whose successor's timing was lost.
    fn add(&mut self, timing: &TickTiming) {
        if let Some(last) = self.last.replace(*timing)
            && last.tick + 1 == timing.tick
        {
            let whole_ns = timing.start_ns.saturating_sub(last.start_ns);
            self.whole.add(whole_ns);
            self.overhead.add(whole_ns.saturating_sub(last.step_ns));
            self.latch.add(last.latch_ns);
            self.step.add(last.step_ns);
            self.publish.add(last.publish_ns);
            self.answer.add(timing.round_trip_ns[0]);
        }
    }

    fn append(&mut self, other: &Ticks) {
        self.whole.append(&other.whole);
        self.overhead.append(&other.overhead);
        self.latch.append(&other.latch);
        self.step.append(&other.step);
        self.publish.append(&other.publish);
        self.answer.append(&other.answer);
    }
}

/// Measures `rounds` times, alternating: `ticks` ticks of the scene, and as many round trips with each wait
/// strategy.
///
/// # Errors
/// An invalid scene (2); a run that fails.
pub fn run(scene: &SceneSource, ticks: u64, rounds: usize, sheet: &mut Sheet) -> Result<(), Failure> {
    let mut scene = scene.load()?;
    scene.run.mode = Mode::Lockstep;
    scene.run.duration_s = ticks as f64 * scene.dt_s();
    let end = EndRequest::install().map_err(failed)?;
    let machine = Machine::watch();
    let (mut all, mut hybrid, mut yielding) = (Ticks::default(), Samples::default(), Samples::default());
    let (mut to_hybrid, mut to_yield) = (Vec::new(), Vec::new());
    for _ in 0..rounds {
        let round = run_ticks(&scene, &end)?;
        let bare_hybrid = ping_pong::measure(Wait::Hybrid, ticks as usize)?;
        let bare_yield = ping_pong::measure(Wait::Yield, ticks as usize)?;
        let overhead_us = round.overhead.quantile_us(0.5);
        to_hybrid.push(overhead_us / bare_hybrid.quantile_us(0.5));
        to_yield.push(overhead_us / bare_yield.quantile_us(0.5));
        all.append(&round);
        hybrid.append(&bare_hybrid);
        yielding.append(&bare_yield);
    }
    sheet.line(&format!(
        "scene {}, {rounds} rounds of {ticks} ticks in lockstep, each followed by plain ping-pongs\n",
        scene.name
    ));
    sheet.set("scene", json!(scene.name));
    sheet.samples("lockstep tick over processes", "tick", &all.whole);
    sheet.samples("  latch and publish u_k", "latch", &all.latch);
    sheet.samples("  physics step", "step", &all.step);
    sheet.samples("  publish x_k+1", "publish", &all.publish);
    sheet.samples("  state published to command received", "answer", &all.answer);
    sheet.samples("overhead: tick minus physics step", "overhead", &all.overhead);
    sheet.samples("plain ping-pong, waiting like the hub", "ping_pong_hybrid", &hybrid);
    sheet.samples("plain ping-pong, always yielding", "ping_pong_yield", &yielding);
    let name = "overhead / ping-pong waiting like the hub";
    sheet.row(name, &ratio_line(&to_hybrid), "overhead_to_hybrid_by_round", json!(to_hybrid));
    let name = "overhead / ping-pong always yielding";
    sheet.row(name, &ratio_line(&to_yield), "overhead_to_yield_by_round", json!(to_yield));
    sheet.machine(&machine);
    Ok(())
}

fn ratio_line(ratios: &[f64]) -> String {
    let each: Vec<String> = ratios.iter().map(|ratio| format!("{ratio:.2}")).collect();
    format!("{:.2} (median of the rounds' p50 ratios: {})", median(ratios), each.join(", "))
}

fn run_ticks(scene: &Scene, end: &EndRequest) -> Result<Ticks, Failure> {
    let plan =
        RunPlan { scene: scene.clone(), output: None, view: None, volume_files: VolumeFiles::default() };
    let mut ticks = Ticks::default();
    complete_run(&plan, end, |glance| glance.timings.iter().for_each(|timing| ticks.add(timing)))?;
    Ok(ticks)
}
