//! Contact of the manipulator: walls, tunnels, axial load, friction, joint stops.

#![allow(clippy::unwrap_used, reason = "a test that cannot build its tool has failed")]

use crate::common::rest;
use nalgebra::{Isometry3, Translation3, Unit, UnitQuaternion, Vector3};
use simulation::contact_plane::ContactPlane;
use simulation::manipulator::{
    BaseMotion, Integrator, Manipulator, ManipulatorModel, ManipulatorParameters, SphereKind, StepInput,
    StepReport, TendonCommand, Wrench,
};

const DT_S: f64 = 1e-3;

fn tool(change: impl Fn(&mut ManipulatorParameters)) -> Manipulator {
    let mut p = ManipulatorParameters::jhu_27();
    p.damping_ratio = 1.0;
    change(&mut p);
    Manipulator::new(p, &rest()).unwrap()
}

/// Every sphere near the half space `normal . x >= offset`.
fn half_space(m: &Manipulator, normal: Vector3<f64>, offset_m: f64, out: &mut Vec<ContactPlane>) {
    let normal = Unit::new_normalize(normal);
    for (sphere_index, s) in m.proxy_spheres().iter().enumerate() {
        let distance = normal.dot(&s.centre_m) - offset_m;
        let gap_m = distance - s.radius_m;
        if gap_m < 2e-3 {
            let point_m = s.centre_m - normal.into_inner() * distance;
            out.push(ContactPlane::hard(sphere_index, point_m, normal, gap_m));
        }
    }
}

fn step(m: &mut Manipulator, base: BaseMotion, tendon: TendonCommand, planes: &[ContactPlane]) -> StepReport {
    m.step(DT_S, &StepInput { base, tendon, tip_wrench: Wrench::zero(), contacts: planes }).unwrap()
}

fn finite(m: &Manipulator) -> bool {
    m.proxy_spheres()
        .iter()
        .all(|s| s.centre_m.iter().chain(s.velocity_m_per_s.iter()).all(|x| x.is_finite()))
        && m.contact_results()
            .iter()
            .all(|c| c.normal_force_n.is_finite() && c.friction_force_n.norm().is_finite())
        && m.flange_wrench().force_n.norm().is_finite()
        && m.flange_wrench().torque_nm.norm().is_finite()
}

#[test]
fn stiff_wall_holds_without_jitter_and_transmits_the_force() {
    for tension in [3.0, 8.0] {
        let mut m = tool(|p| p.contact.friction_coefficient = 0.0);
        let mut planes = Vec::new();
        let wall = -0.008; // normal -x: the surface is at x = +8 mm
        let mut tips = Vec::new();
        for _ in 0..1200 {
            planes.clear();
            half_space(&m, -Vector3::x(), wall, &mut planes);
            step(&mut m, rest(), TendonCommand::Force([tension, 0.0]), &planes);
            tips.push(m.t_world_tip().translation.vector);
        }
        let last = &tips[tips.len() - 200..];
        let jitter = last.iter().map(|t| (t - last[0]).norm()).fold(0.0, f64::max);
        let report = m.last_report();
        let force: Vector3<f64> = m.contact_results().iter().map(|c| c.normal * c.normal_force_n).sum();
        let expected: f64 = m.contact_results().iter().map(|c| c.normal_force_n).fold(0.0, f64::max)
            / m.parameters().contact.stiffness_n_per_m;
        println!(
            "wall {tension} N: {} of {} contacts, overlap {:.4} um (force/stiffness {:.4}), jitter \
             {jitter:.1e} m, wall force {:.4} N, flange {:.4} N, iterations {}, residual {:.1e}",
            report.active_contact_count,
            report.contact_count,
            report.max_overlap_m * 1e6,
            expected * 1e6,
            -force.x,
            -report.flange_wrench.force_n.x,
            report.contact_iterations,
            report.contact_residual_m_per_s
        );
        assert!(report.active_contact_count >= 1);
        // The overlap is the contact's compliance and nothing else.
        assert!((report.max_overlap_m - expected).abs() < 1e-9);
        assert!(jitter < 1e-9);
        // At rest the flange feels exactly the wall.
        assert!((report.flange_wrench.force_n - force).norm() < 1e-5 * force.norm());
        // Virtual work of one free flexure: tendon torque = spring + wall moment, for each flexure within its
        // stop.
        for (i, &q) in m.joint_positions_rad().iter().enumerate() {
            if q.abs() > 0.95 * m.parameters().joint_limit_rad {
                continue;
            }
            let pivot = m.t_world_link(i + 1).translation.vector;
            let mut torque =
                tension * 2.5e-3 * (0.5 * q).cos() - m.parameters().joint_stiffness_nm_per_rad[i] * q;
            for c in m.contact_results() {
                let sphere = &m.proxy_spheres()[c.sphere_index];
                let outward = match sphere.kind {
                    SphereKind::Segment(k) => k >= i,
                    SphereKind::Burr => true,
                    SphereKind::Shaft => false,
                };
                if outward {
                    torque += (sphere.centre_m - pivot).cross(&(c.normal * c.normal_force_n)).y;
                }
            }
            assert!(torque.abs() < 2e-6, "flexure {i}: {torque} N m unbalanced");
        }
    }
}

