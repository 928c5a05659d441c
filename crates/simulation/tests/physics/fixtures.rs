//! Fixtures while the tool drills: whatever a controller commands, and however late its commands are.
#![allow(clippy::unwrap_used, missing_docs)]

use crate::common::arm::Uniform;
use crate::common::feed;
use messages::{ArmMode, BurrMode, Command, CommandSource, Latched, LatchedCommand, SensorKind, TendonMode};
use nalgebra::Vector3;
use scene::Scene;
use simulation::bone::GridGeometry;
use simulation::{CtView, Simulation};

/// Ticks after which the safe command replaces a late one: `run.hold_ticks` of a scene in real time.
const HOLD_TICKS: u64 = 50;
const VOXEL_M: f64 = 0.6e-3;
const DIMS: [usize; 3] = [50, 50, 60];

/// A ball ahead of the burr and a vessel on the side to which the tool bends, both in the bone.
fn scene(model: &str, action: &str) -> Scene {
    let mut scene = feed::scene(model);
    let text = format!(
        "name = \"near\"\n[run]\nmode = \"lockstep\"\nduration_s = 1.0\n[volume]\nphantom = \"block\"\n\
         [tool]\nburr_start_mm = [0.0, 0.0, -4.0]\ndirection = [0.0, 0.0, 1.0]\n\
         bend_toward = [1.0, 0.0, 0.0]\n\
         [[structure]]\nname = \"ball\"\nmargin_mm = 2.0\non_margin = \"{action}\"\n\
         ball = {{ centre_mm = [0.0, 0.0, 19.0], radius_mm = 4.0 }}\n\
         [[structure]]\nname = \"vessel\"\nmargin_mm = 1.0\non_margin = \"{action}\"\n\
         tube = {{ points_mm = [[8.0, -20.0, 8.0], [8.0, 20.0, 8.0]], radius_mm = 1.5 }}\n"
    );
    // A force limit would stop the arm first.
    scene.arm.max_force_n = Some(1e5);
    scene.structure = Scene::parse(&text, std::path::Path::new("near.toml")).unwrap().structure;
    scene
}

/// Pushes toward the structures: forward at up to 8 mm/s, aslant, with tensions of up to `most_n`.
fn adversary(random: &mut Uniform, most_n: f64) -> Command {
    let axis = Vector3::new(random.between(-0.03, 0.06), random.between(-0.03, 0.03), 1.0);
    let mut command = Command {
        arm_mode: ArmMode::Insert.code(),
        arm_axis: axis.normalize().into(),
        arm_depth_m: random.between(15e-3, 30e-3),
        arm_speed_m_per_s: random.between(2e-3, 8e-3),
        tendon_mode: TendonMode::ServoJf.code(),
        burr_mode: BurrMode::Speed.code(),
        burr_speed_rad_per_s: 1000.0,
        ..Command::zeroed()
    };
    command.tendon_force_n[0] = random.between(0.0, most_n);
    command
}

/// What applies once a command is late by more than [`HOLD_TICKS`]: the tendons keep their tension.
fn safe() -> Command {
    Command { arm_mode: ArmMode::Hold.code(), burr_mode: BurrMode::Speed.code(), ..Command::zeroed() }
}

/// By how much the tool came closer to a structure than its margin, m, and the number of removed voxels. The
/// controller wants something else every 0.3 s on average. Its commands arrive in every tick, or up to 65
/// ticks late.
fn deepest_m(model: &str, action: &str, (seed, most_n): (u64, f64), is_late: bool) -> (f64, u64) {
    let corner = -0.5 * VOXEL_M * (DIMS[0] - 1) as f64;
    let geometry =
        GridGeometry::axis_aligned(DIMS, [VOXEL_M; 3], Vector3::new(corner, corner, 0.5 * VOXEL_M));
    let hu = vec![600_i16; geometry.voxel_count()];
    let scene = scene(model, action);
    let mut simulation = Simulation::new(&scene, Some(CtView { geometry, hu: &hu })).unwrap();
    let mut random = Uniform(seed);
    let (mut wanted, mut given, mut age, mut late) = (adversary(&mut random, most_n), safe(), 0, 0.0);
    let mut deepest_m = f64::NEG_INFINITY;
    for tick in 0..6000 {
        if random.between(0.0, 1.0) < 0.003 {
            wanted = adversary(&mut random, most_n);
        }
        age += 1;
        if tick == 0 || age as f64 > late {
            // The depth changes a little, so that each command is a new one.
            let arm_depth_m = wanted.arm_depth_m + 1e-6 * (tick % 7) as f64;
            given = Command { sequence: tick + 1, arm_depth_m, ..wanted };
            // In front of the bone, tension would bend the tool away from it.
            if simulation.state().t_world_burr.position_m[2] < 3e-3 {
                given.tendon_force_n[0] = 0.0;
            }
            (age, late) = (0, if is_late { random.between(0.0, 65.0) } else { 0.0 });
        }
        let (source, command) = match age {
            0 => (CommandSource::Fresh, given),
            1..=HOLD_TICKS => (CommandSource::Held, given),
            _ => (CommandSource::Safe, Command { sequence: given.sequence, ..safe() }),
        };
        let mut latched = Latched { tick, controller_count: 1, ..Latched::zeroed() };
        latched.commands[0] =
            LatchedCommand { source: source.code(), controller_index: 0, age_ticks: age, command };
        simulation.step(&latched).unwrap();
        let reading = simulation.readings().first().unwrap();
        assert_eq!(reading.kind(), Ok(SensorKind::Clearance));
        deepest_m = deepest_m.max(2e-3 - reading.value[0]).max(1e-3 - reading.value[2]);
    }
    (deepest_m, simulation.state().removed_total)
}

/// The arm is held back in time, also by a tool that cuts on the way.
#[test]
fn a_fixture_keeps_a_drilling_arm_out_of_the_margin_also_if_commands_are_late() {
    for (model, is_late) in [("planar", false), ("planar", true), ("spatial", true)] {
        let (free_m, _) = deepest_m(model, "event", (1, 0.0), is_late);
        assert!(free_m > 1e-3, "without a fixture the tool comes too close: {free_m}");
        for seed in 1..=2 {
            let (deepest_m, removed) = deepest_m(model, "fixture", (seed, 0.0), is_late);
            println!("{model}, late {is_late}, seed {seed}: {:.4} mm, {removed} voxels", 1e3 * deepest_m);
            assert!(deepest_m < 50e-6, "{model}, late {is_late}, seed {seed}: {deepest_m}");
            assert!(removed > 500, "{removed}");
        }
    }
}

/// Tension that bone holds back when it is allowed bends the tool later, as the burr cuts to the side: a
/// fixture lets it come into the margin, but much less far than without.
#[test]
fn tension_that_bone_held_back_is_most_of_what_a_fixture_lets_through() {
    for is_late in [false, true] {
        let (free_m, _) = deepest_m("planar", "event", (1, 8.0), is_late);
        let (deepest_m, _) = deepest_m("planar", "fixture", (1, 8.0), is_late);
        println!("late {is_late}: without {:.4} mm, with {:.4} mm", 1e3 * free_m, 1e3 * deepest_m);
        assert!(deepest_m < 1e-3 && deepest_m < 0.5 * free_m, "{deepest_m} m, without {free_m} m");
    }
}
