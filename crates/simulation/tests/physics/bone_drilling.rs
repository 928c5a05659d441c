//! Drilling against the energy balance: rate independent of voxel size and time step, energy conserved,
//! skiving at a density boundary, reset and snapshots.

#![allow(clippy::unwrap_used, reason = "a helper that cannot build its block fails the test")]

use crate::common::block::{Block, RADIUS_M, block, proportional};
use nalgebra::Vector3;
use simulation::bone::cutting::lever_share;
use simulation::bone::{
    BoneError, BoneField, BoneParameters, BurrContact, BurrState, ContactBuffer, CuttingLaw, GridGeometry,
    MaterialLaw, TickLoads, VoxelIndex,
};

/// 2250 rpm, the speed of the published curved-drilling experiments.
const SPEED_RAD_S: f64 = 235.6;
const ENERGY_J_M3: f64 = 1.0e7;

/// Moves the burr by `wish` as far as the contact planes allow: the nearest point of the half-spaces'
/// intersection.
fn move_burr(field: &BoneField, position: Vector3<f64>, wish: Vector3<f64>) -> Vector3<f64> {
    let mut buffer = ContactBuffer::with_capacity(16);
    field.voxels().contact_planes(0, &position, RADIUS_M, 0.3e-3, &mut buffer);
    let mut impulses = vec![0.0; buffer.planes().len()];
    let mut step = wish;
    for _ in 0..60 {
        for (plane, impulse) in buffer.planes().iter().zip(impulses.iter_mut()) {
            let push: f64 = -(plane.gap_m + plane.normal.dot(&step));
            let total = (*impulse + push).max(0.0);
            step += plane.normal.into_inner() * (total - *impulse);
            *impulse = total;
        }
    }
    position + step
}

struct Run {
    depth_m: f64,
    drift_m: Vector3<f64>,
    offered_j: f64,
    used_j: f64,
}

/// Presses the burr down with a constant force for `time_s`.
fn drill(
    block: &mut Block,
    start: Vector3<f64>,
    force_n: f64,
    dt_s: f64,
    time_s: f64,
) -> Result<Run, BoneError> {
    let mut position = start;
    let mut run = Run { depth_m: 0.0, drift_m: Vector3::zeros(), offered_j: 0.0, used_j: 0.0 };
    for _ in 0..(time_s / dt_s).round() as usize {
        let burr = BurrState {
            centre_m: position,
            radius_m: RADIUS_M,
            speed_rad_s: SPEED_RAD_S,
            normal_force_n: force_n,
        };
        let report = block.field.grind(&block.hu, &burr, dt_s)?;
        run.offered_j += report.energy_offered_j;
        run.used_j += report.energy_used_j;
        assert_eq!(report.refused_count, 0);
        position = move_burr(&block.field, position, Vector3::new(0.0, 0.0, -0.02e-3));
    }
    run.depth_m = start.z - position.z;
    run.drift_m = position - start;
    Ok(run)
}

/// Depth of a ball pressed into a flat face, from the removed volume: the cap pi d^2 (3R - d)/3 up to d = R,
/// then a cylinder.
fn depth_of_volume(volume_m3: f64, radius_m: f64) -> f64 {
    let pi = core::f64::consts::PI;
    let half_ball = 2.0 / 3.0 * pi * radius_m * radius_m * radius_m;
    if volume_m3 >= half_ball {
        return radius_m + (volume_m3 - half_ball) / (pi * radius_m * radius_m);
    }
    let (mut low, mut high) = (0.0, radius_m);
    for _ in 0..60 {
        let d = 0.5 * (low + high);
        if pi * d * d * (3.0 * radius_m - d) / 3.0 < volume_m3 { low = d } else { high = d }
    }
    low
}

