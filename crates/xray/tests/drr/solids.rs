//! Closed meshes in the beam against closed forms and against Parry's ray casting, and the arm of a scene.

use std::sync::Arc;

use messages::{Pose, State};
use parry3d_f64::math::Vector;
use parry3d_f64::query::{Ray, RayCast};
use parry3d_f64::shape::TriMesh;
use scene::closed_mesh::ClosedMesh;
use xray::arm_model::ArmModel;
use xray::{
    ALUMINIUM_G_PER_CM3, CArm, DetectorParameters, DrrError, DrrParameters, DrrRenderer, FrameSeed, Grid,
    Material, PlacedSolids, Spectrum, Tool, ToolPart, VolumeView, weights,
};
use zerocopy::FromZeros;

use crate::machine::Desk;
use crate::slice_ordered::random;

/// A number from `low` to `high`, the same for the same `n`.
fn between(n: u64, low: f64, high: f64) -> f64 {
    low + (high - low) * (random(n) >> 11) as f64 / (1_u64 << 53) as f64
}

/// A pose near the origin in any orientation.
pub fn any_pose(n: u64, range_m: f64) -> Pose {
    let quaternion: [f64; 4] = std::array::from_fn(|i| between(10 * n + i as u64, -1.0, 1.0));
    let length = quaternion.iter().map(|x| x * x).sum::<f64>().sqrt();
    Pose {
        position_m: std::array::from_fn(|i| between(10 * n + 4 + i as u64, -range_m, range_m)),
        orientation_xyzw: quaternion.map(|x| x / length),
    }
}

pub fn turned([x, y, z, w]: [f64; 4], v: [f64; 3]) -> [f64; 3] {
    let cross = |a: [f64; 3], b: [f64; 3]| {
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    };
    let t = cross([x, y, z], v).map(|c| 2.0 * c);
    let across = cross([x, y, z], t);
    [0, 1, 2].map(|i| v[i] + w * t[i] + across[i])
}

/// A surface over two angles: periodic in both, as a torus, or from pole to pole, as a ball.
fn surface(steps: [usize; 2], is_torus: bool, at: impl Fn(f64, f64) -> [f64; 3]) -> ClosedMesh {
    let [m, n] = steps;
    let turn = std::f64::consts::TAU;
    let point = |i: usize, j: usize| {
        let v = if is_torus { turn * (j % n) as f64 / n as f64 } else { 0.5 * turn * j as f64 / n as f64 };
        // A pole is one point, whatever the first angle.
        let is_pole = !is_torus && (j == 0 || j == n);
        at(if is_pole { 0.0 } else { turn * (i % m) as f64 / m as f64 }, v).map(|x| x as f32)
    };
    let mut triangles = Vec::new();
    for i in 0..m {
        for j in 0..n {
            let [a, b, c, d] = [point(i, j), point(i + 1, j), point(i + 1, j + 1), point(i, j + 1)];
            triangles.push([a, b, c]);
            triangles.push([a, c, d]);
        }
    }
    ClosedMesh::new(&triangles).unwrap()
}

fn ball(radius_m: f64, steps: usize) -> ClosedMesh {
    // The poles' points must be bit-identical.
    surface([steps, steps / 2], false, |u, v| {
        let across = if v == 0.0 || v > 0.999 * std::f64::consts::PI { 0.0 } else { v.sin() };
        [radius_m * across * u.cos(), radius_m * across * u.sin(), radius_m * v.cos()]
    })
}

fn torus(radius_m: f64, tube_m: f64) -> ClosedMesh {
    surface([40, 24], true, |u, v| {
        let out = radius_m + tube_m * v.cos();
        [out * u.cos(), out * u.sin(), tube_m * v.sin()]
    })
}

pub fn cuboid(half_m: [f32; 3]) -> ClosedMesh {
    let corner =
        |n: usize| [0, 1, 2].map(|axis| if n >> axis & 1 == 1 { half_m[axis] } else { -half_m[axis] });
    let quads = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
    let halves = quads.iter().flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]);
    ClosedMesh::new(&halves.map(|triangle| triangle.map(corner)).collect::<Vec<_>>()).unwrap()
}

