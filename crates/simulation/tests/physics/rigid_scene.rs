//! Rigid bodies next to the manipulator: geometry, free fall, weight, momentum, light bodies, determinism.

#![allow(clippy::unwrap_used, reason = "a test that cannot build its scene has failed")]

use messages::{Latched, SOURCE_FRESH, TENDON_SERVO_JF};
use nalgebra::{Isometry3, Translation3, Unit, UnitQuaternion, Vector3};
use scene::Scene;
use simulation::Simulation;
use simulation::contact_plane::ContactPlane;
use simulation::manipulator::{
    BaseMotion, Manipulator, ManipulatorModel, ManipulatorParameters, ProxySphere, SphereKind, StepInput,
    TendonCommand, Wrench,
};
use simulation::rigid::{BodyMotion, BodyParameters, BodyShape, RigidError, RigidScene, ToolDrive};

const DT_S: f64 = 1e-3;
const MARGIN_M: f64 = 2e-4;

fn tool(base: Isometry3<f64>) -> Manipulator {
    let p = ManipulatorParameters { damping_ratio: 1.0, ..ManipulatorParameters::jhu_27() };
    Manipulator::new(p, &BaseMotion::at_rest(base)).unwrap()
}

/// A box of a given mass, or a fixed box.
fn block(centre_m: Vector3<f64>, half_m: [f64; 3], mass_kg: Option<f64>) -> BodyParameters {
    let half_extents_m = Vector3::from(half_m);
    BodyParameters {
        name: "block".to_owned(),
        shape: BodyShape::Box { half_extents_m },
        t_world_body: Isometry3::from_parts(Translation3::from(centre_m), UnitQuaternion::identity()),
        motion: if mass_kg.is_some() { BodyMotion::Free } else { BodyMotion::Fixed },
        density_kg_per_m3: mass_kg.map_or(1000.0, |mass| mass / (8.0 * half_m[0] * half_m[1] * half_m[2])),
        friction: 0.3,
    }
}

fn scene(bodies: &[BodyParameters], gravity: Vector3<f64>, m: &Manipulator) -> RigidScene {
    RigidScene::new(bodies, &gravity, DT_S, m.proxy_spheres().len()).unwrap()
}

fn step(scene: &mut RigidScene, m: &mut Manipulator, tension_n: f64, planes: &mut Vec<ContactPlane>) {
    planes.clear();
    scene.find_contacts(m.proxy_spheres(), MARGIN_M, planes);
    let base = *m.base();
    let drive =
        ToolDrive { base, tendon: TendonCommand::Force([tension_n, 0.0]), tip_wrench: Wrench::zero() };
    scene.step(m, &drive, planes).unwrap();
}

fn position(scene: &RigidScene, body: usize) -> Vector3<f64> {
    scene.poses().nth(body).unwrap().translation.vector
}

/// Impulse of the tool on body `body` in the last step.
fn given(scene: &RigidScene, m: &Manipulator, body: usize) -> Vector3<f64> {
    let on = |r: &&simulation::manipulator::ContactResult| scene.body_of_plane(r.contact_index) == Some(body);
    let force = |r: &simulation::manipulator::ContactResult| r.normal * r.normal_force_n + r.friction_force_n;
    -m.contact_results().iter().filter(on).map(force).sum::<Vector3<f64>>() * DT_S
}

fn sphere(centre_m: Vector3<f64>, radius_m: f64) -> ProxySphere {
    ProxySphere { centre_m, velocity_m_per_s: Vector3::zeros(), radius_m, kind: SphereKind::Burr }
}

