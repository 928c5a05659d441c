//! The published removal rules next to the energy rule.

#![allow(clippy::unwrap_used, reason = "a helper that cannot build its block fails the test")]

use crate::common::block::{RADIUS_M, block, proportional};
use nalgebra::Vector3;
use simulation::bone::removal::RULE_SPEED_RAD_S;
use simulation::bone::{BoneField, BoneParameters, BurrState, ContactBuffer, Removal};

/// Presses a burr for `ticks` with one of the rules; returns the voxels removed in each tick.
fn removed_by(removal: Removal, voxel_m: f64, hu: i16, ticks: usize, speed: f64) -> Vec<usize> {
    let mut block = block([9e-3, 9e-3, 9e-3], voxel_m, proportional(), |_| hu).unwrap();
    let parameters = BoneParameters { removal, material: proportional(), ..BoneParameters::default() };
    block.field = BoneField::new(*block.field.voxels().geometry(), &block.hu, parameters).unwrap();
    let burr = BurrState {
        centre_m: Vector3::new(4.5e-3, 4.4e-3, block.top_m + RADIUS_M - 0.2e-3),
        radius_m: RADIUS_M,
        speed_rad_s: speed,
        normal_force_n: 1.0,
    };
    (0..ticks).map(|_| block.field.grind(&block.hu, &burr, 1e-3).unwrap().removed_count).collect()
}

#[test]
fn published_rules_of_removal_do_what_they_say() {
    // Naive: all at once, whatever the material.
    for hu in [200, 2000] {
        let naive = removed_by(Removal::Naive, 0.3e-3, hu, 3, RULE_SPEED_RAD_S);
        assert!(naive[0] > 20 && naive[1..] == [0, 0], "{naive:?}");
        // Capped: ten per tick, half as many at half the speed.
        let capped = removed_by(Removal::Capped, 0.3e-3, hu, 2, RULE_SPEED_RAD_S);
        assert_eq!(capped, [10, 10]);
        assert_eq!(removed_by(Removal::Capped, 0.3e-3, hu, 2, 0.5 * RULE_SPEED_RAD_S), [5, 5]);
    }
    // Decrement: 150 ticks at the reference density (2000), a tenth of that at a tenth of the density; half
    // the speed takes twice the time.
    let ends = |hu, speed: f64| {
        removed_by(Removal::Decrement, 0.3e-3, hu, 400, speed).iter().position(|count| *count > 0).unwrap()
            + 1
    };
    assert_eq!([ends(2000, RULE_SPEED_RAD_S), ends(200, RULE_SPEED_RAD_S)], [150, 15]);
    assert_eq!(ends(2000, 0.5 * RULE_SPEED_RAD_S), 300);
    // Independent of voxel size: the rule does not use the volume.
    let coarse = removed_by(Removal::Decrement, 0.5e-3, 2000, 200, RULE_SPEED_RAD_S);
    assert_eq!(coarse.iter().position(|count| *count > 0), Some(149));
    // The energy rule does.
    let energy = |voxel_m| removed_by(Removal::Energy, voxel_m, 200, 1, RULE_SPEED_RAD_S)[0];
    assert_eq!(energy(0.3e-3), 0, "a tick's energy is less than a voxel's");
}

#[test]
fn a_dose_shows_as_strength_and_not_as_a_receded_surface() {
    let mut block = block([9e-3, 9e-3, 9e-3], 0.5e-3, proportional(), |_| 2000).unwrap();
    let parameters =
        BoneParameters { removal: Removal::Decrement, material: proportional(), ..BoneParameters::default() };
    block.field = BoneField::new(*block.field.voxels().geometry(), &block.hu, parameters).unwrap();
    let centre_m = Vector3::new(4.25e-3, 4.25e-3, block.top_m + RADIUS_M);
    let burr = BurrState { centre_m, radius_m: RADIUS_M, speed_rad_s: RULE_SPEED_RAD_S, normal_force_n: 1.0 };
    let gap = |field: &BoneField| {
        let mut buffer = ContactBuffer::with_capacity(16);
        field.voxels().contact_planes(0, &centre_m, RADIUS_M, 1e-3, &mut buffer);
        buffer.planes()[0].gap_m
    };
    let before = gap(&block.field);
    (0..75).for_each(|_| {
        block.field.grind(&block.hu, &burr, 1e-3).unwrap();
    });
    let top = block.field.voxels().geometry().dims[2] - 2;
    let left = block.field.voxels().remaining_strength(8, 8, top);
    println!("strength {left:.6} after 75 of 150 ticks, gap {:.1e} m farther", gap(&block.field) - before);
    assert!((left - 0.5).abs() < 1e-9 && (gap(&block.field) - before).abs() < 1e-9);
    let saved = block.field.voxels().snapshot();
    block.field.reset();
    assert_eq!(block.field.voxels().remaining_strength(8, 8, top), 1.0);
    block.field.restore(&saved).unwrap();
    assert_eq!(block.field.voxels().remaining_strength(8, 8, top), left);
}