/// Line integrals of a frame that shows only this tool.
pub fn shown(c_arm: &CArm, tool: &Tool, parameters: DrrParameters) -> Vec<f64> {
    let grid = Grid::centred([4; 3], [1e-3; 3]).unwrap();
    let view_hu = vec![-1000; grid.voxels()];
    let view = VolumeView::new(grid, &view_hu).unwrap();
    let detector = DetectorParameters { quantum_noise: false, blur_sigma_px: 0.0, ..Default::default() };
    let mut renderer = DrrRenderer::new(&view, DrrParameters { detector, ..parameters }, &Desk).unwrap();
    let mut image = vec![0; c_arm.pixels()];
    renderer.render(&view, c_arm, tool, FrameSeed::default(), &mut image).unwrap();
    renderer.line_integrals()
}

fn arm_of(solids: Vec<ClosedMesh>, poses: &[Pose]) -> Tool {
    let arm = PlacedSolids::new(Arc::from(solids), poses, ALUMINIUM_G_PER_CM3).unwrap();
    Tool { parts: Vec::new(), arm: Some(arm), ..Tool::default() }
}

/// Metres on each pixel's ray, row-major.
fn metres(c_arm: &CArm, tool: &Tool, threads: usize) -> Vec<f64> {
    let parameters = DrrParameters { threads, ..Default::default() };
    let mu_per_m = Material::Aluminium.mu_per_m(parameters.energy_kev).unwrap();
    shown(c_arm, tool, parameters).into_iter().map(|value| value / mu_per_m).collect()
}

/// Source and direction of each pixel's ray in the frame of a pose; the direction reaches the pixel.
fn rays(c_arm: &CArm, pose: &Pose) -> Vec<([f64; 3], [f64; 3])> {
    let [x, y, z, w] = pose.orientation_xyzw;
    let pixels = (0..c_arm.rows).flat_map(|row| (0..c_arm.columns).map(move |column| (column, row)));
    let ray = |(column, row): (u32, u32)| {
        let end = c_arm.pixel_m(f64::from(column), f64::from(row));
        let from = [0, 1, 2].map(|i| c_arm.source_m[i] - pose.position_m[i]);
        let way = [0, 1, 2].map(|i| end[i] - c_arm.source_m[i]);
        (turned([-x, -y, -z, w], from), turned([-x, -y, -z, w], way))
    };
    pixels.map(ray).collect()
}

pub fn norm(v: [f64; 3]) -> f64 {
    v.iter().map(|x| x * x).sum::<f64>().sqrt()
}

#[test]
fn a_box_is_as_long_on_every_ray_as_between_its_faces() {
    let half_m = [0.011_f32, 0.017, 0.006];
    let (mut worst, mut hit) = (0.0_f64, 0);
    for n in 0..40 {
        let c_arm =
            crate::poses::c_arm(between(900 + n, -90.0, 90.0), between(950 + n, -40.0, 40.0), 64, 0.08);
        let pose = any_pose(n, 0.01);
        let found = metres(&c_arm, &arm_of(vec![cuboid(half_m)], &[pose]), 1);
        for (found, (from, way)) in found.iter().zip(rays(&c_arm, &pose)) {
            let (mut near, mut far) = (0.0_f64, 1.0_f64);
            for axis in 0..3 {
                let ends = [-1.0, 1.0].map(|side| (side * f64::from(half_m[axis]) - from[axis]) / way[axis]);
                (near, far) = (near.max(ends[0].min(ends[1])), far.min(ends[0].max(ends[1])));
            }
            let expected = (far - near).max(0.0) * norm(way);
            hit += usize::from(expected > 0.0);
            worst = worst.max((found - expected).abs());
        }
    }
    println!("box: {hit} rays through it, worst {worst:.1e} m");
    // Rounding of depths of about a metre.
    assert!(hit > 5_000 && worst < 1e-12);
}

