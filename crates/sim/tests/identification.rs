//! Identification of scenes from files.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

use std::fs;
use std::path::{Path, PathBuf};

use sim::identification::{FitReport, OpenedStudy};
use tempfile::TempDir;

/// A tool in free space that a table of tensions drives.
const SCENE: &str = r#"
name = "bench"
[run]
mode = "lockstep"
duration_s = 0.6
[tool]
burr_start_mm = [0.0, 0.0, 0.0]
direction = [0.0, 0.0, 1.0]
bend_toward = [1.0, 0.0, 0.0]
[[controller]]
name = "bench"
drives = ["tendon"]
external = true
"#;

const COMMANDS: &str = "t,pull\n0,0\n0.05,4\n0.2,9\n0.35,3\n0.5,6\n";

const EXPERIMENT: &str = r#"
[[experiment]]
name = "pull"
scene = "scene.toml"
file = "pull_bend.csv"
time = "time_s"
[experiment.commands]
file = "commands.csv"
time = "t"
column = [{ name = "tension", field = "tendon_force_n[0]", column = "pull", unit = "N" }]
[[experiment.measured]]
name = "bend"
of = "bend"
columns = ["bend_deg"]
unit = "deg"
noise = 0.05
rate_hz = 200
"#;

fn parameter(key: &str, min: f64, max: f64) -> String {
    format!("[[parameter]]\nkey = \"{key}\"\nmin = {min:?}\nmax = {max:?}\n")
}

struct Bench {
    folder: TempDir,
}

impl Bench {
    /// Creates the files, with measurements of a scene that differs by `truth`.
    fn new(truth: &str, study: &str) -> Bench {
        let bench = Bench { folder: tempfile::tempdir().unwrap() };
        bench.write("scene.toml", &format!("{SCENE}\n{truth}"));
        bench.write("commands.csv", COMMANDS);
        bench.write("study.toml", study);
        let files = OpenedStudy::open_without_measurements(&bench.study()).unwrap();
        for file in files.simulate(bench.folder.path(), &|| false).unwrap() {
            bench.write(&file.name, &file.csv);
        }
        bench.write("scene.toml", SCENE);
        bench
    }

    fn write(&self, name: &str, text: &str) -> PathBuf {
        let path = self.folder.path().join(name);
        fs::write(&path, text).unwrap();
        path
    }

    fn study(&self) -> PathBuf {
        self.folder.path().join("study.toml")
    }

    fn read(&self, name: &str) -> String {
        fs::read_to_string(self.folder.path().join(name)).unwrap()
    }

    fn fit(&self) -> FitReport {
        OpenedStudy::open(&self.study()).unwrap().identify(&|| false).unwrap()
    }

    fn refusal(&self) -> String {
        match OpenedStudy::open(&self.study()) {
            Err(error) => error.to_string(),
            Ok(study) => study.identify(&|| false).unwrap_err().to_string(),
        }
    }
}

/// Estimates and true values, in standard deviations.
fn deviations(report: &FitReport, truth: &[f64]) -> Vec<f64> {
    let deviation =
        |(it, truth): (&sim::identification::ParameterReport, &f64)| (it.value - truth) / it.sd.unwrap();
    report.parameters.iter().zip(truth).map(deviation).collect()
}

