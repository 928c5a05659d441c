//! How late a real-time tick starts, alternating with `cyclictest` at the same period and priority on the
//! same cores.
//!
//! `cyclictest` (Debian package `rt-tests`) is the usual measure of a machine's timing: a thread that sleeps
//! until a deadline and records how late it wakes. It does not compute, read or publish anything, so any
//! additional lateness is the hub's. The wait strategy `event` sleeps in the same way; `hybrid` wakes early
//! and polls the clock.

use std::path::Path;
use std::process::Command;
use std::time::Duration;

use ipc_types::process::{EndRequest, Role};
use ipc_types::scene::{Mode, Policy, Scene, Wait};
use serde_json::json;

use super::samples::{Samples, median};
use super::{complete_run, failed, outside};
use crate::sheet::Sheet;
use trabecula::failure::Failure;
use trabecula::launcher::run::RunPlan;
use trabecula::launcher::volume_source::VolumeFiles;
use trabecula::machine::{Confinement, Machine};
use trabecula::scenes::SceneSource;
use trabecula::stress::load::Loads;
use trabecula::stress::plan::{Load, policy_name, wait_name};

/// Allowance for `cyclictest` to start and end on a busy machine.
const GRACE: Duration = Duration::from_secs(60);
/// Allowance for a run to start and end, for the competing load.
const RUN_GRACE: Duration = Duration::from_secs(120);
const QUANTILES: [(&str, f64); 3] = [("p50", 0.5), ("p99", 0.99), ("p99.9", 0.999)];
const WAITS: [Wait; 2] = [Wait::Event, Wait::Hybrid];

/// Settings of the measurement.
#[derive(Debug)]
pub struct Plan {
    /// Scene of the runs; unrecorded and in real time.
    pub scene: SceneSource,
    /// Numbers of cores.
    pub cores: Vec<usize>,
    /// Competing load on them.
    pub loads: Vec<Load>,
    /// Scheduling policy of physics and `cyclictest`.
    pub policy: Policy,
    /// Length of a run.
    pub seconds: f64,
    /// Number of rounds.
    pub rounds: usize,
    /// Seed of the competing load.
    pub seed: u64,
}

/// Measures every number of cores with every load.
///
/// # Errors
/// An invalid scene (2); no `cyclictest`, a priority that is not permitted, or a run that fails (1).
pub fn run(plan: &Plan, sheet: &mut Sheet) -> Result<(), Failure> {
    let mut scene = plan.scene.load()?;
    scene.run.mode = Mode::Realtime;
    scene.run.duration_s = plan.seconds;
    scene.run.policy = plan.policy;
    let end = EndRequest::install().map_err(failed)?;
    let machine = Machine::watch();
    let (name, policy) = (&scene.name, policy_name(plan.policy));
    sheet.line(&format!(
        "scene {name}, {policy}, {} rounds of {} s each, alternating with cyclictest; \
         lateness of a tick of {} ms\n",
        plan.rounds,
        plan.seconds,
        scene.dt_s() * 1e3
    ));
    sheet.set("scene", json!(name));
    sheet.set("policy", json!(policy));
    let folder = tempfile::tempdir_in(".").map_err(failed)?;
    for cores in &plan.cores {
        for load in &plan.loads {
            let _confined = Confinement::enter(*cores, None).map_err(failed)?;
            let each = Duration::from_secs_f64(plan.seconds) + RUN_GRACE;
            let limit = each * (plan.rounds * (1 + WAITS.len())) as u32;
            let _loads = Loads::start(*load, plan.seed, folder.path(), limit).map_err(failed)?;
            let mut setting = Setting::default();
            for _ in 0..plan.rounds {
                setting.round(&scene, folder.path(), &end)?;
            }
            setting.tell(*cores, *load, sheet);
        }
    }
    sheet.machine(&machine);
    Ok(())
}

/// Lateness on some cores with some load: per round, and of all rounds.
#[derive(Debug, Default)]
struct Setting {
    bare: Rounds,
    hub: [Rounds; WAITS.len()],
}

#[derive(Debug, Default)]
struct Rounds {
    all: Samples,
    each: Vec<Samples>,
}

impl Rounds {
    fn add(&mut self, samples: Samples) {
        self.all.append(&samples);
        self.each.push(samples);
    }

    /// Returns the median over the rounds of the ratio of this quantile to the other's.
    fn ratio_to(&self, other: &Rounds, fraction: f64) -> f64 {
        let of = |(mine, other): (&Samples, &Samples)| {
            mine.quantile_us(fraction) / other.quantile_us(fraction).max(1e-3)
        };
        median(&self.each.iter().zip(&other.each).map(of).collect::<Vec<f64>>())
    }
}