#[test]
fn a_ball_of_ever_more_facets_comes_to_its_chord() {
    let (radius_m, pose) = (0.02, any_pose(77, 0.005));
    let c_arm = crate::poses::c_arm(25.0, -10.0, 64, 0.08);
    let mut before = f64::INFINITY;
    for steps in [32, 64, 128, 256] {
        let found = metres(&c_arm, &arm_of(vec![ball(radius_m, steps)], &[pose]), 2);
        let mut worst = 0.0_f64;
        for (found, (from, way)) in found.iter().zip(rays(&c_arm, &pose)) {
            let along = (0..3).map(|i| from[i] * way[i]).sum::<f64>() / norm(way);
            let squared = radius_m * radius_m - (norm(from).powi(2) - along * along);
            let expected = 2.0 * squared.max(0.0).sqrt();
            // Where a ray grazes, the chord's sensitivity is unbounded.
            if expected > radius_m {
                worst = worst.max((found - expected).abs());
            }
        }
        println!("ball of {steps} steps: worst {worst:.2e} m");
        // To first order the sagitta of a quad, r (1 - cos(pi / n)) each way, where the ray enters and
        // leaves, over the least cosine of 1/2; so a quarter with twice the steps. Corners are rounded to
        // single precision.
        let sagitta_m = radius_m * (1.0 - (std::f64::consts::PI / steps as f64).cos());
        assert!(worst < 1.1 * 8.0 * sagitta_m + 1e-8 && worst < 0.35 * before);
        before = worst;
    }
}

/// Path length from Parry's successive entry and exit points.
fn parrys_length_m(mesh: &TriMesh, from: [f64; 3], way: [f64; 3]) -> f64 {
    let length = norm(way);
    let (origin, direction) = (Vector::from(from), Vector::from(way.map(|x| x / length)));
    let (mut t, mut inside_m, mut entered) = (0.0, 0.0, None);
    while let Some(step) = mesh.cast_local_ray(&Ray::new(origin + direction * t, direction), 10.0, false) {
        t += step;
        match entered.take() {
            None => entered = Some(t),
            Some(at) => inside_m += t - at,
        }
        t += 1e-9;
    }
    inside_m
}

#[test]
fn meshes_that_are_not_convex_are_as_long_as_parrys_rays_find_them() {
    let solids = [torus(0.02, 0.006), torus(0.03, 0.01), cuboid([0.02, 0.005, 0.01])];
    let (mut rays_through, mut off) = (0, Vec::new());
    for n in 0..30 {
        let c_arm =
            crate::poses::c_arm(between(500 + n, -120.0, 120.0), between(600 + n, -40.0, 40.0), 48, 0.1);
        let poses: Vec<Pose> = (0..3).map(|i| any_pose(700 + 3 * n + i, 0.02)).collect();
        let found = metres(&c_arm, &arm_of(solids.to_vec(), &poses), 2);
        let mut expected = vec![0.0; found.len()];
        for (solid, pose) in solids.iter().zip(&poses) {
            let corners = solid.corners().iter().map(|corner| Vector::from(*corner)).collect();
            let mesh = TriMesh::new(corners, solid.triangles().to_vec()).unwrap();
            for (sum, (from, way)) in expected.iter_mut().zip(rays(&c_arm, pose)) {
                *sum += parrys_length_m(&mesh, from, way);
            }
        }
        rays_through += expected.iter().filter(|length_m| **length_m > 0.0).count();
        off.extend(found.iter().zip(&expected).map(|(a, b)| (a - b).abs()));
    }
    off.sort_by(f64::total_cmp);
    let (worst, beyond) = (off[off.len() - 1], off.iter().filter(|off| **off > 1e-7).count());
    println!("{rays_through} rays through meshes: worst {worst:.1e} m, {beyond} beyond 1e-7 m");
    // Parry can find an edge twice or not at all where a ray meets it to within rounding, which is very rare.
    assert!(rays_through > 10_000 && beyond * 10_000 < rays_through);
}