#[test]
fn result_does_not_depend_on_where_the_anatomy_stands() {
    let run = |base: BaseMotion| {
        let p = ManipulatorParameters { damping_ratio: 1.0, ..ManipulatorParameters::jhu_27() };
        let mut m = Manipulator::new(p, &base).unwrap();
        let pose = base.t_world_base;
        let mut planes = Vec::new();
        for _ in 0..300 {
            planes.clear();
            let normal = pose * -Vector3::x();
            half_space(
                &m,
                normal,
                normal.dot(&(pose * nalgebra::Point3::new(0.008, 0.0, 0.0)).coords),
                &mut planes,
            );
            step(&mut m, base, TendonCommand::Force([6.0, 0.0]), &planes);
        }
        (pose.inverse() * m.t_world_tip()).translation.vector
    };
    let here = run(rest());
    let rotation = UnitQuaternion::from_euler_angles(0.7, -1.1, 2.3);
    let there = run(BaseMotion::at_rest(Isometry3::from_parts(Translation3::new(4.5, -3.0, 1.0), rotation)));
    println!("moved and turned by metres: tip differs by {:.1e} m", (here - there).norm());
    // 4.5 m / 1 ulp is 1e-15 m per step and gap.
    assert!((here - there).norm() < 1e-9);
}

#[test]
fn tight_tunnel_with_opposing_walls_stays_finite() {
    // Both walls of every sphere touch or overlap: -0.3 mm is a tunnel narrower than the tool.
    for clearance in [0.1e-3, 0.0, -0.3e-3] {
        let mut m = tool(|_| ());
        let mut planes = Vec::new();
        let (mut worst, mut late) = (0.0f64, 0.0f64);
        for k in 0..400 {
            planes.clear();
            for (sphere_index, s) in m.proxy_spheres().iter().enumerate() {
                for side in [1.0, -1.0] {
                    let gap_m = side * s.centre_m.x + clearance;
                    let normal = Unit::new_unchecked(Vector3::x() * side);
                    planes.push(ContactPlane::hard(sphere_index, s.centre_m, normal, gap_m));
                }
            }
            let tension = if (k / 50usize).is_multiple_of(2) { 10.0 } else { 0.0 };
            let feed = BaseMotion {
                t_world_base: Isometry3::translation(0.0, 0.0, 1e-5 * k as f64),
                linear_velocity_m_per_s: Vector3::new(0.0, 0.0, 0.01),
                angular_velocity_rad_per_s: Vector3::zeros(),
            };
            let report = step(&mut m, feed, TendonCommand::Force([tension, 0.0]), &planes);
            assert_eq!(report.contact_count, 2 * m.proxy_spheres().len());
            assert!(finite(&m), "step {k}");
            let out = m.proxy_spheres().iter().map(|s| s.centre_m.x.abs() - clearance).fold(0.0, f64::max);
            worst = worst.max(out);
            if k >= 300 {
                late = late.max(out);
            }
        }
        let r = m.last_report();
        println!(
            "tunnel {:+.1} mm: {} contacts, worst overlap {:.2} um, after 0.3 s {:.2} um, last iterations \
             {}, residual {:.1e}",
            clearance * 1e3,
            r.contact_count,
            worst * 1e6,
            late * 1e6,
            r.contact_iterations,
            r.contact_residual_m_per_s
        );
        // Beyond what a too narrow tunnel imposes on both sides: a few newtons on 1e6 N/m each, and a
        // transient while a 0.3 mm overlap on 34 spheres is pushed out from both sides at once.
        let imposed = (-clearance).max(0.0);
        assert!(late - imposed < 20e-6 && worst - imposed < 0.3e-3, "{worst} {late}");
    }
}