/// Three parameters of tool and sensor. Four standard deviations: a probability of 2e-4 in all; the seed
/// is fixed.
#[test]
fn a_tools_parameters_are_recovered_from_noisy_rows_with_their_delay() {
    let study = [
        parameter("manipulator.stiffness_scale", 0.5, 2.0),
        parameter("manipulator.tendon_friction", 0.0, 0.3),
        parameter("measured.bend.delay_ms", 0.0, 20.0),
        EXPERIMENT.replace("rate_hz", "delay_ms = 7.0\nrate_hz"),
    ];
    let truth = "[truth.manipulator]\nstiffness_scale = 1.25\ntendon_friction = 0.08\n";
    let bench = Bench::new(truth, &study.concat());
    // The study does not tell the fit the true delay as its start.
    bench.write("study.toml", &study.concat().replace("delay_ms = 7.0\n", "delay_ms = 0.0\n"));
    let report = bench.fit();
    let found = deviations(&report, &[1.25, 0.08, 7.0]);
    assert!(found.iter().all(|x| x.abs() < 4.0), "{found:?} {report:?}");
    assert!(report.parameters[0].sd.unwrap() < 0.01 && report.parameters[2].sd.unwrap() < 1.0, "{report:?}");
    // With any delay up to 20 ms, the rows of the first 20 ms cannot all be compared.
    let others = report.cautions.iter().filter(|line| !line.contains("outside the simulated time"));
    assert!(report.undetermined.is_empty() && others.count() == 0, "{report:?}");
    assert!((0.7..1.3).contains(&report.reduced_chi_square), "{}", report.reduced_chi_square);
    let toml: toml::Table = report.toml.parse().unwrap();
    assert_eq!(toml["manipulator"]["stiffness_scale"].as_float(), Some(report.parameters[0].value));
    // The same again, bit for bit.
    assert_eq!(bench.fit(), report);
}

/// A plant that obeys 7.3 ms late. With the clock of the file free as well, only the sum of both shows.
#[test]
fn a_delay_of_the_commands_is_recovered_and_not_told_apart_from_the_clock() {
    let stiffness = parameter("manipulator.stiffness_scale", 0.5, 2.0);
    // Steps of two ticks: within a tick, a command is averaged and a reading interpolated.
    let delay = parameter("command.tension.delay_ms", 0.0, 20.0) + "step = 0.1\n";
    let clock = parameter("experiment.pull.clock_offset_s", -0.02, 0.02) + "step = 0.05\n";
    let damped = "name = \"pull\"\nset = [\"manipulator.damping_ratio=1.0\"]";
    let experiment = EXPERIMENT.replace("name = \"pull\"", damped);
    let late = experiment.replace("unit = \"N\"", "unit = \"N\", delay_ms = 7.3");
    let bench = Bench::new("", &[stiffness.as_str(), &delay, &late].concat());
    bench.write("study.toml", &[stiffness.as_str(), &delay, &experiment].concat());
    let report = bench.fit();
    let found = deviations(&report, &[1.0, 7.3]);
    assert!(found.iter().all(|x| x.abs() < 4.0), "{found:?} {:?}", report.parameters);
    assert!(report.parameters[1].sd.unwrap() < 0.5 && report.undetermined.is_empty(), "{report:?}");
    bench.write("study.toml", &[stiffness.as_str(), &delay, &clock, &experiment].concat());
    let said = bench.fit().undetermined.join("\n");
    let pair = "`command.tension.delay_ms` and `experiment.pull.clock_offset_s`";
    assert!(said.contains(pair), "{said}");
}

/// Six studies with random true values. Their 18 squared deviations add up to a χ² of 18 degrees of freedom:
/// 3.1 to 51.5 with a probability of 99.99 % (Wilson and Hilferty). The seeds are fixed; `trabecula-lab chart
/// coverage` runs hundreds.
#[test]
fn estimates_scatter_by_their_intervals() {
    let mut sum = 0.0;
    for seed in 0..6 {
        let uniform = |index| counter_random::Key::of(seed).uniform(index);
        let truth = [0.8 + 0.5 * uniform(0), 0.06 + 0.12 * uniform(1), 2.0 + 13.0 * uniform(2)];
        let head = format!("seed = {seed}\nset = [\"manipulator.damping_ratio=1.0\"]\n");
        let parameters = [
            parameter("manipulator.stiffness_scale", 0.5, 2.0),
            parameter("manipulator.tendon_friction", 0.0, 0.3),
            parameter("measured.bend.delay_ms", 0.0, 20.0),
        ];
        let study = |more: &str| {
            let short = EXPERIMENT.replace("name = \"pull\"", "name = \"pull\"\nduration_s = 0.3");
            [head.as_str(), &parameters.concat(), &short.replace("rate_hz", more)].concat()
        };
        let scene = format!(
            "[truth.manipulator]\nstiffness_scale = {:?}\ntendon_friction = {:?}\n",
            truth[0], truth[1]
        );
        let bench = Bench::new(&scene, &study(&format!("delay_ms = {:?}\nrate_hz", truth[2])));
        bench.write("study.toml", &study("rate_hz"));
        let found = deviations(&bench.fit(), &truth);
        sum += found.iter().map(|x| x * x).sum::<f64>();
    }
    assert!((3.1..51.5).contains(&sum), "{sum}");
}