/// The requirement is 5 %; the closed form neglects the reach's effect on the shape of the bottom, and the
/// voxels' roundness.
#[test]
fn depth_depends_neither_on_voxel_size_nor_on_time_step() {
    let force_n = 2.0;
    println!("depth (mm) after 2 s and 4 s, {force_n} N, 2250 rpm, u = 1e7 J/m3");
    let mut depths = Vec::new();
    for voxel_m in [0.25e-3, 0.5e-3, 1.0e-3] {
        for dt_s in [0.5e-3, 1.0e-3, 2.0e-3] {
            let run_for = |time_s: f64| {
                let mut block =
                    block([9e-3, 9e-3, 14e-3], voxel_m, MaterialLaw::uniform(ENERGY_J_M3), |_| 1000).unwrap();
                // Off the grid's symmetry planes.
                let start = Vector3::new(4.53e-3, 4.41e-3, block.top_m + RADIUS_M);
                drill(&mut block, start, force_n, dt_s, time_s).unwrap()
            };
            let (half, full) = (run_for(2.0), run_for(4.0));
            println!(
                "voxel {:.2} mm, dt {:.1} ms: {:.3} {:.3}   drift {:.3} mm, energy used {:.1} %",
                voxel_m * 1e3,
                dt_s * 1e3,
                half.depth_m * 1e3,
                full.depth_m * 1e3,
                full.drift_m.xy().norm() * 1e3,
                100.0 * full.used_j / full.offered_j,
            );
            depths.push((half.depth_m, full.depth_m));
        }
    }
    let power = CuttingLaw::default().power_w(&BurrState {
        centre_m: Vector3::zeros(),
        radius_m: RADIUS_M,
        speed_rad_s: SPEED_RAD_S,
        normal_force_n: force_n,
    });
    let exact = [2.0, 4.0].map(|t| depth_of_volume(power * t / ENERGY_J_M3, RADIUS_M + 1.0e-4));
    println!("closed form: {:.3} {:.3}", exact[0] * 1e3, exact[1] * 1e3);
    for (half, full) in &depths {
        let closed = |depth: f64, exact: f64| (depth / exact - 1.0).abs();
        assert!(closed(*half, exact[0]) < 0.06 && closed(*full, exact[1]) < 0.06);
        assert!((half - depths[0].0).abs() < 0.05 * depths[0].0);
        assert!((full - depths[0].1).abs() < 0.05 * depths[0].1);
    }
}

/// The burr runs along a 1:10 boundary: it must drift to the soft side, and in homogeneous bone it must not.
/// Prototype results with 0.3 mm voxels, 5 N, 8 mm: -0.6 to -1.9 mm at 1:10, at most 0.33 mm without (physics
/// notes, section 4).
#[test]
fn burr_skives_to_the_soft_side_only_at_a_boundary() {
    let middle = 6.0e-3;
    let skive = |left: i16, right: i16, off_grid_m: f64| {
        let hu_at = move |x: f64| if x < middle { left } else { right };
        let mut block = block([12e-3, 12e-3, 11e-3], 0.3e-3, proportional(), hu_at).unwrap();
        let start = Vector3::new(middle + off_grid_m, middle - 0.6 * off_grid_m, block.top_m + RADIUS_M);
        let mut run = drill(&mut block, start, 5.0, 1.0e-3, 0.2).unwrap();
        let mut time_s = 0.2;
        while run.depth_m < 8.0e-3 && time_s < 40.0 {
            let next = drill(&mut block, start + run.drift_m, 5.0, 1.0e-3, 0.2).unwrap();
            run.depth_m += next.depth_m;
            run.drift_m += next.drift_m;
            time_s += 0.2;
        }
        println!(
            "{left:>4} | {right:>4} HU: depth {:.2} mm after {time_s:.1} s, drift x {:.2} y {:.2} mm",
            run.depth_m * 1e3,
            run.drift_m.x * 1e3,
            run.drift_m.y * 1e3
        );
        run.drift_m
    };
    for hu in [200, 632, 2000] {
        // Off the grid's symmetry planes, so that the voxels could push sideways.
        assert!(skive(hu, hu, 0.07e-3).xy().norm() < 0.33e-3, "drift in homogeneous bone");
    }
    let (to_left, to_right) = (skive(200, 2000, 0.0), skive(2000, 200, 0.0));
    assert!(to_left.x < -0.6e-3 && to_right.x > 0.6e-3, "no drift to the soft side");
    assert!(to_left.y.abs() < 0.33e-3 && to_right.y.abs() < 0.33e-3);
}