#[test]
fn deep_first_overlap_is_pushed_out_at_a_bounded_speed() {
    let mut m = tool(|_| ());
    let mut planes = Vec::new();
    let mut fastest: f64 = 0.0;
    for _ in 0..600 {
        planes.clear();
        // The surface begins 5 mm inside the straight tool's spheres.
        half_space(&m, -Vector3::x(), -(-0.002), &mut planes);
        planes.retain(|p| !matches!(m.proxy_spheres()[p.sphere_index].kind, SphereKind::Shaft));
        planes.retain(|p| p.sphere_index > 20);
        step(&mut m, rest(), TendonCommand::Force([0.0; 2]), &planes);
        assert!(finite(&m));
        fastest = m.proxy_spheres().iter().map(|s| s.velocity_m_per_s.norm()).fold(fastest, f64::max);
    }
    println!(
        "5 mm overlap: fastest sphere {fastest:.4} m/s, overlap left {:.2} um",
        m.last_report().max_overlap_m * 1e6
    );
    // 0.05 m/s at the pushed spheres; the rest of the chain can swing a little faster.
    assert!(fastest < 0.15);
    assert!(m.last_report().max_overlap_m < 20e-6);
}

/// Regression: the bound was a speed, so a step of 5 ms threw an overlapping tool out of the wall by a
/// quarter of a millimetre.
#[test]
fn a_long_step_pushes_no_more_overlap_out_than_a_short_one() {
    for dt_s in [1e-3, 5e-3, 1e-2] {
        let mut m = tool(|_| ());
        let mut planes = Vec::new();
        half_space(&m, -Vector3::x(), 0.002, &mut planes);
        planes.retain(|p| p.sphere_index == m.proxy_spheres().len() - 1);
        let overlap_m = -planes[0].gap_m;
        let before = m.proxy_spheres()[planes[0].sphere_index].centre_m.x;
        let tendon = TendonCommand::Force([0.0; 2]);
        let input = StepInput { base: rest(), tendon, tip_wrench: Wrench::zero(), contacts: &planes };
        m.step(dt_s, &input).unwrap();
        let moved_m = before - m.proxy_spheres()[planes[0].sphere_index].centre_m.x;
        println!("{dt_s} s: {:.1} um of {:.1} mm", moved_m * 1e6, overlap_m * 1e3);
        assert!(overlap_m > 1e-3 && moved_m > 10e-6 && moved_m < 51e-6, "{dt_s} s: {moved_m} m");
    }
}

#[test]
fn axial_tip_contact_is_well_posed() {
    let mut m = tool(|p| {
        p.contact.friction_coefficient = 0.0;
        p.joint_stiffness_nm_per_rad.iter_mut().for_each(|k| *k *= 100.0);
    });
    let tip_z = m.t_world_tip().translation.z + 3.25e-3;
    let mut planes = Vec::new();
    for k in 0..500 {
        planes.clear();
        half_space(&m, -Vector3::z(), -tip_z, &mut planes);
        // Feed by 20 um against the wall, then hold.
        let z = 2e-5 * (k as f64 / 100.0).min(1.0);
        let mut base = BaseMotion::at_rest(Isometry3::translation(0.0, 0.0, z));
        base.linear_velocity_m_per_s.z = if k < 100 { 2e-4 } else { 0.0 };
        step(&mut m, base, TendonCommand::Force([0.0; 2]), &planes);
        assert!(finite(&m));
    }
    let force: f64 = m.contact_results().iter().map(|c| c.normal_force_n).sum();
    let flange = m.flange_wrench().force_n;
    // Mount (2e5 N/m) and contact (1e6 N/m) in series share the 20 um.
    let expected = 2e-5 / (1.0 / 2e5 + 1.0 / 1e6);
    println!("axial: wall {force:.6} N, flange {:.6} N, expected {expected:.6} N", -flange.z);
    assert!((force - expected).abs() < 1e-6 * expected);
    assert!((flange.z + force).abs() < 1e-6 * force);
    // The report names the burr.
    assert!((m.last_report().burr_normal_force_n.z + force).abs() < 1e-9);
}