#[test]
fn stiffness_and_the_gain_of_the_tension_are_not_told_apart_by_the_bend_alone() {
    let study = [
        parameter("manipulator.stiffness_scale", 0.5, 2.0),
        parameter("command.tension.gain", 0.5, 2.0),
        // Rows where the tool has settled: its vibration would tell stiffness from mass.
        EXPERIMENT.replace("rate_hz = 200", "rate_hz = 3.3333333").replace(
            "name = \"pull\"",
            "name = \"pull\"\nset = [\"manipulator.damping_ratio=1.0\"]\nduration_s = 0.9",
        ),
    ];
    let settling = |study: &str| {
        let bench = Bench::new("", study);
        bench.write("commands.csv", "t,pull\n0,2\n0.305,5\n0.605,8\n");
        let files = OpenedStudy::open_without_measurements(&bench.study()).unwrap();
        for file in files.simulate(bench.folder.path(), &|| false).unwrap() {
            bench.write(&file.name, &file.csv);
        }
        bench
    };
    let report = settling(&study.concat()).fit();
    let said = report.undetermined.join("\n");
    assert!(said.contains("`manipulator.stiffness_scale` and `command.tension.gain`"), "{report:?}");
    assert!(report.parameters.iter().all(|it| !it.is_determined && it.sd.is_none()), "{report:?}");

    // A load cell at the tendon tells them apart.
    let cell = "[[experiment.measured]]\nname = \"cell\"\nof = \"tendon_tension\"\ncolumns = [\"cell_n\"]\nunit = \"N\"\n\
                file = \"pull_cell.csv\"\nnoise = 0.05\nrate_hz = 3.3333333\n";
    let report = settling(&[study.concat().as_str(), cell].concat()).fit();
    assert!(report.undetermined.is_empty(), "{report:?}");
    let found = deviations(&report, &[1.0, 1.0]);
    assert!(found.iter().all(|x| x.abs() < 4.0), "{found:?}");
}

/// Data of the `full` model with half the step, fitted by `planar`: the bench says so, and the band of
/// the held-out rows covers them.
#[test]
fn a_wrong_model_shows_in_the_residuals_and_widens_the_band() {
    let held_out = EXPERIMENT
        .replace("name = \"pull\"", "name = \"other\"\nheld_out = true")
        .replace("pull_bend.csv", "other_bend.csv")
        .replace("commands.csv", "others.csv");
    let experiment = EXPERIMENT.replace("noise = 0.05", "noise = 0.002");
    let study = [
        parameter("manipulator.stiffness_scale", 0.5, 2.0),
        experiment,
        held_out.replace("noise = 0.05", "noise = 0.002"),
    ]
    .concat();
    let bench = Bench { folder: tempfile::tempdir().unwrap() };
    bench.write(
        "scene.toml",
        &format!("{SCENE}\n[manipulator]\nmodel = \"full\"\n").replace("[run]", "[run]\ndt_ms = 0.5"),
    );
    bench.write("commands.csv", COMMANDS);
    bench.write("others.csv", "t,pull\n0,0\n0.1,5\n0.3,8\n0.45,2\n");
    bench.write("study.toml", &study);
    let opened = OpenedStudy::open_without_measurements(&bench.study()).unwrap();
    for file in opened.simulate(bench.folder.path(), &|| false).unwrap() {
        bench.write(&file.name, &file.csv);
    }
    bench.write("scene.toml", SCENE);
    let report = bench.fit();
    assert!(report.cautions.iter().any(|line| line.contains("are not white")), "{:?}", report.cautions);
    let held_out =
        &report.experiments.iter().find(|it| it.role == "held_out").unwrap().measured[0].columns[0];
    let coverage = held_out.band.coverage.unwrap();
    assert!(held_out.band.model > 0.0 && coverage > 0.9, "{held_out:?}");
    // Both ways of computing the band that follows from the parameters agree, with 32 draws to a third.
    let (linear, sampled) = (held_out.band.linear, held_out.band.sampled.unwrap());
    assert!((sampled / linear - 1.0).abs() < 0.5, "{linear} {sampled}");
}