/// The energy absorbed by the voxels equals the energy from the burr. Tolerance 1e-9: rounding of 1e5 sums.
#[test]
fn energy_is_conserved() {
    let mut block =
        block([9e-3, 9e-3, 9e-3], 0.5e-3, proportional(), |x| if x < 4e-3 { 300 } else { 1500 }).unwrap();
    let start = Vector3::new(4.5e-3, 4.4e-3, block.top_m + RADIUS_M);
    let run = drill(&mut block, start, 8.0, 1.0e-3, 3.0).unwrap();
    let booked = block.field.voxels().absorbed_energy_j(&block.hu).unwrap();
    let given = run.used_j;
    println!(
        "absorbed {booked:.12} J, supplied {given:.12} J, {} voxels removed",
        block.field.voxels().removed_total()
    );
    assert!(block.field.voxels().removed_total() > 200);
    assert!((booked - given).abs() < 1e-9 * given);
}

/// Below its edge force a burr cuts nothing; above it, the excess force cuts.
#[test]
fn a_burr_whose_edges_only_plough_cuts_nothing() {
    let material = MaterialLaw { edge_pressure_ref_pa: 2.0e6, ..MaterialLaw::default() };
    let mut block = block([9e-3, 9e-3, 14e-3], 0.5e-3, material, |_| 600).unwrap();
    let start = Vector3::new(4.53e-3, 4.41e-3, block.top_m + RADIUS_M);
    let bored = drill(&mut block, start, 60.0, 1.0e-3, 0.6).unwrap();
    println!("bored {:.2} mm deep", bored.depth_m * 1e3);
    assert!(bored.depth_m > RADIUS_M && bored.depth_m < 9.0e-3);
    let burr = |normal_force_n: f64| BurrState {
        centre_m: start + bored.drift_m,
        radius_m: RADIUS_M,
        speed_rad_s: SPEED_RAD_S,
        normal_force_n,
    };
    let up = BurrContact { normal: Vector3::z(), normal_force_n: 1.0, axis_cosine: 1.0, behind_m: 0.0 };
    let mut tick = |normal_force_n: f64| {
        let contacts = [BurrContact { normal_force_n, ..up }];
        let burr = burr(normal_force_n);
        let work = TickLoads { burr: &burr, behind: &[], contacts: &contacts, indentations: &[] };
        block.field.wear(&block.hu, work, 1.0e-3).unwrap()
    };
    let edge_n = tick(1.0e-3).edge_force_n;
    let before = (tick(0.99 * edge_n), tick(0.5 * edge_n));
    let above = tick(1.5 * edge_n);
    println!(
        "edge {edge_n:.3} N: {} J at 0.99 of it, {:.3e} J at 1.5",
        before.0.energy_used_j, above.energy_offered_j
    );
    assert!(edge_n > 0.0 && before.0.energy_used_j == 0.0 && before.1.energy_used_j == 0.0);
    let power_w =
        CuttingLaw::default().cutting_friction * 0.5 * edge_n * SPEED_RAD_S * RADIUS_M * lever_share(1.0);
    assert!((above.energy_offered_j / (power_w * 1.0e-3) - 1.0).abs() < 1e-9);
    assert!(above.energy_used_j > 0.0);
}

/// In bone too weak to absorb the burr's energy, the feed is limited by the teeth, not by the tick. Where two
/// layers of voxels lie within the reach both recede, so the limit is met within reach / voxel (20 % here).
#[test]
fn feed_limit_does_not_depend_on_the_time_step() {
    let feed = |dt_s: f64| {
        let mut block = block([9e-3, 9e-3, 12e-3], 0.5e-3, MaterialLaw::uniform(1.0e3), |_| 1000).unwrap();
        let start = Vector3::new(4.5e-3, 4.5e-3, block.top_m + RADIUS_M);
        drill(&mut block, start, 20.0, dt_s, 0.5).unwrap().depth_m / 0.5
    };
    let limit = CuttingLaw::default().feed_per_revolution_max_m * SPEED_RAD_S / core::f64::consts::TAU;
    let feeds = [0.25e-3, 0.5e-3, 1.0e-3].map(feed);
    println!("feed {:?} mm/s, limit {:.2} mm/s", feeds.map(|f| (f * 1e5).round() / 100.0), limit * 1e3);
    for f in feeds {
        assert!((f / feeds[0] - 1.0).abs() < 0.05 && f < 1.2 * limit && f > 0.5 * limit);
    }
}

