//! FMUs run by our master: our own of both versions, and one built by PythonFMU3.

#![allow(clippy::unwrap_used, clippy::panic, missing_docs, reason = "tests fail")]

use std::path::{Path, PathBuf};
use std::process::Command as Program;

use messages::{Command, TendonMode};
use sim::{Drive, SharedScene, Sim};
use tempfile::TempDir;
use test_support::limited::Limited;
use test_support::python;
use test_support::scenes::TOOL;
use trabecula_fmu::master::{Archived, Master, preload};
use trabecula_fmu::{Version, export};

const RUN: &str = "name = \"a\"\nrun = { mode = \"lockstep\", duration_s = 0.2 }\n";

fn library() -> PathBuf {
    std::env::current_exe().unwrap().parent().unwrap().join("libtrabecula_fmu.so")
}

fn loaded(file: &Path, folder: &TempDir) -> (Archived, Master) {
    let archived = Archived::read(file).unwrap();
    let place = folder.path().join("extracted");
    std::fs::create_dir(&place).unwrap();
    archived.extract(&place).unwrap();
    let master = Master::new(&archived, &place).unwrap();
    (archived, master)
}

#[test]
fn our_own_fmus_step_as_the_simulation() {
    for version in [Version::Two, Version::Three] {
        let folder = tempfile::tempdir().unwrap();
        let scene = folder.path().join("scene.toml");
        std::fs::write(&scene, format!("{RUN}{TOOL}")).unwrap();
        let shared = SharedScene::load(Some(&scene), &[], None).unwrap();
        let file = folder.path().join("a.fmu");
        let fmu = export::fmu(&shared, &Drive::Nothing, version, &library()).unwrap();
        std::fs::write(&file, fmu.bytes).unwrap();
        let (archived, master) = loaded(&file, &folder);
        let variable = |name: &str| archived.model.variable(name).unwrap();
        assert_eq!(archived.model.step_s, Some(1e-3));
        master.enter_initialisation().unwrap();
        master.exit_initialisation().unwrap();
        let mut command = Command { burr_mode: 1, burr_speed_rad_per_s: 300.0, ..Command::zeroed() };
        master.set(variable("test.burr_mode"), 1.0).unwrap();
        master.set(variable("test.burr_speed_rad_per_s"), 300.0).unwrap();
        // Arrays are single variables of FMI 2.0.
        if version == Version::Two {
            command.tendon_mode = TendonMode::ServoJf.code();
            command.tendon_force_n[0] = 4.0;
            master.set(variable("test.tendon_mode"), 1.0).unwrap();
            master.set(variable("test.tendon_force_n[0]"), 4.0).unwrap();
        }
        let mut sim = Sim::new(&shared, &Drive::Nothing).unwrap();
        for tick in 0..50 {
            master.step(f64::from(tick) * 1e-3, 1e-3).unwrap();
            sim.step(&[command], 1).unwrap();
        }
        let bend_rad = master.get(variable("state.bend_rad")).unwrap();
        assert_eq!(bend_rad, sim.state().bend_rad, "{version:?}");
        assert_eq!(master.get(variable("state.burr_speed_rad_per_s")).unwrap(), 300.0);
        assert_eq!(bend_rad > 0.01, version == Version::Two);
        let error = master.step(0.05, 0.4e-3).unwrap_err().to_string();
        assert!(error.contains("whole number of ticks"), "the FMU's own message: {error}");
        let error = master.set(variable("state.bend_rad"), 1.0).unwrap_err().to_string();
        assert!(error.contains("it is an output"), "{error}");
    }
}

#[test]
fn an_fmu_of_pythonfmu3_controls() {
    let packages = ["pythonfmu3==0.3.4"];
    let Some(python) = python::or_skip("pythonfmu3-1", &packages, "pythonfmu3") else { return };
    let folder = tempfile::tempdir().unwrap();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/pi.py");
    let mut build = Program::new(&python);
    build.args(["-m", "pythonfmu3", "build", "-f"]).arg(script).arg("-d").arg(folder.path());
    let output = build.limited_output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    // Its library takes Python's functions from the process.
    let Some(library) = python::shared_library(&python) else { return };
    preload(&library).unwrap();
    let (archived, master) = loaded(&folder.path().join("Pi.fmu"), &folder);
    let variable = |name: &str| archived.model.variable(name).unwrap();
    master.set(variable("gain"), 6.0).unwrap();
    master.enter_initialisation().unwrap();
    master.exit_initialisation().unwrap();
    let mut sum = 0.0;
    for step in 0..100 {
        let y = 0.002 * f64::from(step);
        master.set(variable("y"), y).unwrap();
        master.step(f64::from(step) * 1e-3, 1e-3).unwrap();
        let error = 0.3 - y;
        sum += error * 1e-3;
        let expected = (6.0 * error + 20.0 * sum).clamp(0.0, 20.0);
        assert_eq!(master.get(variable("u")).unwrap(), expected, "step {step}");
    }
}

#[test]
fn what_is_no_fmu_for_this_machine_is_refused_without_running_it() {
    let of = |bytes: Vec<u8>| Archived::of(bytes).unwrap_err().to_string();
    assert!(of(Vec::new()).contains("not a ZIP archive"));
    assert!(of(b"PK\x05\x06".to_vec()).contains("not a ZIP archive"));
    assert!(of([&b"PK\x05\x06"[..], &[0; 18]].concat()).contains("no modelDescription.xml"));
}

/// Regression: `fmu drive /dev/zero` filled the memory.
#[test]
fn an_endless_file_is_refused() {
    let refused = Archived::read(Path::new("/dev/zero")).unwrap_err().to_string();
    assert!(refused.contains("/dev/zero") && refused.contains("not a regular file"), "{refused}");
}