#[test]
fn bad_files_are_refused_with_experiment_sensor_and_reason() {
    let study = [parameter("manipulator.stiffness_scale", 0.5, 2.0), EXPERIMENT.to_owned()].concat();
    let bench = Bench::new("", &study);
    let original = bench.read("pull_bend.csv");
    let change = |from: &str, to: &str| {
        let changed = study.replacen(from, to, 1);
        assert_ne!(changed, study, "{from}");
        bench.write("study.toml", &changed);
        bench.refusal()
    };
    for (from, to, said) in [
        ("time = \"time_s\"", "time = \"time_s\"\nclock_offset_s = 100.0", "lies within the simulated time"),
        ("\"bend_deg\"", "\"bnd_deg\"", "no column `bnd_deg` (did you mean `bend_deg`?)"),
        ("manipulator.stiffness_scale", "manipulator.stiffnes_scale", "unknown field `stiffnes_scale`"),
        ("\"scene.toml\"", "\"none.toml\"", "none.toml"),
        (
            "file = \"commands.csv\"",
            "controller = \"other\"\nfile = \"commands.csv\"",
            "expected one of the scene's controllers: `bench`",
        ),
    ] {
        let error = change(from, to);
        assert!(error.contains(said), "{to}: {error}");
    }
    bench.write("study.toml", &study);
    bench.write("commands.csv", "t,pull\n0,0\n0.2,3\n0.1,4\n");
    assert!(bench.refusal().contains("row 3 of the commands is missing or before that of row 2"));
    bench.write("commands.csv", COMMANDS);
    bench.write("pull_bend.csv", "time_s,bend_deg\n0.1,\n0.2,NaN\n");
    assert!(bench.refusal().contains("all values in"), "{}", bench.refusal());
    bench.write("pull_bend.csv", &original);
    // 121 rows: the reduced chi-square scatters by 0.13.
    let report = bench.fit();
    assert!((0.5..1.5).contains(&report.reduced_chi_square), "{report:?}");
}

/// A parameter without effect, one pressed against its range, and rows beyond the simulation.
#[test]
fn what_deserves_attention_is_said() {
    let study = [
        parameter("manipulator.stiffness_scale", 1.1, 2.0),
        parameter("contact.friction", 0.1, 0.5),
        EXPERIMENT.replace("name = \"pull\"", "name = \"pull\"\nduration_s = 0.5"),
    ]
    .concat();
    let bench = Bench::new("", &study);
    let late = format!("{}9.0,1.0\n", bench.read("pull_bend.csv"));
    bench.write("pull_bend.csv", &late);
    let report = bench.fit();
    let said = report.cautions.join("\n");
    assert!(said.contains("`manipulator.stiffness_scale` is at its `min`, 1.1"), "{said}");
    assert!(said.contains("1 of 102 rows of `bend` lie outside the simulated time"), "{said}");
    assert!(report.undetermined.join("\n").contains("do not determine `contact.friction`"), "{report:?}");
}