/// State visible to a run: occupancy, remaining strength, counts.
fn fingerprint(field: &BoneField) -> Vec<u64> {
    let [nx, ny, nz] = field.voxels().geometry().dims;
    let mut all = vec![
        field.voxels().removed_total(),
        field.voxels().solid_count() as u64,
        field.voxels().pool_usage().0 as u64,
    ];
    for k in 0..nz {
        for j in 0..ny {
            all.extend((0..nx).map(|i| field.voxels().remaining_strength(i, j, k).to_bits()));
        }
    }
    all
}

/// Seeded defect S6: a reset must restore the strength as well as the voxels; the pilot hole belongs to the
/// scene and stays.
#[test]
fn reset_restores_voxels_and_strength_and_a_second_run_is_the_same() {
    let mut block = block([9e-3, 9e-3, 9e-3], 0.5e-3, proportional(), |_| 400).unwrap();
    let bottom = Vector3::new(4.5e-3, 4.5e-3, 0.0);
    let pilot = block.field.predrill_capsule(&bottom, &(bottom + Vector3::z() * 2e-3), 1.0e-3);
    assert!(!pilot.is_empty() && pilot.iter().all(|index| !block.field.voxels().is_solid_index(*index)));
    let fresh = fingerprint(&block.field);
    let start = Vector3::new(4.5e-3, 4.4e-3, block.top_m + RADIUS_M);
    drill(&mut block, start, 8.0, 1.0e-3, 2.0).unwrap();
    let drilled = fingerprint(&block.field);
    assert!(drilled != fresh && block.field.voxels().removed_total() > 100);
    block.field.reset();
    assert!(fingerprint(&block.field) == fresh);
    drill(&mut block, start, 8.0, 1.0e-3, 2.0).unwrap();
    assert!(fingerprint(&block.field) == drilled);
}

#[test]
fn snapshot_continues_bit_for_bit() {
    let mut block = block([9e-3, 9e-3, 9e-3], 0.5e-3, proportional(), |_| 400).unwrap();
    let start = Vector3::new(4.5e-3, 4.4e-3, block.top_m + RADIUS_M);
    let first = drill(&mut block, start, 8.0, 1.0e-3, 1.0).unwrap();
    let snapshot = block.field.voxels().snapshot();
    let here = start + first.drift_m;
    drill(&mut block, here, 8.0, 1.0e-3, 1.0).unwrap();
    let end = fingerprint(&block.field);
    block.field.restore(&snapshot).unwrap();
    assert!(block.field.voxels().snapshot() == snapshot);
    drill(&mut block, here, 8.0, 1.0e-3, 1.0).unwrap();
    assert!(fingerprint(&block.field) == end);
    let mut other = self::block([9e-3, 9e-3, 8e-3], 0.5e-3, proportional(), |_| 400).unwrap();
    assert!(matches!(other.field.restore(&snapshot), Err(BoneError::Snapshot { .. })));
}

/// The order of the voxels in memory must not matter: drilling the mirrored scene gives the mirrored result.
#[test]
fn mirrored_bone_is_drilled_mirrored() {
    let size = 21usize;
    let geometry = GridGeometry::axis_aligned([size; 3], [0.5e-3; 3], Vector3::zeros());
    let mut parameters = BoneParameters { material: proportional(), ..BoneParameters::default() };
    parameters.removed_per_tick = 100_000;
    let value = |i: usize, j: usize, k: usize| (200 + (i * 131 + j * 57 + k * 97) % 1500) as i16;
    let build = |mirror: bool| {
        let flip = |x: usize| if mirror { size - 1 - x } else { x };
        let hu: Vec<i16> = (0..size * size * size)
            .map(|n| value(flip(n % size), flip((n / size) % size), flip(n / (size * size))))
            .collect();
        (BoneField::new(geometry, &hu, parameters).unwrap(), hu)
    };
    let ((mut a, hu_a), (mut b, hu_b)) = (build(false), build(true));
    let middle = Vector3::repeat(5.0e-3);
    for n in 0..400 {
        let offset = Vector3::new(0.5e-3, -0.3e-3, 3.0e-3 - 1.0e-5 * n as f64);
        let burr = |centre_m| BurrState {
            centre_m,
            radius_m: RADIUS_M,
            speed_rad_s: SPEED_RAD_S,
            normal_force_n: 100.0,
        };
        a.grind(&hu_a, &burr(middle + offset), 1.0e-3).unwrap();
        b.grind(&hu_b, &burr(middle - offset), 1.0e-3).unwrap();
    }
    assert!(a.voxels().removed_total() > 100);
    for n in 0..size * size * size {
        let (i, j, k) = (n % size, (n / size) % size, n / (size * size));
        let (left, right) = (
            a.voxels().remaining_strength(i, j, k),
            b.voxels().remaining_strength(size - 1 - i, size - 1 - j, size - 1 - k),
        );
        // Sums run in opposite orders: rounding only.
        assert!((left - right).abs() < 1e-9, "{left} {right}");
    }
}

