//! Arms from URDF files, and the named arms, against other libraries: Pinocchio for Python (`pin`), yourdfpy
//! and MuJoCo.
#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::fmt::Write as _;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use scene::{ArmModel, Scene};
use simulation::arm::{ArmGeometry, ArmParameters, Joints};
use test_support::limited::{COMMAND_LIMIT, limited_output_of};
use test_support::python;
use test_support::scenes::TOOL;

use crate::common::arm::Uniform;

const PACKAGES: [&str; 2] = ["pin==4.1.0", "example-robot-data==6.0.0"];
const WITNESSES: [&str; 2] = ["yourdfpy==0.0.60", "mujoco==3.3.7"];
const POSES: usize = 1_000;

/// Files of `example-robot-data`, from manufacturers' or ROS packages: base and tip of a chain of six or
/// seven revolute joints, and their number.
const FILES: [([&str; 3], usize); 7] = [
    (["ur_description/urdf/ur3_robot.urdf", "base_link", "tool0"], 6),
    (["ur_description/urdf/ur5_robot.urdf", "base_link", "tool0"], 6),
    (["ur_description/urdf/ur10_robot.urdf", "base_link", "tool0"], 6),
    (["kinova_description/robots/kinova.urdf", "j2s6s200_link_base", "j2s6s200_end_effector"], 6),
    (["z1_description/urdf/z1.urdf", "link00", "link06"], 6),
    (["panda_description/urdf/panda.urdf", "panda_link0", "panda_link8"], 7),
    (["xarm_description/urdf/xarm7.urdf", "link_base", "link_eef"], 7),
];

/// Builds the arm of a URDF file through a scene.
fn of_file(text: &str, base: &str, tip: &str, joints: usize) -> ArmParameters {
    // The ranges are widened, so that the start is within every arm's.
    let angles = |deg: f64| list(&[deg; 7][..joints]);
    let keys = format!(
        "[arm]\nurdf = \"a.urdf\"\nbase_link = \"{base}\"\ntip_link = \"{tip}\"\ninitial_joints_deg = {}\n\
         lower_joints_deg = {}\nupper_joints_deg = {}\n",
        angles(0.0),
        angles(-360.0),
        angles(360.0)
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

/// Writes poses and Jacobians of an arm, one per line; matrices column by column.
fn lines(out: &mut String, file: &str, [base, tip]: [&str; 2], geometry: &ArmGeometry) {
    let mut uniform = Uniform(31);
    for _ in 0..POSES {
        let q: Joints = std::array::from_fn(|_| uniform.between(-3.1, 3.1));
        writeln!(
            out,
            r#"{{"file":"{file}","base":"{base}","tip":"{tip}","q_rad":{},"pose":{},"jacobian":{}}}"#,
            list(&q[..geometry.joints()]),
            list(geometry.forward(&q).to_homogeneous().as_slice()),
            list(geometry.frames(&q).jacobian().columns(0, geometry.joints()).as_slice()),
        )
        .unwrap();
    }
}

fn ask(python: &Path, arguments: &[&str], lines: &str) -> serde_json::Value {
    let scripts = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python");
    let mut child = Command::new(python)
        .current_dir(scripts)
        .args(arguments)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    child.stdin.take().unwrap().write_all(lines.as_bytes()).unwrap();
    let output = limited_output_of(child, COMMAND_LIMIT, arguments[0]);
    assert!(output.status.success());
    serde_json::from_slice(&output.stdout).unwrap()
}

/// Folder of the files in Pinocchio's environment.
fn folder(python: &Path) -> PathBuf {
    let folder = ask(python, &["arm_pinocchio.py", "folder"], "");
    PathBuf::from(folder.as_str().unwrap())
}

/// Compares every arm with a script's libraries; the reported errors must be below these.
fn compare(folder: &Path, python: &Path, script: &[&str], figures: &[(&str, f64)]) {
    for ([name, base, tip], joints) in FILES {
        let file = folder.join(name);
        let text = std::fs::read_to_string(&file).unwrap();
        let mut asked = String::new();
        lines(&mut asked, file.to_str().unwrap(), [base, tip], &of_file(&text, base, tip, joints).geometry);
        let worst = ask(python, script, &asked);
        println!("{name} by {script:?}: {worst}");
        assert_eq!(worst["poses"], POSES);
        for (figure, most) in figures {
            assert!(worst[figure].as_f64().unwrap() < *most, "{name}: {figure}");
        }
    }
}

#[test]
fn arms_out_of_their_files_agree_with_pinocchio() {
    let Some(python) = python::or_skip("pin-4.1.0", &PACKAGES, "pinocchio") else { return };
    let figures = [("forward", 1e-12), ("jacobian", 1e-9)];
    compare(&folder(&python), &python, &["arm_pinocchio.py", "compare"], &figures);
}

#[test]
fn arms_out_of_their_files_agree_with_yourdfpy_and_mujoco() {
    let Some(python) = python::or_skip("pin-4.1.0", &PACKAGES, "pinocchio") else { return };
    let Some(witnesses) = python::or_skip("arms-1", &WITNESSES, "yourdfpy, mujoco") else { return };
    let figures = [("yourdfpy", 1e-12), ("mujoco", 1e-12), ("mujoco_jacobian", 1e-9)];
    compare(&folder(&python), &witnesses, &["arm_witnesses.py"], &figures);
}

/// Their base is ours rotated by 180° about z, and their tool0 is our flange.
#[test]
fn the_ur3_and_the_ur5_are_those_of_the_ros_description() {
    let Some(python) = python::or_skip("pin-4.1.0", &PACKAGES, "pinocchio") else { return };
    let folder = folder(&python);
    for (([name, base, tip], _), model) in FILES.into_iter().zip([ArmModel::Ur3, ArmModel::Ur5]) {
        let text = std::fs::read_to_string(folder.join(name)).unwrap();
        let theirs = of_file(&text, base, tip, 6).geometry;
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
        // Their right angles are rounded to about 1e-11.
        assert!(worst < 1e-10, "{model:?}");
    }
}