#[test]
fn friction_obeys_the_cone_and_opposes_sliding() {
    let mu = 0.3;
    let mut m = tool(|p| {
        p.contact.friction_coefficient = mu;
        p.contact.burr_friction_coefficient = mu;
    });
    let mut planes = Vec::new();
    // Sideways and forward at once, 10 mm/s, for 0.8 s.
    let base = |k: usize| BaseMotion {
        t_world_base: Isometry3::translation(0.0, 6e-6 * k as f64, 8e-6 * k as f64),
        linear_velocity_m_per_s: Vector3::new(0.0, 6e-3, 8e-3),
        angular_velocity_rad_per_s: Vector3::zeros(),
    };
    for k in 0..800 {
        planes.clear();
        half_space(&m, -Vector3::x(), -0.005, &mut planes);
        step(&mut m, base(k), TendonCommand::Force([6.0, 0.0]), &planes);
    }
    let mut sum = Vector3::zeros();
    let mut normal = 0.0;
    for c in m.contact_results() {
        assert!(c.friction_force_n.norm() <= mu * c.normal_force_n * (1.0 + 1e-9) + 1e-12);
        assert!(c.friction_force_n.dot(&c.normal).abs() < 1e-9);
        sum += c.friction_force_n;
        normal += c.normal_force_n;
    }
    let direction = Vector3::new(0.0, 0.6, 0.8);
    let off = (sum + direction * (mu * normal)).norm();
    println!("sliding at (0, 6, 8) mm/s: friction {sum:?} N, normal {normal:.4} N, off by {off:.1e} N");
    assert!(normal > 0.2);
    // Coulomb against the sliding direction; the shape still creeps by less than 1 % of the sliding speed.
    assert!(off < 0.01 * mu * normal, "{sum:?}");
    let flange = m.flange_wrench().force_n;
    assert!((flange - sum + Vector3::x() * normal).norm() < 1e-3 * normal, "{flange:?}");
}

#[test]
fn joint_stops_hold() {
    let mut m = tool(|_| ());
    for _ in 0..800 {
        step(&mut m, rest(), TendonCommand::Force([30.0, 0.0]), &[]);
    }
    let p = m.parameters();
    let most = m.joint_positions_rad().iter().fold(0.0f64, |a, q| a.max(q.abs()));
    // Tendon torque minus the spring's at the stop, divided by the stop's stiffness.
    let worst = (30.0 * 2.5e-3 - p.joint_stiffness_nm_per_rad[26] * p.joint_limit_rad)
        / p.joint_stop_stiffness_nm_per_rad;
    println!(
        "30 N: bend {:.2} deg (27 x 5 = 135), {} stops, farthest {:.5} deg past, predicted {:.5}",
        m.bend_rad().to_degrees(),
        m.last_report().stopped_joint_count,
        (most - p.joint_limit_rad).to_degrees(),
        worst.to_degrees()
    );
    assert_eq!(m.last_report().stopped_joint_count, 27);
    assert!(most - p.joint_limit_rad < 1.02 * worst + 1e-9);
}

#[test]
fn hybrid_meets_a_wall_like_euler_and_keeps_its_accuracy_before() {
    let run = |integrator, per_ms: usize| {
        let mut m = tool(|p| {
            p.integrator = integrator;
            p.damping_ratio = 0.05;
            p.contact.friction_coefficient = 0.0;
        });
        let mut planes = Vec::new();
        let (mut second, mut before, mut deepest) = (0, Vector3::zeros(), 0.0f64);
        for k in 0..400 * per_ms {
            planes.clear();
            half_space(&m, -Vector3::x(), -0.012, &mut planes);
            let input = StepInput {
                base: rest(),
                tendon: TendonCommand::Force([5.0, 0.0]),
                tip_wrench: Wrench::zero(),
                contacts: &planes,
            };
            let r = m.step(DT_S / per_ms as f64, &input).unwrap();
            second += usize::from(r.integrator == Integrator::Hybrid);
            deepest = deepest.max(r.max_overlap_m);
            if k + 1 == 6 * per_ms {
                before = m.t_world_tip().translation.vector;
            }
        }
        (m.t_world_tip().translation.vector, before, second, deepest)
    };
    let (euler, hybrid, fine) =
        (run(Integrator::LinearlyImplicitEuler, 1), run(Integrator::Hybrid, 1), run(Integrator::Hybrid, 20));
    println!(
        "before the wall (6 ms): Euler off {:.1} um, hybrid off {:.2} um; at rest they differ by {:.1e} m; \
         {} ROS2 steps; deepest {:.2} / {:.2} um",
        (euler.1 - fine.1).norm() * 1e6,
        (hybrid.1 - fine.1).norm() * 1e6,
        (euler.0 - hybrid.0).norm(),
        hybrid.2,
        euler.3 * 1e6,
        hybrid.3 * 1e6
    );
    assert!((hybrid.1 - fine.1).norm() < 0.2 * (euler.1 - fine.1).norm());
    assert!((euler.0 - hybrid.0).norm() < 1e-7 && hybrid.2 >= 5);
    assert!(hybrid.3 < 50e-6);
}

