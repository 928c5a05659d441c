//! An arm part that enters bone is reported once, with position and depth, and changes no state.
#![allow(clippy::unwrap_used, missing_docs)]

use crate::common::{TUNNEL, bone, latched, scene};
use messages::{ARM_MOVE_CP, Command, Latched, SOURCE_FRESH, State};
use simulation::{CtView, Simulation};

/// Lower face of the block, m.
const FACE_Z_M: f64 = -0.1;
const VOXEL_M: f64 = 0.5e-3;
/// Ticks within which every part is checked.
const PERIOD_TICKS: u64 = 72;

/// 3 mm/s along +z.
fn feed(start: &State) -> Latched {
    let mut goal = start.t_world_base;
    goal.position_m[2] += 6e-3;
    let command = Command {
        sequence: 1,
        arm_mode: ARM_MOVE_CP,
        t_world_base: goal,
        arm_speed_m_per_s: 3e-3,
        ..Command::zeroed()
    };
    latched(0, SOURCE_FRESH, 0, command)
}

/// Part, depth and flange z of each reported entry within `ticks`.
fn entries(
    simulation: &mut Simulation<'_>,
    latched: &Latched,
    ticks: u64,
) -> Vec<(&'static str, f64, State)> {
    let mut found = Vec::new();
    for _ in 0..ticks {
        let tick = simulation.state().tick;
        simulation.step(&Latched { tick, ..*latched }).unwrap();
        found.extend(simulation.arm_entry().map(|entry| (entry.part, entry.depth_m, *simulation.state())));
    }
    found
}

fn mounted(offset_mm: f64) -> String {
    format!("{TUNNEL}[arm]\nmax_force_n = 1e5\ntool_position_mm = [0.0, 0.0, {offset_mm}]\n")
}

/// The flange starts 1.5 mm in front of the block and advances 4.5 mm into it; the holder on it is in bone
/// from the start.
#[test]
fn a_wrist_that_enters_bone_is_told_once() {
    let bone = bone();
    let ct = CtView { geometry: bone.0, hu: &bone.1 };
    let base_z_m = Simulation::new(&scene(TUNNEL), Some(ct)).unwrap().state().t_world_base.position_m[2];
    let text = mounted(1e3 * (base_z_m - FACE_Z_M) + 1.5);
    let mut simulation = Simulation::new(&scene(&text), Some(ct)).unwrap();
    let latched = feed(simulation.state());
    let told = entries(&mut simulation, &latched, 3000);
    let parts: Vec<&str> = told.iter().map(|entry| entry.0).collect();
    assert_eq!(parts, ["holder", "wrist 3"]);
    let (_, _, state) = &told[0];
    assert!(state.tick <= PERIOD_TICKS, "the holder at tick {}", state.tick);
    // Less than a voxel is not reported, and the wrist is checked once per period.
    let (_, depth_m, state) = &told[1];
    let in_m = state.t_world_flange.position_m[2] - FACE_Z_M;
    let late_m = 3e-3 * 1e-3 * PERIOD_TICKS as f64;
    assert!((VOXEL_M - 1e-6..VOXEL_M + late_m + 1e-6).contains(&in_m), "the wrist {in_m} m in bone");
    assert!((depth_m - in_m).abs() < 1e-3, "{depth_m}, expected {in_m}");

    // A keyframe taken now records that they are inside.
    let mut buffer = vec![0; 1 << 22];
    let length = simulation.write_keyframe(&mut buffer).unwrap();
    let mut other = Simulation::new(&scene(&text), Some(ct)).unwrap();
    other.restore_keyframe(&buffer[..length]).unwrap();
    assert!(entries(&mut other, &latched, 2 * PERIOD_TICKS).is_empty());
}

/// With the flange far behind, only the bare shaft enters, and it has a hole.
#[test]
fn an_arm_beside_the_bone_is_not_told() {
    let bone = bone();
    let ct = CtView { geometry: bone.0, hu: &bone.1 };
    let mut simulation = Simulation::new(&scene(&mounted(200.0)), Some(ct)).unwrap();
    let latched = feed(simulation.state());
    assert!(entries(&mut simulation, &latched, 500).is_empty());
    // The same shaft without a hole in front of the tool's base.
    let text = mounted(200.0).replace("from_mm = [0.0, 0.0, -110.0]", "from_mm = [0.0, 0.0, -72.0]");
    let mut simulation = Simulation::new(&scene(&text), Some(ct)).unwrap();
    let told = entries(&mut simulation, &latched, PERIOD_TICKS);
    assert_eq!(told.iter().map(|entry| entry.0).collect::<Vec<_>>(), ["shaft behind its base"]);
}