/// Of two candidates, the one with ten times as many readings comes first, and both narrow the interval.
#[test]
fn candidates_are_ranked_by_their_information() {
    let candidate = |name: &str, rate: &str| {
        let planned = EXPERIMENT.replace("name = \"pull\"", &format!("name = \"{name}\"\ncandidate = true"));
        planned.replace("rate_hz = 200", rate)
    };
    let study = [
        parameter("manipulator.stiffness_scale", 0.5, 2.0),
        EXPERIMENT.to_owned(),
        candidate("few", "rate_hz = 20"),
        candidate("many", "rate_hz = 200"),
    ]
    .concat();
    let bench = Bench::new("", &study);
    let report = OpenedStudy::open(&bench.study()).unwrap().plan(&|| false).unwrap();
    assert_eq!(report.candidates[0].name, "many");
    // Twice the information: the interval shrinks by √2, to the rounding of equal times (1 %).
    let share = report.candidates[0].half_widths[0] / report.half_widths[0];
    assert!((share - 0.5_f64.sqrt()).abs() < 0.01, "{share}");
}

/// The commands of a log, its scene, and a topic of the log as the measurement: an exact fit.
#[test]
fn a_run_is_its_own_measurement() {
    let folder = tempfile::tempdir().unwrap();
    let scene = SCENE.replace("external = true", "[controller.hold]\ntension_n = 5.0");
    let file = folder.path().join("scene.toml");
    fs::write(&file, scene).unwrap();
    let settings = ["manipulator.stiffness_scale=1.4".to_owned()];
    let shared = sim::SharedScene::load(Some(Path::new(&file)), &settings, None).unwrap();
    let mut sim = sim::Sim::new(&shared, &sim::Drive::Nothing).unwrap();
    sim.record(&folder.path().join("run")).unwrap();
    sim.step(&[], 300).unwrap();
    sim.close_recording().unwrap();
    let study = parameter("manipulator.stiffness_scale", 0.5, 2.0)
        + "[[experiment]]\nname = \"run\"\nfile = \"run/run.mcap\"\ncommands = { log = \"run\" }\n\
           [[experiment.measured]]\nname = \"tip\"\nof = \"position\"\ntopic = \"/state\"\nunit = \"m\"\nnoise = 1e-6\n\
           columns = [\"t_world_tip.position_m[0]\", \"\", \"t_world_tip.position_m[2]\"]\n";
    fs::write(folder.path().join("study.toml"), study).unwrap();
    let opened = OpenedStudy::open(&folder.path().join("study.toml")).unwrap();
    let report = opened.identify(&|| false).unwrap();
    assert_eq!(report.residual_count, 2 * 301);
    // The scene of the log has this value, and the fit starts there.
    assert_eq!(report.parameters[0].start, 1.4);
    assert!((report.parameters[0].value - 1.4).abs() < 1e-9, "{report:?}");
    assert!(report.cost[1] < 1e-6, "{:?}", report.cost);
}

/// Regression: a scene whose bone a registration error moves took the volume of the scene loaded before
/// it, so sweeps and batches over the registration had no effect.
#[test]
fn a_moved_bone_is_not_shared_with_a_scene_that_has_it_elsewhere() {
    let load = |other: Option<&sim::SharedScene>, settings: &[&str]| {
        let block = [
            "volume.phantom=\"block\"",
            "volume.spacing_mm=1.0",
            "predrill=[]",
            "tool.burr_start_mm=[0.0, 0.0, -35.0]",
            "drr.isocentre_mm=[0.0, 0.0, 0.0]",
            "controller.0.curved_drilling.target_mm=[0.0, 0.0, 0.0]",
        ];
        let settings: Vec<String> =
            [&block[..], settings].concat().iter().map(|line| (*line).to_owned()).collect();
        sim::SharedScene::load_beside(other, None, &settings, None).unwrap()
    };
    let origin = |shared: &sim::SharedScene| shared.volume().unwrap().origin_m;
    let first = load(None, &[]);
    let moved = load(Some(&first), &["truth.registration_error_mm=[0.5, 0.0, 0.0]"]);
    assert!((origin(&moved)[0] - origin(&first)[0] - 0.5e-3).abs() < 1e-12);
    let again = load(Some(&moved), &["truth.registration_error_mm=[0.5, 0.0, 0.0]"]);
    assert!(std::sync::Arc::ptr_eq(again.ct().unwrap(), moved.ct().unwrap()));
    assert_eq!(origin(&load(Some(&moved), &[])), origin(&first));
}
