//! Tests of the phantoms: anatomy against closed forms of its own parameters, the same shape at every
//! spacing, and the same bits for every number of threads.

// Helpers of tests may fail a test.
#![allow(clippy::unwrap_used)]

use volume_io::phantom::{
    BlockSpec, FemurLandmarks, FemurSpec, SphereSpec, block, femur, femur_landmarks, sphere,
};
use volume_io::{HuStatistics, VolumeError, volume_hash};
use voxel_grid::Volume;

fn spec(spacing_m: f64) -> FemurSpec {
    FemurSpec { spacing_m, ..FemurSpec::default() }
}

fn hu_at(volume: &Volume, world_m: [f64; 3]) -> f64 {
    let voxel = volume.grid.voxel_at(world_m).map(|v| v.round().max(0.0) as usize);
    f64::from(volume.at(voxel).unwrap_or(i16::MIN))
}

/// Trilinear interpolation.
fn hu_between(volume: &Volume, world_m: [f64; 3]) -> f64 {
    let v = volume.grid.voxel_at(world_m);
    let base = v.map(f64::floor);
    let mut sum = 0.0;
    for corner in 0..8_usize {
        let bit = [corner & 1, corner >> 1 & 1, corner >> 2 & 1];
        let weight: f64 =
            (0..3).map(|a| if bit[a] == 1 { v[a] - base[a] } else { 1.0 - (v[a] - base[a]) }).product();
        let voxel = [0, 1, 2].map(|a| base[a] as usize + bit[a]);
        sum += weight * f64::from(volume.at(voxel).unwrap());
    }
    sum
}

fn along(origin: [f64; 3], direction: [f64; 3], s: f64) -> [f64; 3] {
    [0, 1, 2].map(|i| origin[i] + s * direction[i])
}

/// Mean of the voxels within `radius_m` of a point.
fn mean_around(volume: &Volume, center_m: [f64; 3], radius_m: f64) -> f64 {
    let steps = (radius_m / volume.grid.spacing_m()[0]).floor() as i64;
    let (mut sum, mut count) = (0.0, 0);
    for x in -steps..=steps {
        for y in -steps..=steps {
            for z in -steps..=steps {
                if x * x + y * y + z * z <= steps * steps {
                    let offset = [x, y, z].map(|n| n as f64 * volume.grid.spacing_m()[0]);
                    sum += hu_at(volume, [0, 1, 2].map(|i| center_m[i] + offset[i]));
                    count += 1;
                }
            }
        }
    }
    sum / f64::from(count)
}

/// Distance along a ray from outside to the first bone of 500 HU, in steps of 0.05 mm.
fn outer_radius_m(volume: &Volume, center_m: [f64; 3], direction: [f64; 3]) -> f64 {
    let mut s = 0.030;
    while hu_between(volume, along(center_m, direction, s)) < 500.0 && s > 0.0 {
        s -= 0.05e-3;
    }
    s
}

#[test]
fn landmarks_are_the_stated_anatomy() {
    let FemurLandmarks { neck_axis: n, head_center_m, entry_point_m, .. } =
        femur_landmarks(&spec(0.5e-3)).unwrap();
    let neck_shaft_deg = (-n[2]).acos().to_degrees();
    let anteversion_deg = (-n[1]).atan2(n[0]).to_degrees();
    println!(
        "neck-shaft angle {neck_shaft_deg:.3}, anteversion {anteversion_deg:.3} degrees, entry \
         {entry_point_m:?}"
    );
    assert!((neck_shaft_deg - 125.0).abs() < 1e-9 && (anteversion_deg - 15.0).abs() < 1e-9);
    assert_eq!(head_center_m, [-0.09, 0.0, 0.0]);
    // Right femur: the lateral side is −x, the head is medial, the neck points forward (−y) and up.
    assert!(entry_point_m[0] < -0.14 && entry_point_m[1] > 0.0 && entry_point_m[2] < -0.03);
    for angle_deg in [115.0_f64, 140.0] {
        let other = FemurSpec { neck_shaft_angle_rad: angle_deg.to_radians(), ..spec(0.5e-3) };
        let marks = femur_landmarks(&other).unwrap();
        assert!((0.065..0.110).contains(&marks.entry_to_head_center_m), "{}", marks.entry_to_head_center_m);
    }
}

