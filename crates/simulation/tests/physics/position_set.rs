//! The published position-set method: it winds the velocity up and tunnels, a proxy hides energy, and ours does neither.

#![allow(clippy::unwrap_used, reason = "a test that cannot build its tool has failed")]

use crate::common::tool::{DT_S, pressed, pull, rest};
use nalgebra::{Isometry3, Vector3};
use simulation::baselines::{ProxyDrive, ProxyTool, Wall, proxy_of};
use simulation::bone::{BoneField, BoneParameters, ContactBuffer, GridGeometry};
use simulation::manipulator::{BaseMotion, Manipulator, ManipulatorParameters, StepInput};

fn tool(change: impl Fn(&mut ManipulatorParameters)) -> Manipulator {
    let mut p = ManipulatorParameters { damping_ratio: 1.0, ..ManipulatorParameters::jhu_27() };
    change(&mut p);
    Manipulator::new(p, &rest()).unwrap()
}

/// The position-set contact that Phalen et al. 2023 (doi 10.1007/s11548-023-02945-8, Methods) call unstable beside forces, in its
/// simplest case: 10 g, 10 N, a wall of 6 mm.
#[test]
fn a_position_that_is_set_winds_the_velocity_up_and_tunnels() {
    let radius_m = 3e-3;
    let wall = [Wall::new(-Vector3::z_axis(), Vector3::zeros())];
    let (mut centre, mut v, mut tunnelled) = (Vector3::new(0.0, 0.0, -radius_m), Vector3::zeros(), None);
    for k in 0..200 {
        v += Vector3::z() * (10.0 / 0.01 * DT_S);
        centre += v * DT_S;
        if centre.z > 6e-3 {
            tunnelled.get_or_insert(k);
        } else if tunnelled.is_none() {
            centre = proxy_of(&wall, &centre, radius_m);
        }
    }
    println!("position-set: through the wall after {tunnelled:?} ms, {:.0} m/s after 0.2 s", v.norm());
    assert!(tunnelled.is_some_and(|k| k < 20) && v.norm() > 150.0);
}

/// E3: 30 N of tension against a wall. A proxy hides kinetic energy at rest and passes no force on; impulses do neither.
#[test]
fn a_proxy_hides_energy_at_rest_and_as_a_force_is_unstable() {
    let mut p = ManipulatorParameters { damping_ratio: 0.05, ..ManipulatorParameters::jhu_27() };
    p.contact.friction_coefficient = 0.0;
    p.joint_limit_rad = 1.0;
    let wall = Wall::new(-Vector3::x_axis(), Vector3::x() * 8e-3);
    let run = |drive| {
        let mut m = ProxyTool::new(drive, p.clone(), &rest(), &[wall]).unwrap();
        let lost = (0..600).any(|_| m.step(DT_S, &pull([8.0, 0.0], &[])).is_err());
        let tool = m.tool();
        let reach_m = tool.t_world_tip().translation.vector.norm();
        let far = reach_m.is_nan() || reach_m > 0.2;
        (lost || far, tool.kinetic_energy_j(), tool.flange_wrench().force_n.x.abs())
    };
    let (position, force) = (run(ProxyDrive::Position), run(ProxyDrive::Force));
    let ours = pressed(Isometry3::identity());
    let pushed = ours.flange_wrench().force_n.x.abs();
    println!(
        "kinetic energy at rest: position-set {:.1e} J, ours {:.1e} J; force on the flange {:.2} and {pushed:.2} N; as a force: lost {}, {:.1e} J",
        position.1,
        ours.kinetic_energy_j(),
        position.2,
        force.0,
        force.1
    );
    assert!(position.0 || position.1 > 1e-6, "{position:?}");
    assert!(force.0 || force.1 > 1e-3, "{force:?}");
    assert!(ours.kinetic_energy_j() < 1e-15 && pushed > 0.5);
}

