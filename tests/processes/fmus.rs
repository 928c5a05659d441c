//! Controllers and parts of the plant that are FMUs: checked without running them, at their own steps, and
//! replayed without them.

use std::path::{Path, PathBuf};
use std::process::Command;

use ipc_types::messages::{State, Tick};
use run_log::TickRecord;
use test_support::limited::Limited;
use test_support::python;
use trabecula_fmu::Archive;

use crate::common::logs::{Whole, assert_replays, read};
use crate::common::program::{Done, Place, Run, succeed, trabecula};

/// An FMU of `clients/fmu/bench/gain.c`. Its library leaves a file when it is loaded.
fn gain(place: &Place, loaded: &Path) -> PathBuf {
    let sources = Path::new(env!("CARGO_MANIFEST_DIR")).join("clients/fmu/bench");
    let (library, mark) = (place.path("gain.so"), place.path("mark.c"));
    let text = format!(
        "#include <stdio.h>\n__attribute__((constructor)) static void loaded(void) {{ \
         FILE *file = fopen({loaded:?}, \"w\"); if (file) fclose(file); }}\n"
    );
    std::fs::write(&mark, text).unwrap();
    let mut compiler = Command::new("cc");
    compiler.args([
        "-std=c11",
        "-Wall",
        "-Wextra",
        "-Werror",
        "-shared",
        "-fPIC",
        "-O2",
        "-ffp-contract=off",
    ]);
    let output = compiler.args([&sources.join("gain.c"), &mark]).arg("-o").arg(&library).limited_output();
    let output = output.unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let mut archive = Archive::default();
    let name = format!("binaries/{}-linux/gain.so", std::env::consts::ARCH);
    assert!(archive.add("modelDescription.xml", &std::fs::read(sources.join("gain.xml")).unwrap()));
    assert!(archive.add(&name, &std::fs::read(library).unwrap()));
    let file = place.path("gain.fmu");
    std::fs::write(&file, archive.finish().unwrap()).unwrap();
    file
}

const TICKS: u64 = 200;

/// One FMU pulls a tendon by the bend, another turns the burr by the load cell's readings.
const SCENE: &str = r#"
name = "fmus"
[run]
mode = "lockstep"
duration_s = 0.2
[tool]
burr_start_mm = [0.0, 0.0, 0.0]
direction = [0.0, 0.0, 1.0]
bend_toward = [1.0, 0.0, 0.0]
[[sensor]]
name = "cell"
rate_hz = 100.0
delay_ms = 3.0
load_cell = {}
[[controller]]
name = "bend"
drives = ["tendon"]
fmu = "gain.fmu"
inputs = { y = "bend_rad" }
outputs = { "tendon_force_n[0]" = "u" }
constants = { tendon_mode = 1 }
parameters = { goal = 2.0, gain = 3.0 }
step_ms = 2.0
[[controller]]
name = "burr"
drives = ["burr"]
fmu = "gain.fmu"
inputs = { y = "sensor.cell.value[0]" }
outputs = { burr_speed_rad_per_s = "u" }
constants = { burr_mode = 1 }
parameters = { goal = 30.0, gain = 10.0 }
step_ms = 5.0
"#;

/// The state that the commands of a tick answer.
fn answered(log: &Whole, tick: usize) -> &State {
    if tick == 0 { &log.initial } else { &log.ticks[tick - 1].state }
}

