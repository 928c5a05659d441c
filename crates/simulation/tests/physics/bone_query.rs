//! The contact query against closed forms (walls, corners, tunnels) and against a brute-force distance.

use nalgebra::{Matrix3, Rotation3, Vector3};
use proptest::prelude::*;
use simulation::bone::{BoneError, BoneField, BoneParameters, ContactBuffer, ContactKind, GridGeometry};
use simulation::contact_plane::ContactPlane;
use voxel_grid::GridError;

const RADIUS_M: f64 = 3.0e-3;
const MARGIN_M: f64 = 0.5e-3;

/// A field with bone where `solid` (voxel indices) is true.
fn field(geometry: GridGeometry, solid: impl Fn(usize, usize, usize) -> bool) -> BoneField {
    field_of(ContactKind::Planes, geometry, solid)
}

fn field_of(
    contact: ContactKind,
    geometry: GridGeometry,
    solid: impl Fn(usize, usize, usize) -> bool,
) -> BoneField {
    let [nx, ny, nz] = geometry.dims;
    let mut hu = Vec::with_capacity(geometry.voxel_count());
    for k in 0..nz {
        for j in 0..ny {
            hu.extend((0..nx).map(|i| if solid(i, j, k) { 1000i16 } else { -1000 }));
        }
    }
    let Ok(field) = BoneField::new(geometry, &hu, BoneParameters { contact, ..BoneParameters::default() })
    else {
        unreachable!("the tests' grids are valid");
    };
    field
}

fn planes(field: &BoneField, centre: Vector3<f64>, radius_m: f64) -> Vec<ContactPlane> {
    let mut buffer = ContactBuffer::with_capacity(16);
    field.voxels().contact_planes(7, &centre, radius_m, MARGIN_M, &mut buffer);
    assert_eq!(buffer.dropped(), 0);
    buffer.planes().to_vec()
}

fn rotated(dims: [usize; 3], spacing_m: [f64; 3], origin_world_m: Vector3<f64>) -> GridGeometry {
    let direction_world_grid = Rotation3::from_euler_angles(0.3, -0.7, 1.1).into_inner();
    GridGeometry { dims, spacing_m, direction_world_grid, origin_world_m }
}

/// Tolerance 1e-9 m: the gap on a flat wall is exact apart from rounding (1e-15 m at 10 m).
#[test]
fn flat_wall_is_exact_anisotropic_rotated_and_far_away() {
    let spacing = [0.4e-3, 0.5e-3, 0.7e-3];
    for origin in [Vector3::zeros(), Vector3::new(10.0, -7.0, 3.0)] {
        let geometry = rotated([40, 40, 40], spacing, origin);
        let field = field(geometry, |_, _, k| k < 20);
        let top = 19.5 * spacing[2];
        let mut worst: (f64, f64) = (0.0, 0.0);
        for n in 0..400 {
            let t = n as f64 / 400.0;
            // From 3.4 mm above the wall to 2 mm below it: in reach, resting, deep, buried.
            let local = Vector3::new(
                8e-3 + 0.4e-3 * (t * 37.0).fract(),
                10e-3 + 0.5e-3 * (t * 11.0).fract(),
                top + 3.4e-3 - 5.4e-3 * t,
            );
            let found = planes(&field, geometry.point_to_world(&local), RADIUS_M);
            assert_eq!(found.len(), 1, "one plane on a flat wall at {local:?}");
            let normal = geometry.direction_world_grid.column(2).into_owned();
            worst.0 = worst.0.max((found[0].gap_m - (local.z - top - RADIUS_M)).abs());
            worst.1 = worst.1.max((found[0].normal.into_inner() - normal).norm());
            let on_wall = geometry.point_to_grid(&found[0].point_m).z;
            assert!((on_wall - top).abs() < 1e-9);
        }
        println!(
            "flat wall at {:.0} m: gap error {:.1e} m, normal error {:.1e}",
            origin.norm(),
            worst.0,
            worst.1
        );
        assert!(worst.0 < 1e-9 && worst.1 < 1e-9);
    }
}