#[test]
fn gaps_and_normals_are_the_exact_distances_of_a_turned_box_ball_and_capsule() {
    let pose = Isometry3::from_parts(
        Translation3::new(0.3, -0.2, 0.1),
        UnitQuaternion::from_euler_angles(0.4, -0.9, 2.0),
    );
    let half = Vector3::new(0.01, 0.02, 0.03);
    // The sphere's centre in body axes, and the distance and direction from geometry.
    let d = Vector3::new(1.0, 2.0, 2.0) * 1e-3; // length 3 mm
    let far = Vector3::new(0.001, 0.002, 0.034);
    let boxes = [
        (half + d, 3e-3, d),                                                   // beyond the corner
        (Vector3::new(0.013, 0.024, 0.01), 5e-3, Vector3::new(3.0, 4.0, 0.0)), // beyond an edge
        (far, 4e-3, Vector3::z()),                                             // over a face
        (Vector3::new(0.008, 0.001, -0.002), -2e-3, Vector3::x()),             // inside, nearest to +x
    ];
    let tip = Vector3::new(3.0, 0.0, 4.0) * 1e-3;
    let cases = [
        (BodyShape::Box { half_extents_m: half }, boxes.to_vec()),
        (BodyShape::Ball { radius_m: 0.01 }, vec![(d * 5.0, 5e-3, d), (d, -7e-3, d)]),
        (
            BodyShape::Capsule { half_height_m: 0.02, radius_m: 0.004 },
            vec![
                (Vector3::z() * 0.02 + tip, 1e-3, tip),
                (Vector3::new(0.0, -0.006, 0.01), 2e-3, -Vector3::y()),
            ],
        ),
    ];
    let mut worst = 0.0f64;
    for (shape, places) in cases {
        for (local, distance_m, direction) in places {
            let body =
                BodyParameters { shape, t_world_body: pose, ..block(Vector3::zeros(), [0.01; 3], None) };
            let mut rigid = RigidScene::new(&[body], &Vector3::zeros(), DT_S, 1).unwrap();
            let mut planes = Vec::new();
            rigid.find_contacts(
                &[sphere((pose * nalgebra::Point3::from(local)).coords, 1e-3)],
                0.1,
                &mut planes,
            );
            let plane = planes[0];
            let normal = pose * direction.normalize();
            worst = worst
                .max((plane.gap_m - (distance_m - 1e-3)).abs())
                .max((plane.normal.as_ref() - normal).norm() * 1e-3);
        }
    }
    println!("box face, edge, corner, inside; ball; capsule: worst error {worst:.1e} m");
    // 1 ulp of 0.4 m is 6e-17 m; a few operations.
    assert!(worst < 1e-15);
}

#[test]
fn a_ball_falls_and_comes_to_rest_on_a_plate() {
    let m = &mut tool(Isometry3::translation(1.0, 0.0, 0.0));
    let ball = BodyParameters {
        shape: BodyShape::Ball { radius_m: 5e-3 },
        ..block(Vector3::new(0.0, 0.0, 0.105), [5e-3; 3], Some(0.01))
    };
    let plate = block(Vector3::new(0.0, 0.0, -0.01), [0.1, 0.1, 0.01], None);
    let mut rigid = scene(&[ball, plate], Vector3::new(0.0, 0.0, -9.81), m);
    let planes = &mut Vec::new();
    for _ in 0..100 {
        step(&mut rigid, m, 0.0, planes);
    }
    let fallen_m = 0.105 - position(&rigid, 0).z;
    let exact_m = 0.5 * 9.81 * 0.01;
    println!("free fall in 0.1 s: {:.4} mm, g t^2/2 = {:.4} mm", fallen_m * 1e3, exact_m * 1e3);
    // Semi-implicit Euler in four substeps of 0.25 ms is off by at most dt/t.
    assert!((fallen_m / exact_m - 1.0).abs() < DT_S / 0.1);
    assert!((rigid.velocity(0).unwrap().0.z + 0.981).abs() < 1e-9);
    for _ in 0..900 {
        step(&mut rigid, m, 0.0, planes);
    }
    let height_m = position(&rigid, 0).z;
    println!(
        "at rest: centre {:.6} mm above the plate, speed {:.1e} m/s",
        height_m * 1e3,
        rigid.velocity(0).unwrap().0.norm()
    );
    // Rapier leaves its allowed error of 0.005 length units: 50 um.
    assert!((height_m - 5e-3).abs() < 5.1e-5);
    assert!(rigid.velocity(0).unwrap().0.norm() < 1e-6);
}