#[test]
fn winding_tunnel_rests_in_equilibrium() {
    for mu in [0.0, 0.2] {
        let mut m = tool(|p| {
            p.contact.friction_coefficient = mu;
            // The tunnel bends individual flexures past 5 degrees; a stop's torque would enter the balance.
            p.joint_limit_rad = 1.0;
            p.contact.burr_friction_coefficient = mu;
        });
        let wave = 2.0 * std::f64::consts::PI / 12e-3;
        let mut planes = Vec::new();
        for _ in 0..1500 {
            planes.clear();
            for (sphere_index, s) in m.proxy_spheres().iter().enumerate().skip(6) {
                let phase = wave * (s.centre_m.z - 0.036);
                let normal = Unit::new_normalize(Vector3::new(1.0, 0.0, -0.3e-3 * wave * phase.cos()));
                for side in [1.0, -1.0] {
                    let gap_m = side * (s.centre_m.x - 0.3e-3 * phase.sin()) * normal.x + 20e-6;
                    let normal = Unit::new_unchecked(normal.into_inner() * side);
                    planes.push(ContactPlane::hard(sphere_index, s.centre_m, normal, gap_m));
                }
            }
            step(&mut m, rest(), TendonCommand::Force([8.0, 0.0]), &planes);
        }
        let mut worst: f64 = 0.0;
        let mut total = Vector3::zeros();
        for (i, &q) in m.joint_positions_rad().iter().enumerate() {
            let pivot = m.t_world_link(i + 1).translation.vector;
            let mut torque =
                8.0 * 2.5e-3 * (0.5 * q).cos() - m.parameters().joint_stiffness_nm_per_rad[i] * q;
            total = Vector3::zeros();
            for c in m.contact_results() {
                let s = &m.proxy_spheres()[c.sphere_index];
                let force = c.normal * c.normal_force_n + c.friction_force_n;
                total += force;
                // Sphere 6 + k sits on the link behind flexure k.
                if c.sphere_index >= 6 + i {
                    torque += (s.centre_m - c.normal * s.radius_m - pivot).cross(&force).y;
                }
            }
            worst = worst.max(torque.abs());
        }
        let r = m.last_report();
        let off = (r.flange_wrench.force_n - total).norm();
        println!(
            "winding tunnel mu={mu}: {} of {} contacts active, worst unbalanced flexure {worst:.1e} N m of \
             {:.1e}, flange off by {off:.1e} N, iterations {}",
            r.active_contact_count,
            r.contact_count,
            8.0 * 2.5e-3,
            r.contact_iterations
        );
        assert!(r.active_contact_count >= 12);
        // The solver stops at 1e-6 m/s per row; 1e-4 of the tendon's torque.
        assert!(worst < 2e-6 && off < 1e-3, "{worst} {off}");
    }
}

/// The contacts' springs hold what pushing out does, at most 0.1 mJ a step; at the full speed, 50 um a step,
/// a wall on each side would put 1.25 mJ into each spring.
#[test]
fn walls_that_overlap_a_jammed_tool_do_no_work_on_it() {
    let mut m = tool(|p| p.contact.friction_coefficient = 0.0);
    let burr = m.proxy_spheres().iter().position(|sphere| sphere.kind == SphereKind::Burr).unwrap();
    let from_m = m.proxy_spheres()[burr].centre_m;
    let mut before_j = 0.0;
    for _ in 0..20 {
        let moved_m = m.proxy_spheres()[burr].centre_m.x - from_m.x;
        let planes = [-1.0, 1.0].map(|side| {
            let normal = Unit::new_unchecked(Vector3::x() * side);
            ContactPlane::hard(burr, from_m, normal, -0.2e-3 + side * moved_m)
        });
        step(&mut m, rest(), TendonCommand::Force([0.0; 2]), &planes);
        let stiffness = m.parameters().contact.stiffness_n_per_m;
        let springs =
            m.contact_results().iter().map(|result| 0.5 * result.normal_force_n.powi(2) / stiffness);
        let stored_j: f64 = springs.sum();
        assert!(stored_j - before_j < 0.1e-3, "{} mJ", (stored_j - before_j) * 1e3);
        before_j = stored_j;
    }
}