/// A burr at 1 m/s meets a sheet one voxel thick: it is held whatever the phase of the steps.
#[test]
fn nothing_tunnels_at_a_metre_a_second() {
    let dims = [40, 40, 24];
    let geometry = GridGeometry::axis_aligned(dims, [0.5e-3; 3], Vector3::new(-9.75e-3, -9.75e-3, 70e-3));
    let hu: Vec<i16> =
        (0..geometry.voxel_count()).map(|i| if i / 1600 == 12 { 1000 } else { -1000 }).collect();
    let field = BoneField::new(geometry, &hu, BoneParameters::default()).unwrap();
    for phase in 0..8 {
        let mut m = tool(|_| ());
        let mut buffer = ContactBuffer::with_capacity(128);
        let (mut z, mut most) = (-4e-3 - 0.125e-3 * f64::from(phase), f64::NEG_INFINITY);
        // The base stops where the straight tool would be 0.3 mm in the sheet.
        let sheet = 70e-3 + 12.0 * 0.5e-3 - 0.25e-3;
        let front =
            |m: &Manipulator| m.t_world_tip().translation.vector.z + m.parameters().cutter.front_radius_m();
        let stop = sheet + 0.3e-3 - front(&m);
        let place = |z: f64| {
            let mut base = BaseMotion::at_rest(Isometry3::translation(0.0, 0.0, z));
            base.linear_velocity_m_per_s.z = if z < stop { 1.0 } else { 0.0 };
            base
        };
        m.place_base(&place(z)).unwrap();
        for _ in 0..40 {
            z = (z + 1.0 * DT_S).min(stop);
            buffer.clear();
            for (index, sphere) in m.proxy_spheres().iter().enumerate() {
                let margin = 1e-4 + sphere.velocity_m_per_s.norm() * DT_S;
                field.voxels().contact_planes(index, &sphere.centre_m, sphere.radius_m, margin, &mut buffer);
            }
            m.step(DT_S, &StepInput { base: place(z), ..pull([0.0; 2], buffer.planes()) }).unwrap();
            most = most.max(front(&m));
        }
        println!("phase {phase}: front {:.3} mm beyond the sheet's surface at most", (most - sheet) * 1e3);
        // What the base imposes, and not the sheet's other side at 0.5 mm.
        assert!(most - sheet < 0.35e-3, "phase {phase}");
        assert!(m.last_report().burr_normal_force_n.z < -1.0, "phase {phase}: it rests on the sheet");
    }
}

/// A whole tool that starts inside bone, in a tunnel narrower than itself: pushed out or held, and every number stays one.
#[test]
fn a_tool_that_starts_inside_bone_stays_finite() {
    let dims = [48, 48, 240];
    let geometry = GridGeometry::axis_aligned(dims, [0.5e-3; 3], Vector3::new(-11.75e-3, -11.75e-3, -20e-3));
    let hu = vec![400; geometry.voxel_count()];
    for (bore_m, at_least) in [(0.0, 10), (2.0e-3, 27), (2.9e-3, 27)] {
        let mut field = BoneField::new(geometry, &hu, BoneParameters::default()).unwrap();
        if bore_m > 0.0 {
            let (from, to) = (Vector3::new(0.0, 0.0, -0.1), Vector3::new(0.0, 0.0, 0.08));
            field.predrill_capsule(&from, &to, bore_m);
        }
        let mut m = tool(|_| ());
        let mut buffer = ContactBuffer::with_capacity(160);
        let (mut fastest, mut active) = (0.0f64, 0);
        for _ in 0..300 {
            buffer.clear();
            for (index, sphere) in m.proxy_spheres().iter().enumerate() {
                field.voxels().contact_planes(index, &sphere.centre_m, sphere.radius_m, 1e-4, &mut buffer);
            }
            let report = m.step(DT_S, &pull([10.0, 0.0], buffer.planes())).unwrap();
            active = active.max(report.active_contact_count);
            fastest = m.proxy_spheres().iter().map(|s| s.velocity_m_per_s.norm()).fold(fastest, f64::max);
        }
        println!(
            "bore {:.1} mm: {active} contacts pressed at once, fastest sphere {fastest:.3} m/s",
            bore_m * 1e3
        );
        assert!(fastest.is_finite() && fastest < 3.0 && active >= at_least, "{active}");
    }
}