/// A bed of balls, the published contact model: distance and direction to the nearest ball. A sphere sliding
/// over a flat wall is rocked by balls but not by planes; the test prints by how much.
#[test]
fn voxels_as_balls_give_the_distance_to_the_nearest_ball() {
    let h = 0.5e-3;
    let geometry = rotated([40, 40, 40], [h; 3], Vector3::new(0.1, -0.2, 0.3));
    let [balls, flat] =
        [ContactKind::VoxelBalls, ContactKind::Planes].map(|kind| field_of(kind, geometry, |_, _, k| k < 20));
    let normal = geometry.direction_world_grid.column(2).into_owned();
    let (mut rocking, mut sinking): ([f64; 2], [f64; 2]) = ([0.0; 2], [0.0; 2]);
    for n in 0..200 {
        let x = (f64::from(n) + 0.5) / 200.0 * h;
        let local = Vector3::new(10e-3 + x, 10e-3 + 0.7 * x, 19.5 * h + RADIUS_M);
        // Offset from the nearest voxel centre.
        let near = |x: f64| x - (x / h).round() * h;
        let offset = Vector3::new(near(local.x), near(local.y), local.z - 19.0 * h);
        let found = planes(&balls, geometry.point_to_world(&local), RADIUS_M)[0];
        let direction = geometry.direction_world_grid * offset.normalize();
        // Tolerance: rounding at coordinates of tenths of a metre.
        assert!((found.gap_m - (offset.norm() - 0.5 * h - RADIUS_M)).abs() < 1e-12);
        assert!((found.normal.into_inner() - direction).norm() < 1e-9);
        let smooth = planes(&flat, geometry.point_to_world(&local), RADIUS_M)[0];
        for (kind, plane) in [found, smooth].iter().enumerate() {
            rocking[kind] = rocking[kind].max(plane.normal.dot(&normal).clamp(-1.0, 1.0).acos().to_degrees());
            sinking[kind] = sinking[kind].max(plane.gap_m.abs() * 1e6);
        }
    }
    println!("balls, planes on a flat wall: normal off by {rocking:.2?} degrees, gap by {sinking:.2?} um");
    assert!(rocking[0] > 3.0 && rocking[1] < 1e-5 && sinking[1] < 1e-6);
}

/// Seeded defect S1: contact must not depend on the anatomy's position.
#[test]
fn translation_by_ten_metres_changes_nothing() {
    let ball = |i: usize, j: usize, k: usize| {
        let d = |x: usize| (x as f64 - 24.0) * (x as f64 - 24.0);
        d(i) + d(j) + d(k) < 144.0
    };
    let shift = Vector3::new(10.0, -10.0, 10.0);
    let here = rotated([48; 3], [0.5e-3; 3], Vector3::zeros());
    let there = rotated([48; 3], [0.5e-3; 3], shift);
    let (a, b) = (field(here, ball), field(there, ball));
    for n in 0..200 {
        let angle = n as f64 * 0.1;
        let offset = Vector3::new(libm::cos(angle), libm::sin(angle), 0.01 * n as f64 - 1.0) * 7.0e-3;
        let centre = here.point_to_world(&(Vector3::repeat(12.0e-3) + offset));
        let (left, right) = (planes(&a, centre, RADIUS_M), planes(&b, centre + shift, RADIUS_M));
        assert_eq!(left.len(), right.len());
        for (p, q) in left.iter().zip(&right) {
            assert!((p.gap_m - q.gap_m).abs() < 1e-9, "{} {}", p.gap_m, q.gap_m);
            assert!((p.normal.into_inner() - q.normal.into_inner()).norm() < 1e-9);
        }
    }
}

#[test]
fn corner_gives_three_planes_and_each_its_own_gap() {
    let geometry = rotated([40; 3], [0.5e-3; 3], Vector3::new(0.1, 0.2, 0.3));
    let field = field(geometry, |i, j, k| i < 10 || j < 10 || k < 10);
    let wall = 9.5 * 0.5e-3;
    let local = Vector3::new(wall + 3.0e-3, wall + 2.95e-3, wall + 3.1e-3);
    let found = planes(&field, geometry.point_to_world(&local), RADIUS_M);
    assert_eq!(found.len(), 3);
    for plane in &found {
        let normal = geometry.direction_world_grid.tr_mul(&plane.normal.into_inner());
        let axis = (0..3).find(|a| normal[*a] > 1.0 - 1e-9).expect("a normal along an axis");
        assert!((plane.gap_m - [0.0, -0.05e-3, 0.1e-3][axis]).abs() < 1e-9);
    }
}

