//! Exported FMUs in other importers. In FMPy, that of the standard's own community: valid, with the hash of
//! the same simulation, and exact when a master rolls back. In libcosim and Ecos: the same course and hash.

#![allow(clippy::unwrap_used, clippy::panic, missing_docs, reason = "tests fail")]

use std::path::{Path, PathBuf};
use std::process::Command as Program;
use std::sync::Arc;

use messages::{Command, TendonMode};
use serde_json::{Value, json};
use sim::{Drive, SharedScene, Sim, View};
use tempfile::TempDir;
use test_support::limited::Limited;
use test_support::python;
use test_support::scenes::{BLOCK, OPEN_LOOP, TOOL, x_ray};
use trabecula_fmu::{Version, export};
use zerocopy::IntoBytes;

const RUN: &str = "name = \"a\"\nrun = { mode = \"lockstep\", duration_s = 0.2 }\n";

/// A block that a built-in controller drills under X-ray.
fn drill() -> String {
    let run = "name = \"drill\"\nrun = { mode = \"lockstep\", duration_s = 0.2, seed = 7 }\n";
    let encoder = "[[sensor]]\nname = \"encoder\"\nrate_hz = 200.0\nencoders = {}\n";
    [run, BLOCK, &x_ray(10.0, 48), encoder, OPEN_LOOP].concat()
}

const TICKS: u64 = 200;

struct Place(TempDir);

impl Place {
    fn new() -> Place {
        Place(tempfile::tempdir().unwrap())
    }

    fn scene(&self, text: &str) -> Arc<SharedScene> {
        let file = self.0.path().join("scene.toml");
        std::fs::write(&file, text).unwrap();
        SharedScene::load(Some(&file), &[], None).unwrap()
    }

    fn exported(&self, shared: &Arc<SharedScene>, version: Version) -> PathBuf {
        let file = self.0.path().join("a.fmu");
        let fmu = export::fmu(shared, &Drive::Nothing, version, &library()).unwrap();
        assert_eq!(fmu.outside, Vec::<String>::new());
        std::fs::write(&file, fmu.bytes).unwrap();
        file
    }
}

/// The library that cargo built with these tests.
fn library() -> PathBuf {
    let program = std::env::current_exe().unwrap();
    program.parent().unwrap().join("libtrabecula_fmu.so")
}

fn fmpy() -> Option<PathBuf> {
    python::or_skip("fmpy-1", &["FMPy==0.3.32", "numpy==2.4.6"], "fmpy")
}