/// A slab of cells as large as pixels, cut along the rays: all its corners lie exactly on pixel centres, and
/// all its edges on rows, on columns or through centres. A pixel is either inside or outside.
#[test]
fn pixels_on_edges_and_corners_are_counted_once() {
    let pitch_m = 1.0 / 1024.0;
    let c_arm = CArm {
        source_m: [0.0, -0.5, 0.0],
        detector_centre_m: [0.0, 0.5, 0.0],
        row_axis: [1.0, 0.0, 0.0],
        column_axis: [0.0, 0.0, -1.0],
        pixel_pitch_m: [pitch_m; 2],
        columns: 33,
        rows: 33,
    };
    // From pixel 5 to 25 each way; at half and at three quarters of the way to the detector.
    let corner = |share: f64| {
        move |i: i32, j: i32| {
            let [x, z] = [i - 16, 16 - j].map(|n| f64::from(n) * pitch_m * share);
            [x, share - 0.5, z].map(|x| x as f32)
        }
    };
    let (front, back) = (corner(0.5), corner(0.75));
    let mut triangles = Vec::new();
    let mut quad = |[a, b, c, d]: [[f32; 3]; 4]| triangles.extend([[a, b, c], [a, c, d]]);
    for n in 5..25 {
        for m in 5..25 {
            quad([front(n, m), front(n + 1, m), front(n + 1, m + 1), front(n, m + 1)]);
            quad([back(n, m), back(n, m + 1), back(n + 1, m + 1), back(n + 1, m)]);
        }
        quad([front(n + 1, 5), front(n, 5), back(n, 5), back(n + 1, 5)]);
        quad([front(n, 25), front(n + 1, 25), back(n + 1, 25), back(n, 25)]);
        quad([front(5, n), front(5, n + 1), back(5, n + 1), back(5, n)]);
        quad([front(25, n + 1), front(25, n), back(25, n), back(25, n + 1)]);
    }
    let slab = ClosedMesh::new(&triangles).unwrap();
    let here = Pose { position_m: [0.0; 3], orientation_xyzw: [0.0, 0.0, 0.0, 1.0] };
    let found = metres(&c_arm, &arm_of(vec![slab], &[here]), 2);
    for (index, (found, (_, way))) in found.iter().zip(rays(&c_arm, &here)).enumerate() {
        let pixel = [index % 33, index / 33];
        let full_m = 0.25 * norm(way);
        let is = |length_m: f64| (found - length_m).abs() < 1e-14;
        if pixel.iter().all(|n| (6..25).contains(n)) {
            assert!(is(full_m), "{pixel:?} is inside: {found} of {full_m} m");
        } else if pixel.iter().all(|n| (5..=25).contains(n)) {
            assert!(is(full_m) || is(0.0), "{pixel:?} is on the border: {found} of {full_m} m");
        } else {
            assert!(*found == 0.0, "{pixel:?} is outside: {found} m");
        }
    }
}

#[test]
fn frames_do_not_depend_on_the_threads_and_meshes_behind_source_and_detector_do_not_show() {
    let c_arm = crate::poses::c_arm(10.0, 5.0, 96, 0.1);
    let tool = arm_of(vec![torus(0.02, 0.006), ball(0.015, 32)], &[any_pose(1, 0.01), any_pose(2, 0.02)]);
    let one = metres(&c_arm, &tool, 1);
    assert!(one.iter().any(|length_m| *length_m > 0.01));
    for threads in [2, 3, 8] {
        let bits = |values: &[f64]| values.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(&one), bits(&metres(&c_arm, &tool, threads)), "{threads} threads");
    }
    // Along the central ray: far behind the source, far behind the detector, and around each of them.
    let centre = c_arm.detector_centre_m;
    let at = |share: f64| Pose {
        position_m: [0, 1, 2].map(|i| c_arm.source_m[i] + share * (centre[i] - c_arm.source_m[i])),
        orientation_xyzw: [0.0, 0.0, 0.0, 1.0],
    };
    let middle = (c_arm.rows / 2 * c_arm.columns + c_arm.columns / 2) as usize;
    for (share, expected) in [(-0.5, 0.0), (1.5, 0.0), (0.0, 0.1), (1.0, 0.1), (0.5, 0.2)] {
        let found = metres(&c_arm, &arm_of(vec![ball(0.1, 128)], &[at(share)]), 2)[middle];
        assert!((found - expected).abs() < 3e-4, "at {share} of the ray: {found} m, expected {expected}");
        assert!(found >= 0.0);
    }
}

