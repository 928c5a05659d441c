//! UR5 kinematics against another library: `modern_robotics` for Python.
#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::io::Write;
use std::path::Path;
use std::process::{Command, Stdio};
use test_support::limited::{COMMAND_LIMIT, limited_output_of};
use test_support::python;

use crate::common::arm::Uniform;
use simulation::arm::{ArmParameters, Joints, UrGeometry, six_joints};

const PACKAGES: [&str; 2] = ["modern_robotics==1.1.1", "numpy==2.4.6"];
const POSES: usize = 1_000;

/// One pose with all our results, as a line of JSON; matrices column by column.
fn case(geometry: &UrGeometry, q: &Joints, reference: &Joints) -> String {
    let limits = ArmParameters::ur5(1e-3).joint_limits;
    let pose = geometry.forward(q);
    let list = |numbers: &[f64]| {
        let texts: Vec<String> = numbers.iter().map(|x| format!("{x:e}")).collect();
        format!("[{}]", texts.join(","))
    };
    let solutions = geometry.inverse(&pose).unwrap();
    let solutions: Vec<String> = solutions.as_slice().iter().map(|q| list(&q[..6])).collect();
    let nearest = geometry.inverse_nearest(&pose, reference, &limits.lower_rad, &limits.upper_rad).unwrap();
    format!(
        r#"{{"q_rad":{},"pose":{},"jacobian":{},"solutions_rad":[{}],"nearest_rad":{}}}"#,
        list(&q[..6]),
        list(pose.to_homogeneous().as_slice()),
        list(geometry.frames(q).jacobian().fixed_columns::<6>(0).as_slice()),
        solutions.join(","),
        list(&nearest[..6]),
    )
}

#[test]
fn a_thousand_random_poses_agree_with_modern_robotics() {
    let python = python::or_skip("modern-robotics-1.1.1", &PACKAGES, "modern_robotics");
    let Some(python) = python else { return };
    let geometry = UrGeometry::ur5();
    let mut uniform = Uniform(11);
    let mut lines = Vec::new();
    while lines.len() < POSES {
        let q =
            six_joints(std::array::from_fn(|i| uniform.between(-1.0, 1.0) * if i == 2 { 3.1 } else { 6.2 }));
        // Their Newton iteration needs some distance from singularities; ours is tested near them elsewhere.
        if geometry.manipulability_m3(&q) > 5e-3 {
            lines.push(case(&geometry, &q, &q.map(|angle| if angle == 0.0 { 0.0 } else { angle + 0.01 })));
        }
    }
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/arm_kinematics.py");
    let mut child =
        Command::new(&python).arg(script).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    child.stdin.take().unwrap().write_all(lines.join("\n").as_bytes()).unwrap();
    let output = limited_output_of(child, COMMAND_LIMIT, "modern_robotics");
    let text = String::from_utf8(output.stdout).unwrap();
    println!("against {}: {text}", PACKAGES[0]);
    assert!(output.status.success());
    let worst: serde_json::Value = serde_json::from_str(&text).unwrap();
    assert_eq!(worst["poses"], POSES);
    assert!(worst["solutions"].as_u64().unwrap() > 4 * POSES as u64);
    for figure in ["forward", "inverse", "jacobian"] {
        // Requirement: 1e-9 m.
        assert!(worst[figure].as_f64().unwrap() < 1e-9, "{figure}");
    }
    // Their matrix logarithm takes the angle from an arc cosine near 1, good to sqrt(2 eps) = 2e-8 rad, times
    // about ten for the inverse of the Jacobian: enough to identify the branch.
    assert!(worst["numeric"].as_f64().unwrap() < 1e-6);
}