impl Setting {
    fn round(&mut self, scene: &Scene, folder: &Path, end: &EndRequest) -> Result<(), Failure> {
        self.bare.add(cyclictest(scene, folder)?);
        for (wait, rounds) in WAITS.into_iter().zip(&mut self.hub) {
            let mut scene = scene.clone();
            scene.run.wait = wait;
            rounds.add(ticks(&scene, end)?);
        }
        Ok(())
    }

    fn tell(&self, cores: usize, load: Load, sheet: &mut Sheet) {
        let plural = if cores == 1 { "" } else { "s" };
        let name = format!("{cores} core{plural}, load {load}");
        sheet.line(&format!("{name}: {:<26} {}", "cyclictest", self.bare.all.line()));
        let mut found = json!({"cores": cores, "load": load, "cyclictest": self.bare.all.figures()});
        for (wait, rounds) in WAITS.into_iter().zip(&self.hub) {
            let wait = wait_name(wait);
            let ratios = QUANTILES.map(|(name, fraction)| (name, rounds.ratio_to(&self.bare, fraction)));
            let told = ratios.map(|(name, ratio)| format!("{name} {ratio:.2}")).join(", ");
            sheet.line(&format!("{name}: {:<26} {}", format!("tick, wait {wait}"), rounds.all.line()));
            sheet.line(&format!("{name}: {:<26} {told} (medians of the rounds)", "  over cyclictest"));
            found[wait] = rounds.all.figures();
            found[format!("{wait}_over_cyclictest")] = json!(std::collections::BTreeMap::from(ratios));
        }
        sheet.push("settings", found);
    }
}

/// Returns the lateness of every tick of a run.
fn ticks(scene: &Scene, end: &EndRequest) -> Result<Samples, Failure> {
    let volume_files = VolumeFiles::default();
    let plan = RunPlan { scene: scene.clone(), output: None, view: None, volume_files };
    let mut late = Samples::default();
    complete_run(&plan, end, |snapshot| {
        snapshot.timings.iter().for_each(|timing| late.add(timing.wake_lateness_ns.unsigned_abs()));
    })?;
    Ok(late)
}

/// Returns the lateness of as many wake-ups of `cyclictest`.
fn cyclictest(scene: &Scene, folder: &Path) -> Result<Samples, Failure> {
    let priority = Role::Physics.priority(scene.run.policy);
    // `--default-system`: without a request to keep the processor awake, which the hub does not make either.
    let mut command = Command::new("nice");
    command.args(["-n", &priority.nice.to_string(), "cyclictest", "--default-system", "--mlockall"]);
    command.args(["--nsecs", "--verbose", "--interval", &(scene.dt_ns() / 1000).to_string()]);
    command.args(["--loops", &scene.tick_count().to_string()]);
    match priority.fifo {
        Some(fifo) => command.args(["--policy=fifo", "--priority", &fifo.to_string()]),
        None => command.arg("--policy=other"),
    };
    let limit = Duration::from_secs_f64(scene.run.duration_s) + GRACE;
    let said = outside::run(&mut command, folder, limit, "`bench lateness` needs it to start `cyclictest`")?;
    let late = parse(&said.out);
    if !said.status.success() || late.count() == 0 {
        return Err(Failure::failed(format!(
            "cyclictest ({}): {}; it is in the Debian package `rt-tests`, and a policy of fifo needs the \
             right to it (`trabecula doctor`)",
            said.status,
            said.report.trim()
        )));
    }
    Ok(late)
}

/// Returns the values of lines `thread: number: nanoseconds`.
fn parse(text: &str) -> Samples {
    let mut late = Samples::default();
    for line in text.lines() {
        let fields: Vec<&str> = line.split(':').map(str::trim).collect();
        if let [thread, number, value] = fields[..]
            && let (Ok(_), Ok(_), Ok(nanoseconds)) =
                (thread.parse::<u32>(), number.parse::<u64>(), value.parse::<i64>())
        {
            late.add(nanoseconds.unsigned_abs());
        }
    }
    late
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Output of `cyclictest` 2.40.
    #[test]
    fn values_are_read_and_other_lines_are_not() {
        let late = parse(
            "Max CPUs = 2\nThread 0 Interval: 1500\n       0:       0:   34273\n       0:     999:   18589\n",
        );
        assert_eq!(late.count(), 2);
        assert_eq!([0.0, 1.0].map(|fraction| late.quantile_us(fraction)), [18.589, 34.273]);
    }

    #[test]
    fn ratios_are_medians_over_the_rounds() {
        let rounds = |values: [u64; 3]| {
            let mut rounds = Rounds::default();
            for value in values {
                let mut samples = Samples::default();
                samples.add(value);
                rounds.add(samples);
            }
            rounds
        };
        assert_eq!(rounds([2000, 9000, 500]).ratio_to(&rounds([1000, 1000, 1000]), 0.5), 2.0);
    }
}
