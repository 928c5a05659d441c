//! The four tunnels of the published experiment (Alambeigi et al. 2017): a foam block with a pilot hole, a
//! tension ramp, then a feed.

use std::path::Path;

use messages::{ArmMode, BurrMode, Command, CommandSource, Latched, TendonMode};
use nalgebra::Vector3;
use scene::Scene;
use simulation::bone::{GridGeometry, MaterialLaw};

/// Duration of the tension ramp before the feed, s.
pub const RAMP_S: f64 = 1.0;
/// Duration of the run, s: 4 mm are drilled after the ramp.
pub const RUN_S: f64 = 5.0;
pub const FEED_M_PER_S: f64 = 1e-3;
/// Sawbones foam of 10 pounds per cubic foot, kg/m³.
pub const FOAM_KG_PER_M3: f64 = 160.0;

/// The block.
pub fn foam() -> (GridGeometry, Vec<i16>) {
    let law = MaterialLaw::default();
    let hu = ((FOAM_KG_PER_M3 - law.density_offset_kg_m3) / law.density_slope_kg_m3_hu).round() as i16;
    let dims = [48, 32, 108];
    let origin = Vector3::new(-9.75e-3, -7.75e-3, -37.75e-3);
    (GridGeometry::axis_aligned(dims, [0.5e-3; 3], origin), vec![hu; dims.iter().product()])
}

/// The scene.
pub fn tunnel(model: &str, dt_ms: f64) -> Scene {
    let text = format!(
        "name = \"tunnel\"\n[run]\nmode = \"lockstep\"\ndt_ms = {dt_ms:?}\nduration_s = 10.0\n\
         [volume]\nphantom = \"block\"\nbone_threshold_hu = -100\n\
         [[predrill]]\nfrom_mm = [0.0, 0.0, -60.0]\nto_mm = [0.0, 0.0, 0.0]\ndiameter_mm = 7.0\n\
         [manipulator]\nmodel = \"{model}\"\ntendon_friction = 0.1\n[contact]\nfriction = 0.2\n\
         [tool]\nburr_start_mm = [0.0, 0.0, 0.0]\ndirection = [0.0, 0.0, 1.0]\n\
         bend_toward = [1.0, 0.0, 0.0]\n\
         [[controller]]\nname = \"feed\"\ndrives = [\"tendon\", \"arm\", \"burr\"]\nexternal = true\n"
    );
    Scene::parse(&text, Path::new("tunnel.toml")).unwrap()
}

/// u_k.
pub fn latched(tick: u64, dt_s: f64, tension_n: f64) -> Latched {
    let time_s = tick as f64 * dt_s;
    let feeding = time_s >= RAMP_S;
    let fresh = time_s < RAMP_S + dt_s;
    let command = Command {
        sequence: ((RAMP_S / dt_s) as u64 + 1).min(tick) + 1,
        tendon_mode: TendonMode::ServoJf.code(),
        tendon_force_n: [tension_n * (time_s / RAMP_S).min(1.0), 0.0, 0.0, 0.0],
        burr_mode: BurrMode::Speed.code(),
        burr_speed_rad_per_s: 235.6,
        arm_mode: if feeding { ArmMode::Insert } else { ArmMode::None }.code(),
        arm_axis: [0.0, 0.0, 1.0],
        arm_depth_m: 0.03,
        arm_speed_m_per_s: FEED_M_PER_S,
        ..Command::zeroed()
    };
    let mut latched = Latched { tick, controller_count: 1, ..Latched::zeroed() };
    latched.commands[0].source = if fresh { CommandSource::Fresh } else { CommandSource::Held }.code();
    latched.commands[0].command = command;
    latched
}
