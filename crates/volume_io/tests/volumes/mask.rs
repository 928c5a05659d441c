//! Tests the distance transform against brute force, and masks filled with synthetic Hounsfield units.

// Helpers of tests may fail a test.
#![allow(clippy::unwrap_used)]

use crate::common::shared_data::shared;
use proptest::prelude::*;
use volume_io::phantom::{SphereSpec, sphere};
use volume_io::{HuStatistics, MaskModel, VolumeError, mask_to_hu, read, squared_distance_m2};
use voxel_grid::Volume;

/// Squared distance to the nearest site, by brute force.
fn brute_force(dims: [usize; 3], spacing_m: [f64; 3], sites: &[bool]) -> Vec<f64> {
    let place = |index: usize| {
        let voxel = [index % dims[0], index / dims[0] % dims[1], index / (dims[0] * dims[1])];
        [0, 1, 2].map(|axis| voxel[axis] as f64 * spacing_m[axis])
    };
    (0..sites.len())
        .map(|a| {
            let p = place(a);
            let squares = (0..sites.len()).filter(|b| sites[*b]).map(|b| {
                let q = place(b);
                (0..3).map(|axis| (p[axis] - q[axis]).powi(2)).sum::<f64>()
            });
            squares.fold(f64::INFINITY, f64::min)
        })
        .collect()
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 100, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn distance_transform_is_exact(
        dims in prop::array::uniform3(1_usize..9),
        spacing_mm in prop::array::uniform3(0.2..3.0_f64),
        bits in prop::collection::vec(0.0..1.0_f64, 512),
        density in 0.005..0.5_f64,
    ) {
        let count = dims.iter().product();
        let sites: Vec<bool> = bits[..count].iter().map(|b| *b < density).collect();
        let spacing_m = spacing_mm.map(|s| s * 1e-3);
        let fast = squared_distance_m2(dims, spacing_m, &sites);
        for (a, b) in fast.iter().zip(brute_force(dims, spacing_m, &sites)) {
            // f32 storage, rounded once per axis.
            let tolerance = 3.0 * f64::from(f32::EPSILON) * b;
            prop_assert!(f64::from(*a) == b || (f64::from(*a) - b).abs() <= tolerance, "{a} is not {b}");
        }
    }
}

#[test]
fn ball_gets_a_shell_of_the_stated_thickness() {
    let ball = SphereSpec { hu_inside: 1, hu_outside: 0, ..SphereSpec::default() };
    let mut volume = sphere(&ball).unwrap();
    let model = MaskModel {
        cortical_thickness_m: 2.0e-3,
        marrow_depth_m: 6.0e-3,
        soft_tissue_m: 3.0e-3,
        ..MaskModel::default()
    };
    mask_to_hu(&mut volume, &model).unwrap();
    let spacing_m = volume.grid.spacing_m()[0];
    let mut outer = [0.0_f64; 3];
    for (index, hu) in volume.hu.iter().enumerate() {
        let [ni, nj, _] = volume.grid.dims();
        let p = volume.grid.world_m([index % ni, index / ni % nj, index / (ni * nj)].map(|n| n as f64));
        let depth_m = ball.radius_m - (p[0] * p[0] + p[1] * p[1] + p[2] * p[2]).sqrt();
        // The ideal layers, with the surface of the voxel ball uncertain by one voxel.
        let expected = |depth: f64| match depth {
            d if d < -model.soft_tissue_m => model.air_hu,
            d if d < 0.0 => model.soft_tissue_hu,
            d if d < model.cortical_thickness_m => model.cortical_hu,
            d if d < model.marrow_depth_m => 0,
            _ => model.marrow_hu,
        };
        let (near, far) = (expected(depth_m - spacing_m), expected(depth_m + spacing_m));
        if near == far {
            if near == 0 {
                assert!(
                    (model.cancellous_inner_hu..=model.cancellous_outer_hu).contains(hu),
                    "{hu} at {depth_m}"
                );
            } else {
                assert_eq!(*hu, near, "depth {depth_m}");
            }
        }
        if *hu == model.cortical_hu {
            outer[0] = outer[0].max(depth_m);
        }
    }
    println!("deepest cortical voxel {:.2} mm", outer[0] * 1e3);
    assert!((outer[0] - model.cortical_thickness_m).abs() < spacing_m);
}

#[test]
fn real_femur_mask() {
    let Some(path) = shared("seed_rfemur_mask/rfemur_mask_1mm_cropped.nii.gz") else { return };
    let mut volume = read(path).unwrap();
    let bone = volume.hu.iter().filter(|v| **v != 0).count();
    assert_eq!((volume.grid.dims(), bone), ([85, 116, 190], 233_553));
    let model = MaskModel::default();
    mask_to_hu(&mut volume, &model).unwrap();
    let count = |value: i16| volume.hu.iter().filter(|v| **v == value).count();
    let (cortex, marrow) = (count(model.cortical_hu), count(model.marrow_hu));
    println!("cortex {cortex}, marrow {marrow} of {bone} voxels; {:?}", HuStatistics::of(&volume.hu));
    // A shell of 2 mm around 234 cm3 with about 300 cm2 of surface is a fifth to a third of it.
    assert!((0.15..0.4).contains(&(cortex as f64 / bone as f64)));
    assert!(marrow > 0 && marrow < bone / 4);
}

#[test]
fn what_is_not_a_mask_is_refused() {
    let ball = SphereSpec { hu_inside: 1, hu_outside: 0, ..SphereSpec::default() };
    let whole = sphere(&ball).unwrap();
    let refused = |hu: Vec<i16>| {
        let mut volume = Volume { hu, ..whole.clone() };
        let before = volume.clone();
        let error = mask_to_hu(&mut volume, &MaskModel::default()).unwrap_err();
        println!("{error}");
        assert!(matches!(error, VolumeError::Argument { .. }));
        assert_eq!(volume, before);
    };
    refused(vec![0; whole.hu.len()]);
    refused(vec![1; whole.hu.len()]);
    refused((0..whole.hu.len()).map(|i| (i % 3) as i16).collect());
    let mut volume = whole.clone();
    let thin = MaskModel { cortical_thickness_m: -1.0, ..MaskModel::default() };
    assert!(mask_to_hu(&mut volume, &thin).is_err());
}
