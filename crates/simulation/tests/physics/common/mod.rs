//! Scenes and bone shared by the tests.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a scene that cannot be read is a failed test")]

pub mod arm;
pub mod block;
pub mod feed;
pub mod tunnel;

use std::path::Path;

use messages::{ARM_MOVE_CP, BURR_SPEED, Command, State, TENDON_SERVO_JF};
use nalgebra::Vector3;
use scene::{Scene, SceneError};
use simulation::bone::GridGeometry;
use test_support::scenes::TOOL;

/// A tunnel in [`bone`], tight around the tool.
pub const TUNNEL: &str = r#"
name = "tight_tunnel"
run = { mode = "lockstep", duration_s = 3.0 }
volume = { phantom = "block" }
[[predrill]]
from_mm = [0.0, 0.0, -110.0]
to_mm = [0.0, 0.0, 0.0]
diameter_mm = 6.6
"#;

/// A scene with that tool.
pub fn try_scene(text: &str) -> Result<Scene, SceneError> {
    Scene::parse(&format!("{text}{TOOL}"), Path::new("test.toml"))
}

/// A valid scene with that tool.
pub fn scene(text: &str) -> Scene {
    try_scene(text).unwrap()
}

/// Uniform bone, 0.5 mm voxels, 24 × 24 × 120 mm, the tool along +z inside it.
pub fn bone() -> (GridGeometry, Vec<i16>) {
    let dims = [48, 48, 240];
    let origin = Vector3::new(-11.75e-3, -11.75e-3, -99.75e-3);
    (GridGeometry::axis_aligned(dims, [0.5e-3; 3], origin), vec![400; dims.iter().product()])
}

/// 3 mm/s along +z with the burr on and 3 N on tendon 0.
pub fn feed_along_z(start: &State) -> Command {
    let mut goal = start.t_world_flange;
    goal.position_m[2] += 0.02;
    Command {
        sequence: 1,
        tendon_mode: TENDON_SERVO_JF,
        tendon_force_n: [3.0, 0.0, 0.0, 0.0],
        arm_mode: ARM_MOVE_CP,
        t_world_base: goal,
        arm_speed_m_per_s: 3e-3,
        burr_mode: BURR_SPEED,
        burr_speed_rad_per_s: 800.0,
        ..Command::zeroed()
    }
}