#[test]
fn fmus_step_at_their_own_rates_and_the_log_replays_without_them() {
    let place = Place::new();
    let fmu = gain(&place, &place.path("loaded"));
    let ended = place.complete(SCENE);
    let again = Run::start(&place.path("scene.toml"), place.path("again"), &[]).end_well();
    std::fs::remove_file(fmu).unwrap();
    let log = read(&ended.folder);
    assert_eq!(log.ticks.len() as u64, TICKS);
    let hash = |log: &Whole| log.ticks.last().unwrap().state.hash;
    assert_eq!(hash(&log), hash(&read(&again.folder)));
    assert_replays(&ended.folder);
    let (mut tension_n, mut speed_rad_per_s, mut cell_n) = (f64::NAN, f64::NAN, 0.0);
    let (mut tensions, mut speeds) = (Vec::new(), Vec::new());
    for (tick, TickRecord { latched, readings, .. }) in log.ticks.iter().enumerate() {
        let [bend, burr] = [0, 1].map(|index| &latched.commands[index].command);
        if tick % 2 == 0 {
            tension_n = 3.0 * (2.0 - answered(&log, tick).bend_rad);
            tensions.push(tension_n);
        }
        if tick % 5 == 0 {
            speed_rad_per_s = 10.0 * (30.0 - cell_n);
            speeds.push(speed_rad_per_s);
        }
        assert_eq!(bend.tendon_force_n[0], tension_n, "tick {tick}");
        assert_eq!(burr.burr_speed_rad_per_s, speed_rad_per_s, "tick {tick}");
        // These arrive with the state after this tick.
        for reading in readings {
            cell_n = reading.value[0];
        }
    }
    for values in [&mut tensions, &mut speeds] {
        values.dedup();
        assert!(values.len() >= 18, "they follow what they read: {values:?}");
    }
    assert_eq!(log.ticks[0].latched.tick, Tick::START.0);
}

/// A table breathes against the tool, and a ball hangs on a spring with a damper.
const PLANT: &str = r#"
name = "plant"
gravity_m_per_s2 = [0.0, 0.0, -9.81]
[run]
mode = "lockstep"
duration_s = 0.2
[tool]
burr_start_mm = [0.0, 0.0, 0.0]
direction = [0.0, 0.0, 1.0]
bend_toward = [1.0, 0.0, 0.0]
[[body]]
name = "table"
cuboid = { half_extents_mm = [2.0, 20.0, 20.0] }
motion = "driven"
position_mm = [6.0, 0.0, 0.0]
[[body]]
name = "ball"
ball = { radius_mm = 5.0 }
motion = "free"
position_mm = [100.0, 0.0, 0.0]
[[controller]]
name = "breath"
drives = ["body"]
body = "table"
fmu = "gain.fmu"
outputs = { "t_world_body_goal.position_m[0]" = "w" }
constants = { body_mode = 2, "t_world_body_goal.orientation_xyzw[3]" = 1.0 }
parameters = { goal = 0.006, amplitude = -0.002, rate = 30.0 }
[[controller]]
name = "spring"
drives = ["body"]
body = "ball"
fmu = "gain.fmu"
inputs = { y = "t_world_body[1].position_m[2]" }
outputs = { "body_wrench.force_n[2]" = "u" }
constants = { body_mode = 1 }
parameters = { goal = 0.005, gain = 10.0, damping = 0.05 }
"#;