#[test]
fn limits_are_bounded_and_reported() {
    let geometry = GridGeometry::axis_aligned([40; 3], [0.5e-3; 3], Vector3::zeros());
    let hu = vec![1000i16; geometry.voxel_count()];
    let material = MaterialLaw::uniform(1.0e3);
    let burr = BurrState {
        centre_m: Vector3::repeat(10e-3),
        radius_m: RADIUS_M,
        speed_rad_s: 3000.0,
        normal_force_n: 100.0,
    };
    // A list of 10 voxels per tick: the rest waits; none is lost or duplicated.
    let mut field = BoneField::new(
        geometry,
        &hu,
        BoneParameters { removed_per_tick: 10, material, ..Default::default() },
    )
    .unwrap();
    let mut removed = Vec::new();
    let mut waited = 0;
    for tick in 0..200 {
        let force = if tick < 20 { 100.0 } else { 0.0 };
        let report = field.grind(&hu, &BurrState { normal_force_n: force, ..burr }, 1.0e-3).unwrap();
        assert!(
            report.removed_count <= 10 && field.voxels().removed_this_tick().len() == report.removed_count
        );
        waited = waited.max(report.waiting_count);
        removed.extend_from_slice(field.voxels().removed_this_tick());
    }
    removed.sort_unstable();
    let unique = removed.windows(2).all(|pair| pair[0] != pair[1]);
    assert!(unique && waited > 100 && removed.len() as u64 == field.voxels().removed_total());
    assert!(removed.iter().all(|index| !field.voxels().is_solid_index(*index)));
    let voxels = (0..geometry.voxel_count() as u32).map(VoxelIndex::new);
    let solid = voxels.filter(|index| field.voxels().is_solid_index(*index)).count();
    assert_eq!(removed.len() + solid, geometry.voxel_count());

    // One pool block: cutting continues inside it, the rest is counted.
    let mut field =
        BoneField::new(geometry, &hu, BoneParameters { pool_blocks: 1, material, ..Default::default() })
            .unwrap();
    let report = field.grind(&hu, &burr, 1.0e-3).unwrap();
    assert!(report.refused_count > 0 && report.cut_count > 0);
    assert_eq!(field.voxels().pool_usage(), (1, 1));

    for bad in [
        BurrState { radius_m: 1.0, ..burr },
        BurrState { speed_rad_s: f64::NAN, ..burr },
        BurrState { normal_force_n: -1.0, ..burr },
        BurrState { centre_m: Vector3::repeat(f64::INFINITY), ..burr },
    ] {
        let before = fingerprint(&field);
        assert!(matches!(field.grind(&hu, &bad, 1.0e-3), Err(BoneError::Burr { .. })));
        assert!(fingerprint(&field) == before);
    }
    // Away from bone, nothing is cut and all energy is unused.
    let far = BurrState { centre_m: Vector3::repeat(1.0), ..burr };
    let report = field.grind(&hu, &far, 1.0e-3).unwrap();
    assert_eq!((report.cut_count, report.energy_used_j), (0, 0.0));
}

/// Densities of the default law against its sources: 131 + 1.067 HU, and (rho / 1900)^2 x 5e7 J/m3.
#[test]
fn material_law_follows_its_formula() {
    let law = MaterialLaw::default();
    assert!((law.density_kg_m3(1000) - 1198.0).abs() < 1e-9);
    assert_eq!(law.density_kg_m3(-1000), 50.0);
    assert_eq!(law.density_kg_m3(3000), 2100.0);
    let ratio: f64 = 1198.0 / 1900.0;
    assert!((law.specific_energy_j_m3(1000) - 5.0e7 * ratio * ratio).abs() < 1.0);
    assert!(
        (proportional().specific_energy_j_m3(2000) / proportional().specific_energy_j_m3(200) - 10.0).abs()
            < 1e-9
    );
}