#[test]
fn a_fragment_that_lies_on_the_shaft_presses_with_its_weight() {
    // The shaft along world x, bending plane vertical; the fragment lies on its six spheres from 0 to 35 mm.
    let turn = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), core::f64::consts::FRAC_PI_2);
    let m = &mut tool(Isometry3::from_parts(Translation3::identity(), turn));
    // Two smooth walls keep it from rolling off the line of spheres.
    let smooth = |body: BodyParameters| BodyParameters { friction: 0.0, ..body };
    let wall = |y: f64| smooth(block(Vector3::new(0.0175, y, 0.008), [0.05, 0.01, 0.05], None));
    let body = smooth(block(Vector3::new(0.0175, 0.0, 0.003 + 0.005), [0.0175, 0.01, 0.005], Some(0.05)));
    let mut rigid = scene(&[body, wall(0.02), wall(-0.02)], Vector3::new(0.0, 0.0, -9.81), m);
    let planes = &mut Vec::new();
    let (mut evaluations, mut force, mut flange) = (0, 0.0, 0.0);
    let mut heights = Vec::new();
    for k in 0..1000 {
        step(&mut rigid, m, 0.0, planes);
        evaluations += rigid.last_report().evaluations;
        if k >= 800 {
            force += m.contact_results().iter().map(|r| r.normal_force_n).sum::<f64>() / 200.0;
            flange -= m.flange_wrench().force_n.z / 200.0;
            heights.push(position(&rigid, 0).z);
        }
    }
    let sway = heights.iter().map(|z| (z - heights[0]).abs()).fold(0.0, f64::max);
    println!(
        "50 g on the shaft: {force:.6} N of {:.6} N on {} spheres, flange {flange:.6} N, height within \
         {sway:.1e} m, {:.2} evaluations per tick",
        0.05 * 9.81,
        m.contact_results().len(),
        f64::from(evaluations as u32) / 1000.0,
    );
    // The coupling's tolerance of 1e-5 m/s is 5e-4 N on 50 g in a tick, and averages out.
    assert!((force - 0.05 * 9.81).abs() < 1e-4);
    assert!((flange - 0.05 * 9.81).abs() < 1e-4);
    assert!(sway < 1e-6);
}

#[test]
fn a_fixed_box_is_the_same_wall_as_a_half_space() {
    let (mut with_box, mut with_plane) = (tool(Isometry3::identity()), tool(Isometry3::identity()));
    let wall = block(Vector3::new(0.058, 0.0, 0.05), [0.05, 0.2, 0.2], None);
    let mut rigid = scene(&[wall], Vector3::zeros(), &with_box);
    let planes = &mut Vec::new();
    for _ in 0..800 {
        step(&mut rigid, &mut with_box, 8.0, planes);
        planes.clear();
        for (sphere_index, s) in with_plane.proxy_spheres().iter().enumerate() {
            let gap_m = 0.008 - s.centre_m.x - s.radius_m;
            let point_m = Vector3::new(0.008, s.centre_m.y, s.centre_m.z);
            planes.push(ContactPlane::hard(sphere_index, point_m, Unit::new_unchecked(-Vector3::x()), gap_m));
        }
        let tendon = TendonCommand::Force([8.0, 0.0]);
        let input =
            StepInput { base: *with_plane.base(), tendon, tip_wrench: Wrench::zero(), contacts: planes };
        with_plane.step(DT_S, &input).unwrap();
    }
    let force = |m: &Manipulator| m.contact_results().iter().map(|r| r.normal_force_n).sum::<f64>();
    let apart =
        (with_box.t_world_tip().translation.vector - with_plane.t_world_tip().translation.vector).norm();
    println!(
        "8 N tendon: box {:.9} N, half space {:.9} N, tips {apart:.1e} m apart",
        force(&with_box),
        force(&with_plane)
    );
    assert!(force(&with_box) > 0.5);
    assert!((force(&with_box) - force(&with_plane)).abs() < 1e-6 * force(&with_plane));
    assert!(apart < 1e-10);
}