#[test]
fn fmus_move_a_table_and_hold_a_ball_and_the_log_replays_without_them() {
    let place = Place::new();
    let fmu = gain(&place, &place.path("loaded"));
    let ended = place.complete(PLANT);
    let again = Run::start(&place.path("scene.toml"), place.path("again"), &[]).end_well();
    std::fs::remove_file(fmu).unwrap();
    let log = read(&ended.folder);
    assert_eq!(log.ticks.len() as u64, TICKS);
    let hash = |log: &Whole| log.ticks.last().unwrap().state.hash;
    assert_eq!(hash(&log), hash(&read(&again.folder)));
    assert_replays(&ended.folder);
    let note = "breath, spring: replays from the log of its outputs";
    let info = succeed(&[&"log", &"info", &ended.folder]).out;
    let figures = succeed(&[&"log", &"info", &ended.folder, &"--json"]).out;
    for text in [&ended.out, &info, &figures] {
        assert!(text.contains(note), "{text}");
    }
    // The FMUs' equations, and a ball that Rapier moves in four substeps.
    let dt_s = 1e-3;
    let (mut breath_m, mut breath_m_per_s) = (0.0, -0.002 * 30.0);
    let mass_kg = 1900.0 * 4.0 / 3.0 * std::f64::consts::PI * 0.005_f64.powi(3);
    let (mut ball_m, mut ball_m_per_s, mut last_m) = (0.0, 0.0, 0.0);
    let (mut worst_m, mut most_n) = (0.0_f64, 0.0_f64);
    for (tick, TickRecord { latched, state, .. }) in log.ticks.iter().enumerate() {
        breath_m_per_s -= 30.0 * 30.0 * breath_m * dt_s;
        breath_m += breath_m_per_s * dt_s;
        assert_eq!(state.t_world_body[0].position_m, [0.006 + breath_m, 0.0, 0.0], "tick {tick}");
        let y = answered(&log, tick).t_world_body[1].position_m[2];
        let rate = (y - last_m) / dt_s;
        let force_n = 10.0 * (0.005 - y) - 0.05 * rate;
        last_m = y;
        assert_eq!(latched.commands[1].command.body_wrench.force_n[2], force_n, "tick {tick}");
        for _ in 0..4 {
            ball_m_per_s += (force_n / mass_kg - 9.81) * 0.25 * dt_s;
            ball_m += ball_m_per_s * 0.25 * dt_s;
        }
        worst_m = worst_m.max((state.t_world_body[1].position_m[2] - ball_m).abs());
        most_n = most_n.max(state.wrench_on_body[0].force_n[0]);
    }
    println!("the ball within {worst_m:.1e} m of its equations, the tool on the table up to {most_n:.3} N");
    assert!(worst_m < 1e-9 && most_n > 0.05, "{worst_m:e} m, {most_n} N");
}

fn check(place: &Place, text: &str) -> Done {
    trabecula(&[&"scene", &"check", &place.scene(text)])
}

#[test]
fn a_scene_is_checked_without_running_code_of_its_fmus() {
    let place = Place::new();
    let loaded = place.path("loaded");
    let fmu = gain(&place, &loaded);
    let done = check(&place, SCENE);
    assert_eq!(done.code, Some(0), "{}", done.err);
    assert!(!loaded.exists());
    let cases = [
        ("\"gain.fmu\"", "\"absent.fmu\"", "absent.fmu"),
        ("\"gain.fmu\"", "\"scene.toml\"", "scene.toml: not a ZIP archive"),
        (
            "{ y = \"bend",
            "{ z = \"bend",
            "`controller.inputs`: the FMU has no input `z`; expected one of [\"y\"]",
        ),
        ("{ y = \"bend", "{ u = \"bend", "`controller.inputs`: `u` has the causality output; expected input"),
        ("\"bend_rad\"", "\"bent_rad\"", "State has no field 'bent_rad' (did you mean 'bend_rad'?)"),
        ("\"bend_rad\"", "\"joint_position_rad\"", "`joint_position_rad` has several elements"),
        (
            "sensor.cell.value",
            "sensor.fbg.value",
            "the scene has no sensor `fbg`; expected one of [\"cell\"]",
        ),
        ("\"tendon_force_n[0]\"", "state_tick", "`controller.outputs`: `state_tick` is filled in"),
        (
            "tendon_mode = 1 ",
            "tendon_mode = 1.5 ",
            "`tendon_mode` is 1.5; expected a whole number, 0 or more",
        ),
        ("{ goal = 2.0", "{ aim = 2.0", "`controller.parameters`: the FMU has no parameter `aim`"),
        (
            "step_ms = 2.0",
            "step_ms = 2.5",
            "`controller.step_ms` is 2.5; expected a multiple of `run.dt_ms`, 1",
        ),
        (
            "duration_s = 0.2",
            "duration_s = 0.2\ndt_ms = 0.5",
            "a multiple of the FMU's fixed internal step, 0.001 s",
        ),
        ("name = \"burr\"", "name = \"burr\"\nhold = { tension_n = 1.0 }", "needs exactly one of"),
    ];
    for (from, to, part) in cases {
        let text = SCENE.replacen(from, to, 1);
        // The fixed step is a multiple of half a millisecond for the steps of 2 and 5 ms.
        let text =
            if to.contains("dt_ms") { text.replacen("step_ms = 2.0", "step_ms = 2.5", 1) } else { text };
        let done = check(&place, &text);
        assert_eq!(done.code, Some(2), "{to}: {}", done.err);
        assert!(done.err.contains(part), "{to}: {}", done.err);
    }
    assert!(!loaded.exists());
    // A library for another machine only.
    let mut archive = Archive::default();
    let description = Path::new(env!("CARGO_MANIFEST_DIR")).join("clients/fmu/bench/gain.xml");
    assert!(archive.add("modelDescription.xml", &std::fs::read(description).unwrap()));
    assert!(archive.add("binaries/riscv64-windows/gain.dll", b"library"));
    std::fs::write(&fmu, archive.finish().unwrap()).unwrap();
    let done = check(&place, SCENE);
    assert!(done.code == Some(2) && done.err.contains("no library for this machine"), "{}", done.err);
    gain(&place, &loaded);
    let short = SCENE.replacen("duration_s = 0.2", "duration_s = 0.01", 1);
    succeed(&[&"run", &place.scene(&short), &"--output", &place.path("out"), &"--quiet"]);
    assert!(loaded.exists(), "a run loads the library");
}