/// Aluminium at a third of its density, with a spectrum and next to the tool: the sum over the energies.
#[test]
fn the_arm_attenuates_as_its_mass_does_with_and_without_a_spectrum() {
    let c_arm = crate::poses::c_arm(0.0, 0.0, 41, 0.05);
    let middle = 20 * 41 + 20;
    let poses = [Pose { position_m: [0.0; 3], orientation_xyzw: [0.0, 0.0, 0.0, 1.0] }];
    let solids: Arc<[ClosedMesh]> = Arc::from(vec![cuboid([0.02, 0.01, 0.02])]);
    let arm = PlacedSolids::new(Arc::clone(&solids), &poses, ALUMINIUM_G_PER_CM3 / 3.0).unwrap();
    // The beam runs along y.
    let rod = ToolPart::tube([-0.002, 0.015, 0.0], [0.002, 0.015, 0.0], [2e-3, 0.0], Material::Steel316L);
    let tool = Tool { parts: vec![rod], arm: Some(arm), ..Tool::default() };
    let mu = |material: Material, energy_kev| material.mu_per_m(energy_kev).unwrap();
    let depth = |energy_kev: f64, steel_m: f64| {
        mu(Material::Aluminium, energy_kev) * 0.02 / 3.0 + mu(Material::Steel316L, energy_kev) * steel_m
    };
    let aside = middle + 10;
    let plain = shown(&c_arm, &tool, DrrParameters::default());
    let energy_kev = DrrParameters::default().energy_kev;
    let (way, straight) = (rays(&c_arm, &poses[0])[aside].1, rays(&c_arm, &poses[0])[middle].1);
    let slant = norm(way) / norm(straight);
    // The box's corners are rounded to single precision.
    assert!((plain[middle] - depth(energy_kev, 0.004)).abs() < 1e-7, "{}", plain[middle]);
    assert!((plain[aside] - depth(energy_kev, 0.0) * slant).abs() < 1e-6, "{}", plain[aside]);
    let spectrum = Spectrum::default();
    let hard = shown(&c_arm, &tool, DrrParameters { spectrum: Some(spectrum), ..Default::default() });
    let passed = |slant: f64, steel_m: f64| -> f64 {
        weights(&spectrum)
            .iter()
            .map(|(energy, weight)| weight * (-depth(*energy, steel_m) * slant).exp())
            .sum()
    };
    assert!((hard[middle] + passed(1.0, 0.004).ln()).abs() < 1e-7, "{}", hard[middle]);
    assert!((hard[aside] + passed(slant, 0.0).ln()).abs() < 1e-6, "{}", hard[aside]);
}

#[test]
fn impossible_solids_are_refused_with_the_field() {
    let solids = || Arc::from(vec![cuboid([0.01; 3])]);
    let here = Pose { position_m: [0.0; 3], orientation_xyzw: [0.0, 0.0, 0.0, 1.0] };
    let refused = |poses: &[Pose], density| PlacedSolids::new(solids(), poses, density).unwrap_err();
    assert!(matches!(refused(&[], 1.0), DrrError::Length { given: 0, expected: 1, .. }));
    for density in [0.0, 2.71, f64::NAN] {
        assert!(refused(&[here], density).to_string().contains("density_g_per_cm3"));
    }
    let far = Pose { position_m: [0.0, f64::INFINITY, 0.0], ..here };
    assert!(refused(&[far], 1.0).to_string().contains("coordinate"));
    let none = Pose { orientation_xyzw: [0.0; 4], ..here };
    assert!(refused(&[none], 1.0).to_string().contains("quaternion"));
}

