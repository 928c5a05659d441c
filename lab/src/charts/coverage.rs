//! `chart coverage`: studies with random true values; how often the 95 % intervals of `identify` hold
//! them, and the scatter of the estimates over the Cramér-Rao bound.
//!
//! Two benches: a tool in free space (stiffness, friction of the tendon, delay and registration of a
//! tracker), and the same tool in a hole in bone (friction of contact, cutting coefficient). Each study
//! draws its truth from its seed, simulates short noisy measurements, and fits them without knowing
//! either.

use std::fs;
use std::path::Path;

use counter_random::Key;
use serde_json::json;
use sim::SimError;
use sim::identification::{FitReport, OpenedStudy};
use trabecula::failure::Failure;

use crate::sheet::Sheet;

/// What to run.
#[derive(Debug, Clone, Copy)]
pub struct Plan {
    /// Studies of each bench.
    pub studies: u64,
    /// Seed of the first; the others follow.
    pub seed: u64,
    /// Whether to run the bench in free space.
    pub free: bool,
    /// Whether to run the bench in bone.
    pub bone: bool,
}

/// A parameter of a bench: key, range of the fit, range of the truth, step.
struct Unknown {
    key: &'static str,
    fit: [f64; 2],
    truth: [f64; 2],
    step: f64,
}

const fn unknown(key: &'static str, fit: [f64; 2], truth: [f64; 2], step: f64) -> Unknown {
    Unknown { key, fit, truth, step }
}

/// A bench.
struct Bench {
    name: &'static str,
    unknowns: &'static [Unknown],
    scene: &'static str,
    commands: &'static str,
    experiments: &'static str,
}

const FREE: Bench = Bench {
    name: "free space",
    unknowns: &[
        unknown("truth.manipulator.stiffness_scale", [0.5, 2.0], [0.8, 1.3], 1e-5),
        unknown("truth.manipulator.tendon_friction", [0.0, 0.4], [0.06, 0.18], 1e-5),
        unknown("measured.camera.delay_ms", [-10.0, 30.0], [2.0, 15.0], 1e-5),
        unknown("measured.camera.frame_mm.0", [-5.0, 5.0], [-2.0, 2.0], 1e-5),
    ],
    scene: r#"
name = "free"
[run]
mode = "lockstep"
duration_s = 0.3
[manipulator]
damping_ratio = 1.0
[tool]
burr_start_mm = [0.0, 0.0, 0.0]
direction = [0.0, 0.0, 1.0]
bend_toward = [1.0, 0.0, 0.0]
[[controller]]
name = "bench"
drives = ["tendon"]
external = true
"#,
    commands: "t,pull\n0,0\n0.02,5\n0.07,9\n0.12,4\n0.18,7\n0.24,2\n",
    experiments: r#"
[[experiment]]
name = "pull"
scene = "scene.toml"
time = "time_s"
file = "pull_camera.csv"
[experiment.commands]
file = "commands.csv"
time = "t"
column = [{ field = "tendon_force_n[0]", column = "pull", unit = "N" }]
[[experiment.measured]]
name = "camera"
of = "position"
frame = "start"
columns = ["x", "", "z"]
unit = "mm"
noise = 0.2
rate_hz = 250
"#,
};

const BONE: Bench = Bench {
    name: "bone",
    unknowns: &[
        unknown("truth.contact.friction", [0.05, 1.0], [0.15, 0.5], 1e-4),
        unknown("truth.drilling.cutting_coefficient", [0.8, 4.0], [1.2, 2.8], 5e-3),
    ],
    scene: r#"
name = "bone"
[run]
mode = "lockstep"
duration_s = 0.3
[volume]
phantom = "block"
spacing_mm = 0.5
block_density_ratio = 2.0
bone_threshold_hu = 150
[[predrill]]
from_mm = [0.0, 0.0, -60.0]
to_mm = [0.0, 0.0, -14.0]
diameter_mm = 7.0
[tool]
burr_start_mm = [0.0, 0.0, -17.0]
direction = [0.0, 0.0, 1.0]
bend_toward = [1.0, 0.0, 0.0]
[manipulator]
damping_ratio = 1.0
[truth]
[[controller]]
name = "bench"
drives = ["tendon", "arm", "burr"]
external = true
"#,
    commands: "t,pull,depth\n0,6,0.0015\n0.15,9,0.0028\n",
    experiments: r#"
[[experiment]]
name = "rub"
scene = "scene.toml"
time = "time_s"
file = "rub_flange.csv"
[experiment.commands]
file = "commands.csv"
time = "t"
arm_mode = "insert"
column = [
    { field = "tendon_force_n[0]", column = "pull", unit = "N" },
    { field = "arm_depth_m", column = "depth", unit = "m" },
    { field = "arm_speed_m_per_s", value = 0.01 },
    { field = "arm_axis[2]", value = 1.0 },
]
[[experiment.measured]]
name = "flange"
of = "flange_force"
columns = ["x", "y", "z"]
unit = "N"
noise = 0.3
rate_hz = 250

[[experiment]]
name = "drill"
scene = "scene.toml"
set = ["tool.burr_start_mm=[0.0, 0.0, -14.5]"]
time = "time_s"
file = "drill_flange.csv"
[experiment.commands]
file = "commands.csv"
time = "t"
arm_mode = "insert"
column = [
    { field = "tendon_force_n[0]", value = 1.0 },
    { field = "arm_depth_m", value = 0.004 },
    { field = "arm_speed_m_per_s", value = 0.008 },
    { field = "arm_axis[2]", value = 1.0 },
    { field = "burr_speed_rad_per_s", value = 800.0 },
]
[[experiment.measured]]
name = "flange"
of = "flange_force"
columns = ["x", "y", "z"]
unit = "N"
noise = 0.3
rate_hz = 250
"#,
};

