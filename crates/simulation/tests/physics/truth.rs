//! `[truth]`: the simulation uses the true parameters of the world.
#![allow(clippy::unwrap_used, reason = "a helper that fails is a failed test")]

use std::path::Path;

use crate::common::held;
use messages::{Command, TENDON_SERVO_JF};
use scene::Scene;
use simulation::Simulation;
use test_support::scenes::TOOL;

/// Hash after 300 ticks under tension.
fn hash(tables: &str) -> [u64; 2] {
    let text = format!("name = \"a\"\nrun = {{ mode = \"lockstep\", duration_s = 1.0 }}\n{TOOL}{tables}");
    let scene = Scene::parse(&text, Path::new("a.toml")).unwrap();
    let mut simulation = Simulation::new(&scene, None).unwrap();
    let command = Command {
        sequence: 1,
        tendon_mode: TENDON_SERVO_JF,
        tendon_force_n: [4.0, 0.0, 0.0, 0.0],
        ..Command::zeroed()
    };
    for tick in 0..300 {
        simulation.step(&held(tick, command)).unwrap();
    }
    simulation.state().hash
}

#[test]
fn a_true_tool_moves_as_one_of_which_the_scene_knows() {
    let keys = "stiffness_scale = 0.8\nmass_scale = 1.5\ndamping_ratio = 0.2\ntendon_friction = 0.1\n";
    let known = hash(&format!("[manipulator]\n{keys}"));
    assert_eq!(hash(&format!("[truth.manipulator]\n{keys}")), known);
    assert_eq!(hash(&format!("[manipulator]\nstiffness_scale = 3.0\n[truth.manipulator]\n{keys}")), known);
    assert_ne!(hash(""), known);
}