/// Pushes a block with the bending tool; the largest speed of block and burr, and the largest momentum error.
fn push(mass_kg: f64) -> (f64, f64, f64, f64, usize) {
    let m = &mut tool(Isometry3::identity());
    let body = block(Vector3::new(0.010 + 0.00425, 0.0, 0.0715), [0.010, 0.01, 0.01], Some(mass_kg));
    let mut rigid = scene(&[body], Vector3::zeros(), m);
    assert!((rigid.mass_kg(0).unwrap() / mass_kg - 1.0).abs() < 1e-12);
    let planes = &mut Vec::new();
    let (mut fastest, mut tool_fastest, mut unbalanced, mut residual) = (0.0f64, 0.0f64, 0.0f64, 0.0f64);
    let mut evaluations = 0;
    for _ in 0..300 {
        let before = rigid.velocity(0).unwrap().0;
        step(&mut rigid, m, 10.0, planes);
        let change = (rigid.velocity(0).unwrap().0 - before) * mass_kg;
        unbalanced = unbalanced.max((change - given(&rigid, m, 0)).norm());
        fastest = fastest.max(rigid.velocity(0).unwrap().0.norm());
        tool_fastest =
            m.proxy_spheres().iter().map(|s| s.velocity_m_per_s.norm()).fold(tool_fastest, f64::max);
        residual = residual.max(rigid.last_report().residual_m_per_s);
        evaluations = evaluations.max(rigid.last_report().evaluations);
    }
    (fastest, tool_fastest, unbalanced, residual, evaluations)
}

#[test]
fn bodies_of_any_mass_are_pushed_without_gaining_energy_and_momentum_is_balanced() {
    for mass_kg in [1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0] {
        let (fastest, tool, unbalanced, residual, evaluations) = push(mass_kg);
        println!(
            "{:6.1} g: body {fastest:.4} m/s, tool {tool:.4} m/s, momentum error {unbalanced:.1e} N s, \
             residual {residual:.1e} m/s, at most {evaluations} evaluations",
            mass_kg * 1e3
        );
        assert!(unbalanced < 1e-12);
        // After an inelastic push, no body is faster than the fastest part of the tool.
        assert!(fastest < 1.05 * tool);
    }
}

#[test]
fn a_fed_tool_does_not_throw_a_gram() {
    // 50 mm/s along the axis, where the tool's effective mass per tick is 0.3 kg, against one gram at rest.
    let m = &mut tool(Isometry3::identity());
    let body = block(Vector3::new(0.0, 0.0, 0.0715 + 0.00325 + 0.005 + 0.001), [0.005; 3], Some(1e-3));
    let mut rigid = scene(&[body], Vector3::zeros(), m);
    let mut fastest = 0.0f64;
    let planes = &mut Vec::new();
    for k in 1..=200 {
        planes.clear();
        rigid.find_contacts(m.proxy_spheres(), MARGIN_M, planes);
        let base = BaseMotion {
            t_world_base: Isometry3::translation(0.0, 0.0, 5e-5 * f64::from(k)),
            linear_velocity_m_per_s: Vector3::z() * 0.05,
            angular_velocity_rad_per_s: Vector3::zeros(),
        };
        let tendon = TendonCommand::Force([0.0; 2]);
        rigid.step(m, &ToolDrive { base, tendon, tip_wrench: Wrench::zero() }, planes).unwrap();
        fastest = fastest.max(rigid.velocity(0).unwrap().0.norm());
    }
    println!("a gram in front of a tool at 50 mm/s reaches {fastest:.4} m/s");
    assert!(fastest < 0.051);
}

