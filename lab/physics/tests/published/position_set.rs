//! The published position-set method accumulates velocity and tunnels, and a proxy hides energy; ours does
//! neither.

use nalgebra::{Isometry3, Vector3};
use physics_lab::{ProxyDrive, ProxyTool, Wall, proxy_of};
use simulation::manipulator::{ManipulatorModel, ManipulatorParameters};

use crate::tool::{DT_S, pressed, pull, rest};

/// The position-set contact that Phalen et al. 2023 (doi 10.1007/s11548-023-02945-8, Methods) call unstable
/// in combination with forces, in its simplest case: 10 g, 10 N, a wall of 6 mm.
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

/// E3: 30 N of tension against a wall. A proxy hides kinetic energy at rest and transmits no force; impulses
/// do neither.
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
        "kinetic energy at rest: position-set {:.1e} J, ours {:.1e} J; force on the flange {:.2} and \
         {pushed:.2} N; as a force: lost {}, {:.1e} J",
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