/// The default scene, with an FMU that PythonFMU3 has built in place of its controller.
#[test]
fn an_fmu_of_pythonfmu3_drives_the_default_scene() {
    let packages = ["pythonfmu3==0.3.4"];
    let Some(python) = python::or_skip("pythonfmu3-1", &packages, "pythonfmu3") else { return };
    let Some(library) = python::shared_library(&python) else { return };
    let place = Place::new();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("clients/fmu/tests/python/pi.py");
    let mut build = Command::new(&python);
    build.args(["-m", "pythonfmu3", "build", "-f"]).arg(script).arg("-d").arg(place.path(""));
    let output = build.limited_output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let default = include_str!("../../configs/femur_curved_drilling.toml");
    let (world, _) = default.split_once("[[controller]]").unwrap();
    let controller = format!(
        "[[controller]]\nname = \"pi\"\ndrives = [\"tendon\", \"arm\", \"burr\"]\nfmu = \"Pi.fmu\"\npreload = {library:?}\n\
         inputs = {{ y = \"bend_rad\" }}\noutputs = {{ \"tendon_force_n[0]\" = \"u\" }}\nparameters = {{ gain = 6.0 }}\n\
         [controller.constants]\ntendon_mode = 1\nburr_mode = 1\nburr_speed_rad_per_s = 800.0\narm_mode = 7\n\
         \"arm_axis[0]\" = 0.791787\n\"arm_axis[1]\" = -0.211943\n\"arm_axis[2]\" = 0.572846\narm_depth_m = 0.028\n\
         arm_speed_m_per_s = 0.0015\n"
    );
    let scene = place.scene(&format!("{world}{controller}"));
    let more = ["--mode", "lockstep", "--duration-s", "0.3"];
    let ended = Run::start(&scene, place.path("out"), &more).end_well();
    std::fs::remove_file(place.path("Pi.fmu")).unwrap();
    assert_replays(&ended.folder);
    let log = read(&ended.folder);
    assert_eq!(log.ticks.len(), 300);
    let mut sum = 0.0;
    for (tick, record) in log.ticks.iter().enumerate() {
        let error = 0.3 - answered(&log, tick).bend_rad;
        sum += error * 1e-3;
        let expected = (6.0 * error + 20.0 * sum).clamp(0.0, 20.0);
        assert_eq!(record.latched.commands[0].command.tendon_force_n[0], expected, "tick {tick}");
    }
}