#[test]
fn a_gram_between_tool_and_clamp_passes_the_force_on() {
    let half = [2e-3, 0.01, 0.01];
    let centre = Vector3::new(0.00425 + 2e-3, 0.0, 0.0715);
    let clamp = block(Vector3::new(0.00425 + 4e-3 + 0.01, 0.0, 0.0715), [0.01, 0.05, 0.05], None);
    let mut forces = Vec::new();
    for mass_kg in [None, Some(1e-3), Some(0.1)] {
        let m = &mut tool(Isometry3::identity());
        let mut rigid = scene(&[block(centre, half, mass_kg), clamp.clone()], Vector3::zeros(), m);
        let planes = &mut Vec::new();
        let (mut evaluations, mut late) = (0, 0.0f64);
        let mut tips = Vec::new();
        for k in 0..800 {
            step(&mut rigid, m, 10.0, planes);
            evaluations += rigid.last_report().evaluations;
            if k > 600 {
                tips.push(m.t_world_tip().translation.vector);
                late = late.max(rigid.last_report().residual_m_per_s);
            }
        }
        let force: f64 = m.contact_results().iter().map(|r| r.normal_force_n).sum();
        let jitter = tips.iter().map(|t| (t - tips[0]).norm()).fold(0.0, f64::max);
        println!(
            "{mass_kg:?} kg: {force:.5} N, body moved {:.3} um, jitter {jitter:.1e} m, late residual \
             {late:.1e} m/s, {:.2} evaluations per tick",
            (position(&rigid, 0) - centre).norm() * 1e6,
            f64::from(evaluations as u32) / 800.0
        );
        assert!(jitter < 1e-6);
        forces.push(force);
    }
    for force in &forces[1..] {
        assert!((force / forces[0] - 1.0).abs() < 0.01);
    }
}

#[test]
fn a_heavy_fragment_moves_by_half_f_t_squared_over_m() {
    // 100 kg, so that the tool's force does not change during the 50 ms of the measurement.
    let half = [0.05; 3];
    let centre = Vector3::new(0.05 + 0.00425, 0.0, 0.0715);
    let m = &mut tool(Isometry3::identity());
    let planes = &mut Vec::new();
    let mut wall = scene(&[block(centre, half, None)], Vector3::zeros(), m);
    for _ in 0..800 {
        step(&mut wall, m, 5.0, planes);
    }
    let force: f64 = m.contact_results().iter().map(|r| r.normal_force_n).sum();
    let mut rigid = scene(&[block(centre, half, Some(100.0))], Vector3::zeros(), m);
    for _ in 0..50 {
        step(&mut rigid, m, 5.0, planes);
    }
    let moved_m = position(&rigid, 0).x - centre.x;
    let exact_m = 0.5 * force * 0.05 * 0.05 / 100.0;
    println!(
        "{force:.4} N on 100 kg for 50 ms: {:.4} um, F t^2 / 2 m = {:.4} um",
        moved_m * 1e6,
        exact_m * 1e6
    );
    // Semi-implicit Euler: n (n + 1) instead of n^2, 2 % at n = 50; 0.3 % for the force, which decreases
    // slightly.
    assert!((moved_m / (exact_m * 51.0 / 50.0) - 1.0).abs() < 3e-3);
}

