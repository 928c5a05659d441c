//! Fine voxels: the path does not depend on their size, and memory grows with the drilled volume.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use messages::Plant;
use nalgebra::Vector3;
use simulation::Simulation;
use simulation::bone::{BoneField, BoneParameters, BurrState, GridGeometry};

use crate::common::feed;

/// Length of a short feed, m: 4 mm through air, the rest in bone.
const SHORT_M: f64 = 7.0e-3;

fn fed(voxel_mm: f64, insertion_m: f64) -> (feed::FeedResult, f64) {
    let block = feed::Block::new(voxel_mm * 1e-3);
    let mut simulation = Simulation::new(&feed::scene("planar"), Some(block.ct())).unwrap();
    let fed = feed::feed(&mut simulation, insertion_m);
    let drilled_mm3 = fed.end.removed_total as f64 * block.voxel_mm3();
    (fed, drilled_mm3)
}

/// Regression: at 0.061 mm the burr was thrown 28 mm aside. Its 256 nearest voxels all belonged to one patch
/// of the wall around it, so it had one contact plane, and the memory for partly cut voxels ran out. The
/// whole feed at 0.06 and 0.03 mm is in `lab/physics/examples/fine_voxels.rs`.
#[test]
fn a_straight_feed_has_the_same_path_and_depth_at_every_voxel_size() {
    for (voxel_mm, insertion_m) in [(0.12, 36.0e-3), (0.06, 20.0e-3)] {
        let ((coarse, coarse_mm3), (fine, fine_mm3)) = (fed(0.25, insertion_m), fed(voxel_mm, insertion_m));
        let depth = |fed: &feed::FeedResult| fed.end.t_world_tip.position_m[2];
        let apart_m = fine.apart_m(&coarse);
        println!(
            "{voxel_mm} mm: depth {:.3} mm, path {:.3} mm apart, {fine_mm3:.1} mm³, {:.2} N",
            depth(&fine) * 1e3,
            apart_m * 1e3,
            fine.mean_force_n
        );
        // 2 % of the depth, and for the path, 2 % of the feed's length.
        assert!((depth(&fine) / depth(&coarse) - 1.0).abs() < 0.02, "{voxel_mm} mm");
        assert!(apart_m < 0.02 * insertion_m, "{voxel_mm} mm: {apart_m} m");
        // The hole is rough by half a voxel of 0.25 mm on a radius of 3.35 mm: 7 % of its volume at most.
        assert!((fine_mm3 / coarse_mm3 - 1.0).abs() < 0.07, "{voxel_mm} mm: {fine_mm3} mm³ of {coarse_mm3}");
    }
}

/// A field of 0.06 mm voxels with a hole in which the burr starts, and its CT.
fn fine_field() -> (BoneField, Vec<i16>) {
    let geometry = GridGeometry::axis_aligned([120, 120, 620], [6.0e-5; 3], Vector3::zeros());
    let hu = vec![600; geometry.voxel_count()];
    (BoneField::new(geometry, &hu, BoneParameters::default()).unwrap(), hu)
}

/// The burr moving along z by 0.1 mm per tick of 10 ms, with more energy than the bone absorbs.
fn burr(tick: usize) -> BurrState {
    BurrState {
        centre_m: Vector3::new(3.6e-3, 3.6e-3, tick as f64 * 1.0e-4),
        radius_m: 3.25e-3,
        speed_rad_s: 838.0,
        normal_force_n: 500.0,
    }
}

/// Regression: after 4096 blocks of 8 x 8 x 8 voxels, the burr silently stopped cutting.
#[test]
fn a_burr_cuts_as_long_as_there_is_bone() {
    let (mut field, hu) = fine_field();
    let mut removed = 0;
    for tick in 0..360 {
        let report = field.grind(&hu, &burr(tick), 1e-2).unwrap();
        assert_eq!((report.refused_count, report.waiting_count), (0, 0), "tick {tick}");
        assert!(report.removed_count > 0, "tick {tick} removed nothing");
        removed = removed.max(report.removed_count);
        field.make_room();
    }
    let (used, most) = field.voxels().pool_usage();
    println!(
        "{used} of {most} blocks, up to {removed} voxels in a tick, {} bytes",
        field.voxels().pool_bytes()
    );
    assert!(used > 4096 && removed > 4096, "the test must go beyond both former limits: {used}, {removed}");
}

#[test]
fn memory_taken_between_ticks_or_within_them_gives_the_same_bits() {
    let ((mut between, hu), (mut within, _)) = (fine_field(), fine_field());
    for tick in 0..300 {
        between.make_room();
        let reports = [&mut between, &mut within].map(|field| field.grind(&hu, &burr(tick), 1e-2).unwrap());
        assert_eq!(reports[0], reports[1], "tick {tick}");
        assert_eq!(between.voxels().removed_this_tick(), within.voxels().removed_this_tick(), "tick {tick}");
    }
    assert!(between.voxels().pool_usage().0 > 4096, "{:?}", between.voxels().pool_usage());
    assert!(between.voxels().pool_bytes() > within.voxels().pool_bytes(), "only one of them has a reserve");
    assert_eq!(between.voxels().snapshot(), within.voxels().snapshot());
}

/// A keyframe of many fully used blocks, restored into a field that has not allocated memory yet.
#[test]
fn a_keyframe_of_fine_voxels_restores_to_the_same_bits() {
    let block = feed::Block::new(0.12e-3);
    let scene = feed::scene("planar");
    let mut simulation = Simulation::new(&scene, Some(block.ct())).unwrap();
    let mut other = Simulation::new(&scene, Some(block.ct())).unwrap();
    for tick in 0..2000 {
        simulation.step(&feed::latched(tick, SHORT_M)).unwrap();
    }
    let mut buffer = vec![0; messages::services::MAX_KEYFRAME_BYTES];
    let length = simulation.write_keyframe(&mut buffer).unwrap();
    other.restore_keyframe(&buffer[..length]).unwrap();
    for tick in 2000..2200 {
        simulation.step(&feed::latched(tick, SHORT_M)).unwrap();
        other.step(&feed::latched(tick, SHORT_M)).unwrap();
        assert_eq!(simulation.state().hash, other.state().hash, "tick {tick}");
    }
    assert!(simulation.state().removed_total > 10_000, "{}", simulation.state().removed_total);
    assert_eq!(Plant::uncut_voxels(&simulation), 0);
}
