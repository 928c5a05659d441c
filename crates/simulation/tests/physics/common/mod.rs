//! Scenes and bone shared by the tests.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a scene that cannot be read is a failed test")]

pub mod arm;
pub mod block;
pub mod feed;
pub mod tunnel;

use std::path::Path;

use messages::{
    ARM_MOVE_CP, BURR_SPEED, Command, Latched, LatchedCommand, SOURCE_FRESH, SOURCE_HELD, State,
    TENDON_SERVO_JF,
};
use nalgebra::{Isometry3, Unit, Vector3};
use scene::{Scene, SceneError};
use simulation::bone::GridGeometry;
use simulation::contact_plane::ContactPlane;
use simulation::manipulator::{BaseMotion, ManipulatorModel, ProxySphere};
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

/// A linear congruential generator with 64 bits (Steele and Vigna 2021): numbers from 0 to 1.
pub struct Draw(pub u64);

impl Draw {
    pub fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(0xd134_2543_de82_ef95).wrapping_add(1);
        (self.0 >> 11) as f64 / (1u64 << 53) as f64
    }
}

/// u_k with a command of the only controller.
pub fn latched(tick: u64, source: u32, age_ticks: u64, command: Command) -> Latched {
    let mut latched = Latched { tick, controller_count: 1, ..Latched::zeroed() };
    latched.commands[0] = LatchedCommand { source, controller_index: 0, age_ticks, command };
    latched
}

/// u_k with a command sent at tick 0 and then held.
pub fn held(tick: u64, command: Command) -> Latched {
    latched(tick, if tick == 0 { SOURCE_FRESH } else { SOURCE_HELD }, tick, command)
}

pub fn rest() -> BaseMotion {
    BaseMotion::at_rest(Isometry3::identity())
}

/// The spheres near a wall that faces -x.
pub fn wall_at<M: ManipulatorModel>(m: &M, x_m: f64) -> Vec<ContactPlane> {
    let normal = Unit::new_unchecked(-Vector3::x());
    let near = |(sphere_index, s): (usize, &ProxySphere)| {
        let gap_m = x_m - s.centre_m.x - s.radius_m;
        (gap_m < 1e-3).then_some(ContactPlane::hard(sphere_index, s.centre_m, normal, gap_m))
    };
    m.proxy_spheres().iter().enumerate().filter_map(near).collect()
}

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