#[test]
fn runs_repeat_and_snapshots_continue_bit_for_bit() {
    let bodies = [
        block(Vector3::new(0.010 + 0.00425, 0.0, 0.0715), [0.010, 0.01, 0.01], Some(5e-3)),
        block(Vector3::new(0.035, 0.0, 0.0715), [0.008, 0.05, 0.05], None),
    ];
    let state = |rigid: &RigidScene, m: &Manipulator| {
        let mut bits: Vec<u64> = m.joint_positions_rad().iter().map(|q| q.to_bits()).collect();
        for (k, pose) in rigid.poses().enumerate() {
            bits.extend(
                pose.translation.vector.iter().chain(pose.rotation.coords.iter()).map(|x| x.to_bits()),
            );
            bits.extend(rigid.velocity(k).unwrap().0.iter().map(|x| x.to_bits()));
        }
        bits
    };
    let fresh = || {
        let m = tool(Isometry3::identity());
        let rigid = scene(&bodies, Vector3::new(0.0, 0.0, -9.81), &m);
        (rigid, m)
    };
    let planes = &mut Vec::new();
    let (mut rigid, mut m) = fresh();
    let mut saved = Vec::new();
    let mut history = Vec::new();
    for k in 0..400 {
        if k % 50 == 0 {
            saved.push((k, rigid.snapshot(), m.snapshot()));
        }
        step(&mut rigid, &mut m, 8.0, planes);
        history.push(state(&rigid, &m));
    }
    // The snapshot is restored in a fresh scene, and in the one that has run to the end.
    let (mut other, mut other_m) = fresh();
    for (start, saved_scene, saved_m) in &saved {
        for (rigid, m) in [(&mut rigid, &mut m), (&mut other, &mut other_m)] {
            rigid.restore(saved_scene);
            m.restore(saved_m);
            for known in &history[*start..] {
                step(rigid, m, 8.0, planes);
                assert!(state(rigid, m) == *known);
            }
        }
    }
    println!("{} snapshots continued to the same bits in a used and in a fresh scene", saved.len());
    assert!(history[399] != history[0]);
}

#[test]
fn the_fragment_scene_ends_at_its_clamp_and_a_reset_repeats_it_to_the_bit() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../configs/bone_fragment.toml");
    let scene = Scene::parse(&std::fs::read_to_string(path).unwrap(), std::path::Path::new(path)).unwrap();
    let mut simulation = Simulation::new(&scene, None).unwrap();
    let mut latched = Latched::zeroed();
    latched.controller_count = 1;
    latched.commands[0].source = SOURCE_FRESH;
    latched.commands[0].command.tendon_mode = TENDON_SERVO_JF;
    latched.commands[0].command.tendon_force_n[0] = 6.0;
    let mut ends = Vec::new();
    for _ in 0..2 {
        for k in 0..3000 {
            latched.reset = u32::from(k == 0);
            simulation.step(&latched).unwrap();
            latched.tick += 1;
        }
        let state = simulation.state();
        assert_eq!(state.body_count, 2);
        ends.push((state.t_world_body, state.joint_position_rad, state.burr_force_n));
    }
    let (bodies, _, force_n) = ends[0];
    println!("fragment ends at {:?} mm, burr force {force_n:.4} N", bodies[0].position_m.map(|x| x * 1e3));
    // The faces meet where the centre is at 15.25 mm; Rapier's allowed error is 50 um.
    assert!((bodies[0].position_m[0] - 0.01525).abs() < 1e-4);
    assert!(bodies[1].position_m == [0.02125, 0.0, -0.003]);
    assert!(force_n > 0.1);
    assert!(ends[0] == ends[1]);
}

#[test]
fn unusable_numbers_are_refused_by_name() {
    let good = block(Vector3::zeros(), [0.01; 3], Some(0.1));
    let refused = |body: BodyParameters| RigidScene::new(&[body], &Vector3::zeros(), DT_S, 1).err().unwrap();
    let flat = BodyShape::Box { half_extents_m: Vector3::new(0.01, 0.0, 0.01) };
    let error = refused(BodyParameters { shape: flat, ..good.clone() });
    println!("{error}");
    assert!(matches!(error, RigidError::OutOfRange { field: "half_extents_m", .. }));
    let error = refused(BodyParameters { friction: f64::NAN, ..good.clone() });
    assert!(matches!(error, RigidError::OutOfRange { field: "friction", .. }));
    let error = RigidScene::new(&[good], &Vector3::zeros(), f64::NAN, 1).err().unwrap();
    assert!(matches!(error, RigidError::Scene { field: "dt_s", .. }));
}