#[test]
fn tunnel_holds_from_opposite_sides() {
    let geometry = GridGeometry::axis_aligned([60; 3], [0.5e-3; 3], Vector3::zeros());
    let mut field = field(geometry, |_, _, _| true);
    let middle = Vector3::new(14.8e-3, 15.1e-3, 0.0);
    let axis = Vector3::new(0.15, 0.1, 1.0).normalize();
    field.predrill_capsule(&middle, &(middle + axis * 30e-3), 3.1e-3);
    let (mut least, mut steepest): (f64, f64) = (1.0, 0.0);
    for n in 0..40 {
        let found = planes(&field, middle + axis * (6e-3 + 0.4e-3 * n as f64), RADIUS_M);
        assert!(found.len() >= 3);
        for plane in &found {
            let most_opposed = found.iter().map(|p| p.normal.dot(&plane.normal)).fold(1.0, f64::min);
            least = least.min(-most_opposed);
            steepest = steepest.max(plane.normal.dot(&axis).abs());
        }
    }
    println!(
        "tunnel: every plane has one opposed by at least {least:.2} (cosine), tilt along the axis <= \
         {steepest:.2}"
    );
    assert!(least > 0.3, "a plane has no counterpart on the other side");
}

/// A slanted wall: the staircase's corners protrude from the plane; normal and gap must stay near the
/// plane's.
#[test]
fn slanted_wall_has_little_staircase_noise() {
    let geometry = GridGeometry::axis_aligned([64; 3], [0.5e-3; 3], Vector3::zeros());
    for slope in [0.1, 0.3, 0.5, 1.0] {
        let normal = Vector3::new(-slope, -0.37 * slope, 1.0).normalize();
        let offset = normal.dot(&Vector3::repeat(16.0e-3));
        let field = field(geometry, |i, j, k| {
            normal.dot(&(Vector3::new(i as f64, j as f64, k as f64) * 0.5e-3)) < offset
        });
        let (mut tilt, mut low, mut high): (f64, f64, f64) = (0.0, 1.0, -1.0);
        for n in 0..500 {
            let t = n as f64 / 500.0;
            let along = Vector3::new(4e-3 * t - 2e-3, 2e-3 * (7.0 * t).fract() - 1e-3, 0.0);
            let foot = Vector3::repeat(16.0e-3) + along - normal * normal.dot(&along);
            let found = planes(&field, foot + normal * RADIUS_M, RADIUS_M);
            assert!(!found.is_empty());
            tilt = tilt.max(libm::acos(found[0].normal.dot(&normal).min(1.0)).to_degrees());
            low = low.min(found[0].gap_m);
            high = high.max(found[0].gap_m);
        }
        println!("slope {slope}: tilt <= {tilt:.1} deg, gap {:.3} to {:.3} mm", low * 1e3, high * 1e3);
        // On a slope of 0.1 the steps are ten voxels long, beyond the smoothing range of the normal.
        let (most_tilt, most_gap) = if slope < 0.2 { (13.0, 0.35e-3) } else { (4.0, 0.15e-3) };
        assert!(tilt < most_tilt && low > -most_gap && high < most_gap);
    }
}

/// Regression test for a defect of the engine's voxel shape: a ball centred on a voxel boundary fell through.
#[test]
fn sphere_centred_on_a_voxel_boundary_is_held() {
    let h = 0.5e-3;
    let geometry = GridGeometry::axis_aligned([64; 3], [h; 3], Vector3::zeros());
    let field = field(geometry, |_, _, k| k < 30);
    for (x, y) in [(30.0, 30.0), (30.5, 30.0), (30.5, 30.5), (29.5, 33.0)] {
        let found = planes(&field, Vector3::new(x * h, y * h, 29.5 * h + RADIUS_M - 1e-5), RADIUS_M);
        assert_eq!(found.len(), 1);
        assert!((found[0].gap_m + 1e-5).abs() < 1e-9);
    }
    // Centre exactly in the wall's plane: half in, half out.
    let found = planes(&field, Vector3::new(30.5 * h, 30.5 * h, 29.5 * h), RADIUS_M);
    assert_eq!(found.len(), 1);
    assert!((found[0].gap_m + RADIUS_M).abs() < 1e-9);
}

#[test]
fn buried_sphere_is_led_out_and_air_is_free() {
    let geometry = GridGeometry::axis_aligned([64; 3], [0.5e-3; 3], Vector3::zeros());
    let solid = field(geometry, |_, _, _| true);
    let found = planes(&solid, Vector3::new(16e-3, 16e-3, 20e-3), RADIUS_M);
    assert_eq!(found.len(), 1);
    assert!((found[0].normal.z - 1.0).abs() < 1e-9);
    assert!((found[0].gap_m - (20e-3 - 63.5 * 0.5e-3 - RADIUS_M)).abs() < 1e-9);
    let air = field(geometry, |_, _, _| false);
    assert!(planes(&air, Vector3::new(16e-3, 16e-3, 20e-3), RADIUS_M).is_empty());
    assert!(planes(&solid, Vector3::new(16e-3, 16e-3, 99.0), RADIUS_M).is_empty());
    assert!(planes(&solid, Vector3::new(f64::NAN, 0.0, 0.0), RADIUS_M).is_empty());
}