/// Two joints and a mesh on the second: its shadow is where the joints put it, for a flange pose given by a
/// state.
#[test]
fn the_arm_of_a_scene_shows_where_its_joints_put_it() {
    let text = "name = \"a\"\nrun = { mode = \"lockstep\", duration_s = 1.0 }\n\
                tool = { burr_start_mm = [0.0, 0.0, 0.0], direction = [0.0, 0.0, 1.0], bend_toward = [1.0, \
                0.0, 0.0] }\n[arm]\nxray_density_g_per_cm3 = 2.0\n\
                initial_joints_deg = [0.0, 10.0, 20.0, 30.0, 40.0, 50.0]\n";
    let joint = |i: usize, x_mm: f64| {
        let axis = if i.is_multiple_of(2) { "[0.0, 0.0, 1.0]" } else { "[0.0, 1.0, 0.0]" };
        format!(
            "[[arm.joint]]\nname = \"j{i}\"\nposition_mm = [{x_mm}, 0.0, 0.0]\naxis = {axis}\n\
             lower_deg = -170.0\nupper_deg = 170.0\nmax_speed_deg_per_s = 90.0\n"
        )
    };
    let joints: String = (0..6).map(|i| joint(i, if i == 0 { 0.0 } else { 50.0 })).collect();
    let mesh = "[[arm.mesh]]\njoint = \"j3\"\nfile = \"ball.stl\"\nposition_mm = [20.0, 0.0, 5.0]\n";
    let scene =
        scene::Scene::parse(&format!("{text}{joints}{mesh}"), std::path::Path::new("a.toml")).unwrap();
    let meshes = scene.arm.mesh.iter().flatten().map(|mesh| (mesh, ball(0.01, 48)));
    let model = ArmModel::new(&scene.arm, meshes).unwrap();
    assert_eq!(model.triangles(), ball(0.01, 48).triangles().len());

    let mut state = State::new_zeroed();
    let angles = [0.3, -0.4, 0.5, 0.6, -0.2, 0.1];
    state.arm_joint_position_rad[..6].copy_from_slice(&angles);
    // By hand, from the base on: translations along x, rotations about z and y alternately.
    let about = |i: usize, angle: f64, [x, y, z]: [f64; 3]| {
        let (sin, cos) = angle.sin_cos();
        if i.is_multiple_of(2) {
            [x * cos - y * sin, x * sin + y * cos, z]
        } else {
            [x * cos + z * sin, y, z * cos - x * sin]
        }
    };
    let in_base = |first: usize, point: [f64; 3]| {
        (0..first).rev().fold(point, |[x, y, z], i| {
            let [x, y, z] = about(i, angles[i], [x, y, z]);
            [x + if i == 0 { 0.0 } else { 0.05 }, y, z]
        })
    };
    let (centre, flange) = (in_base(4, [0.02, 0.0, 0.005]), in_base(6, [0.0; 3]));
    // The base is aligned with the world, so the flange's rotation is the product of all joint rotations.
    let axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(|axis| {
        let end = in_base(6, axis);
        [0, 1, 2].map(|i| end[i] - flange[i])
    });
    let base_m = [0.01, -0.02, 0.005];
    let to_iso = [0, 1, 2].map(|i| base_m[i] - centre[i]);
    state.t_world_flange =
        Pose { position_m: [0, 1, 2].map(|i| flange[i] + to_iso[i]), orientation_xyzw: quaternion(axes) };
    let c_arm = crate::poses::c_arm(20.0, 10.0, 101, 0.1);
    let found =
        metres(&c_arm, &Tool { parts: Vec::new(), arm: Some(model.placed(&state)), ..Tool::default() }, 1);
    let shadow = c_arm.project(base_m).unwrap();
    let (mut sum, mut at) = (0.0, [0.0; 2]);
    for (index, length_m) in found.iter().enumerate() {
        let (column, row) = ((index % 101) as f64, (index / 101) as f64);
        (sum, at) = (sum + length_m, [at[0] + column * length_m, at[1] + row * length_m]);
    }
    let middle = at.map(|x| x / sum);
    println!("shadow at {middle:?}, the centre's projection {} {}", shadow.column, shadow.row);
    // A sphere's shadow is an ellipse whose centre is slightly outside the projection of the sphere's centre.
    assert!((middle[0] - shadow.column).abs() < 0.1 && (middle[1] - shadow.row).abs() < 0.1);
    let thickest = found.iter().fold(0.0_f64, |most, x| most.max(*x));
    assert!((thickest - 0.02 * 2.0 / ALUMINIUM_G_PER_CM3).abs() < 1e-4, "{thickest}");
    let without = scene::Arm { xray_density_g_per_cm3: None, ..scene.arm.clone() };
    assert!(ArmModel::new(&without, std::iter::empty()).is_none());
}

/// Quaternion of a rotation's columns (Shepperd's method for a trace above 0).
fn quaternion([x, y, z]: [[f64; 3]; 3]) -> [f64; 4] {
    let w = 0.5 * (1.0 + x[0] + y[1] + z[2]).sqrt();
    let part = |a: f64, b: f64| (a - b) / (4.0 * w);
    [part(y[2], z[1]), part(z[0], x[2]), part(x[1], y[0]), w]
}