fn checked(python: &Path, fmu: &Path, inputs: &Value, parameters: &Value) -> Value {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/fmpy_check.py");
    let mut program = Program::new(python);
    program.arg(script).arg(fmu).arg(TICKS.to_string()).arg(inputs.to_string()).arg(parameters.to_string());
    let output = program.limited_output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{text}\n{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_str(text.lines().last().unwrap()).unwrap()
}

fn hash(sim: &Sim) -> String {
    let [low, high] = sim.state().hash;
    format!("{high:016x}{low:016x}")
}

/// Checks what holds for every FMU.
fn assert_sound(found: &Value, expected: &Sim) {
    println!("{found}");
    assert_eq!(found["problems"], json!([]));
    for name in ["hash", "hash_after_refusals", "hash_after_rollback", "hash_after_reset_in_one_step"] {
        assert_eq!(found[name], hash(expected), "{name}");
    }
    for name in ["refuses_half_a_tick", "refuses_another_time", "refuses_unknown"] {
        assert_eq!(found[name], true, "{name}");
    }
    assert_eq!(found["bend_rad"], expected.state().bend_rad);
    assert_eq!(found["simulated_bend_rad"], expected.state().bend_rad);
}

fn pull() -> Command {
    let mut command = Command { tendon_mode: TendonMode::ServoJf.code(), ..Command::zeroed() };
    command.tendon_force_n = [4.0, 1.0, 0.0, 0.0];
    command
}

#[test]
fn a_master_drives_an_external_controllers_scene() {
    let Some(python) = fmpy() else { return };
    for version in [Version::Three, Version::Two] {
        let place = Place::new();
        let shared = place.scene(&format!("{RUN}{TOOL}"));
        let fmu = place.exported(&shared, version);
        let mut sim = Sim::new(&shared, &Drive::Nothing).unwrap();
        sim.step(&[pull()], TICKS).unwrap();
        // A field of four tendons has room for the tool's two.
        let inputs = json!({"test.tendon_mode": 1, "test.tendon_force_n": [4.0, 1.0]});
        let found = checked(&python, &fmu, &inputs, &json!({}));
        assert_sound(&found, &sim);
        assert_eq!(found["hash_after_serialisation"], hash(&sim));
        assert_eq!(found["refuses_damage"], true);
        let here = sim.snapshot();
        let bends = [3.99, 4.01].map(|tension_n| {
            sim.restore(&here).unwrap();
            let mut command = pull();
            command.tendon_force_n[0] = tension_n;
            sim.step(&[command], 1).unwrap();
            sim.state().bend_rad
        });
        let (slope, given) = ((bends[1] - bends[0]) / 0.02, found["derivative"].as_f64().unwrap());
        // The step is nearly linear in the tension; differences of 0.01 and 1e-4 N.
        assert!((given - slope).abs() < 1e-5 * slope.abs(), "{given} {slope}");
    }
}

#[test]
fn a_built_in_controller_drills_in_the_fmu_as_in_a_run() {
    let Some(python) = fmpy() else { return };
    for version in [Version::Three, Version::Two] {
        let place = Place::new();
        let shared = place.scene(&drill());
        let fmu = place.exported(&shared, version);
        let parameters = json!({"scene.run.seed": 9});
        let seeded = SharedScene::load(Some(&place.0.path().join("scene.toml")), &[], Some(9)).unwrap();
        let mut sim = Sim::new(&seeded, &Drive::Nothing).unwrap();
        sim.step(&[], TICKS).unwrap();
        let found = checked(&python, &fmu, &json!({}), &parameters);
        assert_sound(&found, &sim);
        assert_eq!(found["hash_after_serialisation"], hash(&sim));
        if version == Version::Three {
            let frame = sim.render(View::Scene).unwrap();
            assert_eq!(found["x_ray"][0], frame.pixels.as_bytes().len());
        }
    }
}

/// Steps an FMU in another importer; returns the bits of the bend after every step, and the hash.
fn stepped(python: &Path, importer: &str, fmu: &Path, [reals, whole_numbers]: [&Value; 2]) -> Value {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/other_importers.py");
    let mut program = Program::new(python);
    program.arg(script).arg(importer).arg(fmu).arg(TICKS.to_string());
    program.args([&reals.to_string(), &whole_numbers.to_string(), "state.bend_rad"]);
    let output = program.limited_output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{importer}: {text}\n{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_str(text.lines().last().unwrap()).unwrap()
}

/// Steps a simulation with the same command at every tick; returns what [`stepped`] must return.
fn expected(shared: &Arc<SharedScene>, commands: &[Command]) -> Value {
    let mut sim = Sim::new(shared, &Drive::Nothing).unwrap();
    let step = |_| {
        sim.step(commands, 1).unwrap();
        sim.state().bend_rad.to_bits()
    };
    let course: Vec<u64> = (0..TICKS).map(step).collect();
    json!({"course": course, "hash": hash(&sim)})
}

#[test]
fn other_importers_step_as_the_simulation() {
    let packages = ["libcosimpy==0.0.6", "ecospy==0.7.2", "tbb==2023.2.0", "fmuloader==0.1.2rc0"];
    let Some(python) = python::or_skip("importers-1", &packages, "libcosimpy") else { return };
    let place = Place::new();
    let shared = place.scene(&format!("{RUN}{TOOL}"));
    let fmu = place.exported(&shared, Version::Two);
    let pulled = expected(&shared, &[pull()]);
    let (elements, mode) = (
        json!({"test.tendon_force_n[0]": 4.0, "test.tendon_force_n[1]": 1.0}),
        json!({"test.tendon_mode": 1}),
    );
    for importer in ["libcosim", "ecos"] {
        assert_eq!(stepped(&python, importer, &fmu, [&elements, &mode]), pulled, "{importer}");
    }
    let fmu = place.exported(&shared, Version::Three);
    let array = json!({"test.tendon_force_n": [4.0, 1.0]});
    assert_eq!(stepped(&python, "fmuloader", &fmu, [&array, &mode]), pulled);
    // Ecos sets no arrays and reads no texts of FMI 3.0.
    let shared = place.scene(&drill());
    let fmu = place.exported(&shared, Version::Three);
    let found = stepped(&python, "ecos", &fmu, [&json!({}), &json!({})]);
    assert_eq!(found["course"], expected(&shared, &[])["course"]);
}

/// The same scene gives the same bytes.
#[test]
fn an_export_is_reproducible() {
    let place = Place::new();
    let shared = place.scene(&format!("{RUN}{TOOL}"));
    let [a, b] = [0, 1].map(|_| std::fs::read(place.exported(&shared, Version::Three)).unwrap());
    assert!(a == b);
}