#[test]
fn what_does_not_fit_is_refused_or_counted() {
    let geometry = GridGeometry::axis_aligned([4; 3], [1e-3; 3], Vector3::zeros());
    let new = |geometry, hu: &[i16]| BoneField::new(geometry, hu, BoneParameters::default());
    assert!(matches!(new(geometry, &[0; 63]), Err(BoneError::VolumeSize { given: 63, expected: 64 })));
    let sheared = Matrix3::new(1.0, 0.1, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0);
    let bad = GridGeometry { direction_world_grid: sheared, ..geometry };
    assert!(matches!(new(bad, &[0; 64]), Err(BoneError::Grid(GridError::Sheared { .. }))));
    let bad = GridGeometry { spacing_m: [1e-3, 0.0, 1e-3], ..geometry };
    assert!(matches!(new(bad, &[0; 64]), Err(BoneError::Grid(GridError::Spacing { .. }))));
    let field = new(geometry, &[1000; 64]).unwrap();
    let mut buffer = ContactBuffer::with_capacity(0);
    field.voxels().contact_planes(0, &Vector3::repeat(1e-3), 1e-3, 0.0, &mut buffer);
    assert_eq!((buffer.planes().len(), buffer.dropped()), (0, 1));
}

/// Distance from a point to the nearest solid voxel box, by brute force.
fn brute_force_distance(field: &BoneField, point: &Vector3<f64>) -> f64 {
    let geometry = field.voxels().geometry();
    let [nx, ny, nz] = geometry.dims;
    let mut best = f64::INFINITY;
    for index in 0..nx * ny * nz {
        let voxel = [index % nx, (index / nx) % ny, index / (nx * ny)];
        if field.voxels().is_solid(voxel[0], voxel[1], voxel[2]) {
            let square: f64 = (0..3)
                .map(|a| {
                    let h = geometry.spacing_m[a];
                    let d = ((point[a] - voxel[a] as f64 * h).abs() - 0.5 * h).max(0.0);
                    d * d
                })
                .sum();
            best = best.min(square.sqrt());
        }
    }
    best
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    /// Random bone (scattered to nearly full), random anisotropic rotated grid, random sphere: a sphere in
    /// reach of bone has a plane, one out of reach has none, and the nearest gap is the brute-force one,
    /// widened by at most half a voxel.
    #[test]
    fn no_sphere_in_bone_lacks_a_contact(
        bits in prop::collection::vec(any::<u8>(), 14 * 13 * 12),
        fill in 1u8..=255,
        spacing in prop::array::uniform3(0.3e-3..1.0e-3f64),
        place in prop::array::uniform3(-0.1..1.1f64),
        radius_m in 0.5e-3..4.0e-3f64,
    ) {
        let dims = [14, 13, 12];
        let geometry = rotated(dims, spacing, Vector3::new(1.0, 2.0, 3.0));
        let field = field(geometry, |i, j, k| bits[(k * 13 + j) * 14 + i] < fill);
        let local = Vector3::from_fn(|a, _| place[a] * dims[a] as f64 * spacing[a]);
        let exact = brute_force_distance(&field, &local);
        let mut buffer = ContactBuffer::with_capacity(16);
        field.voxels().contact_planes(0, &geometry.point_to_world(&local), radius_m, MARGIN_M, &mut buffer);
        let nearest = buffer.planes().iter().map(|p| p.gap_m).fold(f64::INFINITY, f64::min);
        if exact < radius_m + MARGIN_M - 1e-9 {
            prop_assert!(!buffer.planes().is_empty(), "distance {exact}, no plane");
            let half = 0.5 * spacing.iter().fold(f64::INFINITY, |low, h| low.min(*h));
            prop_assert!(nearest <= exact - radius_m + half + 1e-9, "{nearest} against {}", exact - radius_m);
            if exact > 0.0 {
                prop_assert!(nearest >= exact - radius_m - 1e-9, "{nearest} against {}", exact - radius_m);
            }
        } else if exact > radius_m + MARGIN_M + 1e-9 {
            prop_assert!(buffer.planes().is_empty());
        }
        for plane in buffer.planes() {
            prop_assert!(plane.gap_m.is_finite() && (plane.normal.norm() - 1.0).abs() < 1e-9);
        }
    }
}