#[test]
fn default_femur() {
    let volume = femur(&FemurSpec::default()).unwrap();
    let marks = femur_landmarks(&FemurSpec::default()).unwrap();
    assert_eq!(volume.grid.dims(), [240, 200, 320]);
    let hu = HuStatistics::of(&volume.hu);
    println!("{hu:?}");
    assert!(hu.min_hu >= -1000 && hu.max_hu <= 1700 && hu.max_hu > 1400);

    // A straight hole from the lateral cortex to the head centre: cortex first, then bone or marrow
    // throughout.
    let ray = |s: f64| hu_between(&volume, along(marks.entry_point_m, marks.neck_axis, s));
    assert!(ray(-1.5e-3) < 150.0, "soft tissue outside the entry point: {}", ray(-1.5e-3));
    assert!(ray(1.0e-3) > 700.0, "cortex inside the entry point: {}", ray(1.0e-3));
    let lowest = (0..750).map(|i| ray(f64::from(i) * 1e-4)).fold(f64::INFINITY, f64::min);
    println!("lowest on the way to the head centre: {lowest:.0} HU");
    assert!(lowest > -120.0, "no air and no fat on the way: {lowest}");

    // Densities by site, mean of a ball of 4 mm (cancellous HU from 0.56 and 0.22 g/cm3 would be 402 and 83).
    let local = |neck: f64, up: f64| {
        let p = along(marks.head_center_m, marks.neck_axis, neck);
        mean_around(&volume, [p[0], p[1], p[2] + up], 4e-3)
    };
    let head = local(0.0, 0.0);
    let ward = local(-36e-3, 0.0);
    let trochanter = mean_around(&volume, along(marks.greater_trochanter_m, [0.0, 0.0, -1.0], 12e-3), 4e-3);
    let crossing = marks.neck_shaft_crossing_m;
    let canal = mean_around(&volume, [crossing[0], crossing[1], crossing[2] - 0.085], 4e-3);
    println!(
        "HU: head {head:.0}, Ward {ward:.0}, greater trochanter {trochanter:.0}, marrow canal {canal:.0}"
    );
    assert!((350.0..800.0).contains(&head));
    assert!(ward < head - 250.0 && ward > -60.0);
    assert!((20.0..250.0).contains(&trochanter));
    assert!((-90.0..0.0).contains(&canal));

    // Cortical thickness of the shaft 85 mm below the crossing: 3 to 6.5 mm (width above 900 HU along ±x).
    for direction in [-1.0, 1.0] {
        let center = [crossing[0], crossing[1], crossing[2] - 0.085];
        let thick = (0..400).filter(|i| {
            hu_between(&volume, along(center, [direction, 0.0, 0.0], f64::from(*i) * 5e-5)) > 900.0
        });
        let thickness_m = thick.count() as f64 * 5e-5;
        println!("shaft cortex {:.2} mm", thickness_m * 1e3);
        assert!((3.0e-3..6.5e-3).contains(&thickness_m));
    }
}

/// The head is a sphere of the stated radius at every spacing: the shape does not depend on the voxels.
#[test]
fn same_shape_at_every_spacing() {
    for spacing_m in [0.5e-3, 1.0e-3, 2.0e-3] {
        let volume = femur(&spec(spacing_m)).unwrap();
        let marks = femur_landmarks(&spec(spacing_m)).unwrap();
        let mut worst = 0.0_f64;
        // Directions over the part of the head that faces away from the neck and the fovea.
        for azimuth in 0..12 {
            let a = f64::from(azimuth) * std::f64::consts::TAU / 12.0;
            let direction = [0.5 * a.cos(), 0.5 * a.sin(), 0.75_f64.sqrt()];
            let radius = outer_radius_m(&volume, marks.head_center_m, direction);
            worst = worst.max((radius - marks.head_radius_m).abs());
        }
        println!("{} mm: head radius off by at most {:.3} mm", spacing_m * 1e3, worst * 1e3);
        // A quarter of a voxel for the blended surface, 0.1 mm for the threshold and the step.
        assert!(worst < 0.25 * spacing_m + 0.1e-3);
    }
}

#[test]
fn threads_do_not_change_a_bit() {
    let hash = |threads| volume_hash(&femur(&FemurSpec { threads, ..spec(1.0e-3) }).unwrap());
    let one = hash(1);
    for threads in [0, 2, 3, 7] {
        assert_eq!(hash(threads), one, "{threads} threads");
    }
    let seeded = FemurSpec { seed: 2, ..spec(1.0e-3) };
    assert_ne!(volume_hash(&femur(&seeded).unwrap()), one);
}

/// The bits themselves, to detect any machine, compiler or change that alters them.
#[test]
fn known_hash() {
    let hash = volume_hash(&femur(&spec(2.0e-3)).unwrap());
    let text: String = hash.iter().map(|b| format!("{b:02x}")).collect();
    assert_eq!(text, "919aa7783e94fdc40758142f77ac98b278a93b426babf3b42d36b5bf0c042870");
}

#[test]
fn head_position_moves_everything() {
    let moved = FemurSpec { head_center_m: [0.25, -0.5, 1.0], ..spec(2.0e-3) };
    let (a, b) = (femur(&moved).unwrap(), femur(&spec(2.0e-3)).unwrap());
    for axis in 0..3 {
        let shift = a.grid.origin_m()[axis] - b.grid.origin_m()[axis];
        assert!((shift - (moved.head_center_m[axis] - [-0.09, 0.0, 0.0][axis])).abs() < 1e-15);
    }
    // Rounding of the positions may move a value across a half: no more than 1 HU.
    assert!(a.hu.iter().zip(&b.hu).all(|(x, y)| (i32::from(*x) - i32::from(*y)).abs() <= 1));
}