/// What the studies of a bench add up to, for one parameter.
#[derive(Debug, Clone, Copy, Default)]
struct Tally {
    held: u64,
    /// Sum of squares of error over standard deviation.
    square: f64,
}

impl Bench {
    fn parameters(&self) -> String {
        let text = |it: &Unknown| {
            let [min, max] = it.fit;
            // The middle of what is possible, as an experimenter would begin with nominal values.
            let start = 0.5 * (it.truth[0] + it.truth[1]);
            let Unknown { key, step, .. } = it;
            format!(
                "[[parameter]]\nkey = \"{key}\"\nmin = {min:?}\nmax = {max:?}\nstep = {step:?}\nstart = {start:?}\n"
            )
        };
        self.unknowns.iter().map(text).collect()
    }

    /// Simulates and fits a study; returns the truth and the result.
    fn study(&self, seed: u64, folder: &Path) -> Result<(Vec<f64>, FitReport), SimError> {
        let draw = |(index, unknown): (u64, &Unknown)| {
            let [low, high] = unknown.truth;
            low + Key::of(seed).uniform(index) * (high - low)
        };
        let truth: Vec<f64> = (0..).zip(self.unknowns).map(draw).collect();
        let write = |name: &str, text: &str| fs::write(folder.join(name), text).map_err(Failure::failed);
        write("scene.toml", self.scene)?;
        write("commands.csv", self.commands)?;
        let fitted = format!("seed = {seed}\n{}{}", self.parameters(), self.experiments);
        // The true values are settings of the scenes, or the sensor's own delay.
        let mut settings: Vec<String> = Vec::new();
        let mut experiments = self.experiments.to_owned();
        for (unknown, value) in self.unknowns.iter().zip(&truth) {
            let own = match unknown.key.strip_prefix("measured.camera.") {
                Some("delay_ms") => format!("delay_ms = {value:?}\nnoise = "),
                Some(_) => format!("frame_mm = [{value:?}, 0.0, 0.0]\nnoise = "),
                None => {
                    settings.push(format!("{}={value:?}", unknown.key));
                    continue;
                }
            };
            experiments = experiments.replace("noise = ", &own);
        }
        let set = toml::Value::from(settings);
        write("study.toml", &format!("seed = {seed}\nset = {set}\n{}{experiments}", self.parameters()))?;
        let file = folder.join("study.toml");
        for made in OpenedStudy::open_without_measurements(&file)?.simulate(folder, &|| false)? {
            write(&made.name, &made.csv)?;
        }
        write("study.toml", &fitted)?;
        Ok((truth, OpenedStudy::open(&file)?.identify(&|| false)?))
    }

    fn run(&self, plan: &Plan, sheet: &mut Sheet) -> Result<u64, Failure> {
        let folder = tempfile::tempdir().map_err(Failure::failed)?;
        let mut tallies = vec![Tally::default(); self.unknowns.len()];
        for number in 0..plan.studies {
            let failed =
                |error: SimError| Failure::failed(format!("study {number} in {}: {error}", self.name));
            let (truth, report) = self.study(plan.seed + number, folder.path()).map_err(failed)?;
            for ((tally, it), truth) in tallies.iter_mut().zip(&report.parameters).zip(truth) {
                let [low, high] = it.interval;
                tally.held += u64::from(low <= truth && truth <= high);
                let deviation = it.sd.map_or(0.0, |sd| (it.value - truth) / sd);
                tally.square += deviation * deviation;
            }
        }
        let mut outside = 0;
        for (unknown, tally) in self.unknowns.iter().zip(tallies) {
            let share = 100.0 * tally.held as f64 / plan.studies as f64;
            let scatter = (tally.square / plan.studies as f64).sqrt();
            let text = format!("{share:.1} % of the intervals, scatter {scatter:.3} of the bound");
            let figures = json!({"studies": plan.studies, "coverage_percent": share, "scatter": scatter});
            sheet.row(unknown.key, &text, unknown.key, figures);
            outside += u64::from(!(92.0..=98.0).contains(&share));
        }
        Ok(outside)
    }
}

/// Runs the studies; returns the number of parameters whose coverage lies outside 92 to 98 %.
///
/// # Errors
/// A study that cannot be simulated or fitted.
pub fn run(plan: &Plan, sheet: &mut Sheet) -> Result<u64, Failure> {
    let benches = [(plan.free, FREE), (plan.bone, BONE)];
    let mut chosen = benches.iter().filter(|(is_chosen, _)| *is_chosen);
    chosen.try_fold(0, |outside, (_, bench)| Ok(outside + bench.run(plan, sheet)?))
}
