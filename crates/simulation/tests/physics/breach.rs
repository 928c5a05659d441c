//! A burr or tube that leaves the bone is reported with place and direction, and its own hole is no breach.
#![allow(clippy::unwrap_used, missing_docs)]

use crate::common::feed;
use messages::{ArmMode, Breach, BurrMode, Command, CommandSource, Latched, LatchedCommand};
use nalgebra::Vector3;
use simulation::bone::GridGeometry;
use simulation::{CtView, Simulation};

const VOXEL_M: f64 = 0.5e-3;
const FEED_M_PER_S: f64 = 5e-3;
/// Ticks within which the burr, and the tube, are checked.
const BURR_TICKS: f64 = 8.0;

/// Bone of 600 HU where `is_bone` holds (mm), in air: 30 x 30 x 60 mm, from z = -10 mm on.
fn bone(is_bone: impl Fn([f64; 3]) -> bool) -> (GridGeometry, Vec<i16>) {
    let dims = [60, 60, 120];
    let geometry =
        GridGeometry::axis_aligned(dims, [VOXEL_M; 3], Vector3::new(-14.75e-3, -14.75e-3, -9.75e-3));
    let hu = (0..geometry.voxel_count()).map(|index| {
        let [i, j, k] = [index % 60, index / 60 % 60, index / 3600];
        if is_bone((geometry.voxel_centre_world_m(i, j, k) * 1e3).into()) { 600 } else { -1000 }
    });
    (geometry, hu.collect())
}

fn is_within(x: f64, y: f64) -> bool {
    x.abs() < 12.0 && y.abs() < 12.0
}

/// A feed along +z to this depth with the burr on.
fn latched(tick: u64, sequence: u64, depth_m: f64) -> Latched {
    let command = Command {
        sequence,
        arm_mode: ArmMode::Insert.code(),
        arm_axis: [0.0, 0.0, 1.0],
        arm_depth_m: depth_m,
        arm_speed_m_per_s: FEED_M_PER_S,
        burr_mode: BurrMode::Speed.code(),
        burr_speed_rad_per_s: 8000.0 * core::f64::consts::TAU / 60.0,
        ..Command::zeroed()
    };
    let mut latched = Latched { tick, controller_count: 1, ..Latched::zeroed() };
    let source = CommandSource::Fresh.code();
    latched.commands[0] = LatchedCommand { source, controller_index: 0, age_ticks: 0, command };
    latched
}

/// The breaches of a feed of `depth_m`, each with the tip's z and the tick.
fn feed(simulation: &mut Simulation<'_>, sequence: u64, depth_m: f64, ticks: u64) -> Vec<(Breach, f64, u64)> {
    let mut found = Vec::new();
    for step in 0..ticks {
        let mut command = latched(simulation.state().tick, sequence, depth_m);
        if step > 0 {
            command.commands[0].source = CommandSource::Held.code();
        }
        simulation.step(&command).unwrap();
        let state = simulation.state();
        found
            .extend(simulation.breach().map(|breach| (*breach, state.t_world_tip.position_m[2], state.tick)));
    }
    found
}

/// A plate of 10 mm: the front of the burr appears behind it, then the tube, and both go back through the
/// hole.
#[test]
fn a_burr_that_comes_out_behind_a_plate_is_reported_in_the_tick_at_its_place() {
    let (geometry, hu) = bone(|[x, y, z]| is_within(x, y) && (0.0..10.0).contains(&z));
    let mut simulation = Simulation::new(&feed::scene("planar"), Some(CtView { geometry, hu: &hu })).unwrap();
    let found = feed(&mut simulation, 1, 20e-3, 4500);
    let parts: Vec<&str> = found.iter().map(|(breach, ..)| breach.part).collect();
    assert_eq!(parts, ["burr", "tube"], "{found:?}");
    let (breach, tip_m, _) = &found[0];
    // A check can be late by its period, and the surface is that of the voxels.
    let late_m = VOXEL_M + FEED_M_PER_S * 1e-3 * BURR_TICKS;
    assert!((10e-3..=10e-3 + late_m).contains(tip_m), "the tip is at {tip_m}");
    let [x, y, z] = breach.place_m;
    assert!(x.hypot(y) < 1e-3 && (z - tip_m).abs() < 1e-4 && breach.direction[2] > 0.99, "{breach:?}");
    assert_eq!(feed(&mut simulation, 2, 0.0, 4500), [], "on the way back");
}

/// Through a flat face and through one of 40 degrees, in bone that goes on.
#[test]
fn the_hole_that_a_burr_came_by_is_no_breach() {
    for slant in [0.0, 0.839] {
        let (geometry, hu) = bone(|[x, y, z]| is_within(x, y) && z < 48.0 && z > slant * x);
        let mut simulation =
            Simulation::new(&feed::scene("planar"), Some(CtView { geometry, hu: &hu })).unwrap();
        assert_eq!(feed(&mut simulation, 1, 18e-3, 4000), [], "in, slant {slant}");
        assert!(simulation.state().removed_total > 1000);
        assert_eq!(feed(&mut simulation, 2, 0.0, 4000), [], "out, slant {slant}");
    }
}

/// A wall beside the hole that gets thinner with depth, and is gone 9 mm down.
#[test]
fn a_burr_that_comes_out_sideways_is_reported_with_that_direction() {
    let (geometry, hu) = bone(|[x, y, z]| is_within(x, y) && (0.0..48.0).contains(&z) && x < 6.0 - 0.3 * z);
    let mut simulation = Simulation::new(&feed::scene("planar"), Some(CtView { geometry, hu: &hu })).unwrap();
    let found = feed(&mut simulation, 1, 20e-3, 3500);
    let (breach, ..) = &found[0];
    assert!(breach.part == "burr" && breach.direction[0] > 0.9, "{breach:?}");
    let [x, _, z] = breach.place_m.map(|x| x * 1e3);
    // On the slanting face, to a voxel.
    assert!((x - (6.0 - 0.3 * z)).abs() < 0.8, "{breach:?}");
}

#[test]
fn a_breach_changes_no_bit_and_is_not_reported_again_after_a_keyframe() {
    let (geometry, hu) = bone(|[x, y, z]| is_within(x, y) && (0.0..10.0).contains(&z));
    let ct = CtView { geometry, hu: &hu };
    let mut simulation = Simulation::new(&feed::scene("planar"), Some(ct)).unwrap();
    assert_eq!(feed(&mut simulation, 1, 12.5e-3, 3500).len(), 1);
    let mut buffer = vec![0; 1 << 22];
    let length = simulation.write_keyframe(&mut buffer).unwrap();
    let mut other = Simulation::new(&feed::scene("planar"), Some(ct)).unwrap();
    other.restore_keyframe(&buffer[..length]).unwrap();
    assert_eq!(feed(&mut other, 1, 12.5e-3, 500), []);
    feed(&mut simulation, 1, 12.5e-3, 500);
    assert_eq!(other.state().hash, simulation.state().hash);
}