#[test]
fn sphere_has_the_volume_of_a_sphere() {
    let spec = SphereSpec::default();
    let volume = sphere(&spec).unwrap();
    let inside = volume.hu.iter().filter(|hu| **hu == spec.hu_inside).count() as f64 * 0.125e-9;
    let exact = 4.0 / 3.0 * std::f64::consts::PI * spec.radius_m.powi(3);
    println!("ball: {:.4} of the exact volume", inside / exact);
    // Lattice points in a ball of 20 voxels radius: the error of Gauss's problem is below 0.5 %.
    assert!((inside / exact - 1.0).abs() < 0.005);
}

#[test]
fn block_has_exact_counts() {
    let spec = BlockSpec::default();
    let volume = block(&spec).unwrap();
    let count = |value: i16| volume.hu.iter().filter(|hu| **hu == value).count();
    // 2.5 mm are five voxels on each side: 70 x 50 x 50 voxels, half of them below z = 0.
    assert_eq!(count(spec.hu_ahead), 70 * 50 * 25);
    assert_eq!(count(spec.hu_behind), 70 * 50 * 25);
    assert_eq!(count(spec.hu_outside), 80 * 60 * 60 - 70 * 50 * 50);
}

/// Regression: another voxel size made another object: the default's voxel counts were kept.
#[test]
fn another_voxel_size_does_not_change_the_object() {
    for spacing_m in [0.25e-3_f64, 0.5e-3, 0.7e-3, 1e-3, 2e-3] {
        let inside = |volume: Volume, air: i16| {
            let [ni, nj, _] = volume.grid.dims();
            let bone = (0..volume.hu.len()).filter(|index| volume.hu[*index] != air);
            let places: Vec<[f64; 3]> = bone
                .map(|n| volume.grid.world_m([n % ni, n / ni % nj, n / (ni * nj)].map(|i| i as f64)))
                .collect();
            let centre_m = [0, 1, 2]
                .map(|axis| places.iter().map(|place| place[axis]).sum::<f64>() / places.len() as f64);
            assert!(centre_m.iter().all(|x| x.abs() < 1e-9), "{spacing_m}: {centre_m:?}");
            (places.len() as f64 * spacing_m.powi(3) * 1e9, volume.grid.dims())
        };
        let ball = SphereSpec::with_spacing(spacing_m);
        let (ball_mm3, dims) = inside(sphere(&ball).unwrap(), ball.hu_outside);
        assert!((ball_mm3 / 4188.8 - 1.0).abs() < 0.06, "{spacing_m}: {ball_mm3} mm3, {dims:?}");
        let spec = BlockSpec::with_spacing(spacing_m);
        let (block_mm3, dims) = inside(block(&spec).unwrap(), spec.hu_outside);
        let wide = |mm: f64| mm + spacing_m * 1e3;
        let most = wide(35.0) * wide(25.0) * wide(25.0) * 1.0001;
        assert!((34.0 * 24.0 * 24.0..most).contains(&block_mm3), "{spacing_m}: {block_mm3} mm3, {dims:?}");
        assert!((dims[0] as f64 * spacing_m - 0.04).abs() < spacing_m, "{dims:?}");
    }
    assert_eq!(BlockSpec::with_spacing(0.5e-3), BlockSpec::default());
    assert_eq!(SphereSpec::with_spacing(0.5e-3), SphereSpec::default());
}

#[test]
fn unusable_specifications_are_refused() {
    let refused =
        |spec: FemurSpec| assert!(matches!(femur(&spec), Err(VolumeError::Argument { .. })), "{spec:?}");
    for spacing_m in [0.0, 0.1e-3, 3e-3, f64::NAN] {
        refused(spec(spacing_m));
    }
    refused(FemurSpec { neck_shaft_angle_rad: 1.0, ..FemurSpec::default() });
    refused(FemurSpec { anteversion_rad: f64::INFINITY, ..FemurSpec::default() });
    refused(FemurSpec { head_center_m: [f64::NAN; 3], ..FemurSpec::default() });
    let flat = BlockSpec { plane_normal: [0.0; 3], ..BlockSpec::default() };
    assert!(matches!(block(&flat), Err(VolumeError::Argument { .. })));
    let huge = BlockSpec { dims: [usize::MAX; 3], ..BlockSpec::default() };
    assert!(matches!(block(&huge), Err(VolumeError::TooLarge { .. })));
    let empty = SphereSpec { radius_m: 0.0, ..SphereSpec::default() };
    assert!(matches!(sphere(&empty), Err(VolumeError::Argument { .. })));
    let spaced = SphereSpec { spacing_m: [0.0; 3], ..SphereSpec::default() };
    assert!(matches!(sphere(&spaced), Err(VolumeError::Spacing { .. })));
}
