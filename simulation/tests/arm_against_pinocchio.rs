//! Arms out of URDF files, and the named arms, against another library: Pinocchio for Python (`pin`).
#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::fmt::Write as _;
use std::io::Write as _;
use std::path::Path;
use std::process::{Command, Stdio};

use scene::{ArmModel, Scene};
use simulation::arm::{ArmGeometry, ArmParameters, Joints};
use test_support::limited::{COMMAND_LIMIT, limited_output_of};
use test_support::python;
use test_support::scenes::TOOL;

mod common;
use common::arm::Uniform;

const PACKAGES: [&str; 2] = ["pin==4.1.0", "example-robot-data==6.0.0"];
const POSES: usize = 1_000;

/// Files of `example-robot-data`: robots of their makers' or of ROS packages, with base and tip of six turning joints.
const FILES: [[&str; 3]; 5] = [
    ["ur_description/urdf/ur3_robot.urdf", "base_link", "tool0"],
    ["ur_description/urdf/ur5_robot.urdf", "base_link", "tool0"],
    ["ur_description/urdf/ur10_robot.urdf", "base_link", "tool0"],
    ["kinova_description/robots/kinova.urdf", "j2s6s200_link_base", "j2s6s200_end_effector"],
    ["z1_description/urdf/z1.urdf", "link00", "link06"],
];

/// The arm of a URDF file, by way of a scene.
fn of_file(text: &str, base: &str, tip: &str) -> ArmParameters {
    // A start within every arm's ranges is not asked for here: the ranges are opened.
    let keys = format!(
        "[arm]\nurdf = \"a.urdf\"\nbase_link = \"{base}\"\ntip_link = \"{tip}\"\ninitial_joints_deg = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]\n\
         lower_joints_deg = [-360.0, -360.0, -360.0, -360.0, -360.0, -360.0]\nupper_joints_deg = [360.0, 360.0, 360.0, 360.0, 360.0, 360.0]\n"
    );
    let read = |_: &Path| Ok(text.to_owned());
    let run = "name = \"a\"\nrun = { mode = \"lockstep\", duration_s = 1.0 }\n";
    let scene = Scene::parse_with(&format!("{run}{TOOL}{keys}"), Path::new("a.toml"), &read).unwrap();
    ArmParameters::of(&scene.arm, 1e-3)
}

fn list(numbers: &[f64]) -> String {
    let texts: Vec<String> = numbers.iter().map(|x| format!("{x:e}")).collect();
    format!("[{}]", texts.join(","))
}

/// Poses and Jacobians of an arm, a line each; the matrices by columns.
fn lines(out: &mut String, file: &str, [base, tip]: [&str; 2], geometry: &ArmGeometry) {
    let mut uniform = Uniform(31);
    for _ in 0..POSES {
        let q: Joints = std::array::from_fn(|_| uniform.between(-3.1, 3.1));
        writeln!(
            out,
            r#"{{"file":"{file}","base":"{base}","tip":"{tip}","q_rad":{},"pose":{},"jacobian":{}}}"#,
            list(&q),
            list(geometry.forward(&q).to_homogeneous().as_slice()),
            list(geometry.frames(&q).jacobian().as_slice()),
        )
        .unwrap();
    }
}

fn ask(python: &Path, argument: &str, lines: &str) -> serde_json::Value {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/arm_pinocchio.py");
    let mut child = Command::new(python)
        .arg(script)
        .arg(argument)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    child.stdin.take().unwrap().write_all(lines.as_bytes()).unwrap();
    let output = limited_output_of(child, COMMAND_LIMIT, "pinocchio");
    assert!(output.status.success());
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
fn five_arms_out_of_their_files_agree_with_pinocchio() {
    let Some(python) = python::or_skip("pin-4.1.0", &PACKAGES, "pinocchio") else { return };
    let folder = ask(&python, "folder", "");
    let folder = Path::new(folder.as_str().unwrap());
    for [name, base, tip] in FILES {
        let file = folder.join(name);
        let text = std::fs::read_to_string(&file).unwrap();
        let mut asked = String::new();
        lines(&mut asked, file.to_str().unwrap(), [base, tip], &of_file(&text, base, tip).geometry);
        let worst = ask(&python, "compare", &asked);
        println!("{name} against {}: {worst}", PACKAGES[0]);
        assert_eq!(worst["poses"], POSES);
        assert!(worst["forward"].as_f64().unwrap() < 1e-12, "{name}");
        assert!(worst["jacobian"].as_f64().unwrap() < 1e-9, "{name}");
    }
}

/// Their base is ours turned by 180° about z, and their tool0 is our flange.
#[test]
fn the_ur3_and_the_ur5_are_those_of_the_ros_description() {
    let Some(python) = python::or_skip("pin-4.1.0", &PACKAGES, "pinocchio") else { return };
    let folder = ask(&python, "folder", "");
    let folder = Path::new(folder.as_str().unwrap());
    for ([name, base, tip], model) in FILES.into_iter().zip([ArmModel::Ur3, ArmModel::Ur5]) {
        let text = std::fs::read_to_string(folder.join(name)).unwrap();
        let theirs = of_file(&text, base, tip).geometry;
        let ours = ArmParameters::named(model, 1e-3);
        let half_turn = nalgebra::Matrix4::from_diagonal(&nalgebra::Vector4::new(-1.0, -1.0, 1.0, 1.0));
        let mut uniform = Uniform(32);
        let mut worst = 0.0f64;
        for _ in 0..POSES {
            let q: Joints = std::array::from_fn(|_| uniform.between(-3.1, 3.1));
            let expected = half_turn * theirs.forward(&q).to_homogeneous();
            worst = worst.max((ours.geometry.forward(&q).to_homogeneous() - expected).amax());
        }
        println!("{model:?}: worst entry {worst:.1e}");
        // Their right angles are rounded to some 1e-11.
        assert!(worst < 1e-10, "{model:?}");
    }
}
