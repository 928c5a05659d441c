//! Statics of the manipulator against another engine: a Rapier multibody of 26 hinges with implicit joint
//! springs.
//!
//! The same chain: 35 mm, 26 hinges at the midpoints of equal links, bending rigidity 1.3369e-3 N m^2, 0.1 g
//! per link.

#![allow(clippy::unwrap_used, reason = "a test that cannot build its chain has failed")]

use nalgebra::{Isometry3, Vector3};
use rapier3d_f64::prelude::{
    MassProperties, MultibodyJointHandle, PhysicsWorld, RevoluteJointBuilder, RigidBodyBuilder,
    RigidBodyHandle, Vector,
};
use simulation::manipulator::{
    BaseMotion, Manipulator, ManipulatorModel, ManipulatorParameters, StepInput, TendonCommand, Wrench,
};

const JOINTS: usize = 26;
const LENGTH_M: f64 = 0.035;
const RIGIDITY_NM2: f64 = 1.3369e-3;
const LINK_MASS_KG: f64 = 1e-4;
const DT_S: f64 = 1e-3;

fn ours(moment_nm: f64) -> [f64; 2] {
    let mut p = ManipulatorParameters::uniform_beam(JOINTS, LENGTH_M, RIGIDITY_NM2);
    p.linear_density_kg_per_m = LINK_MASS_KG * JOINTS as f64 / LENGTH_M;
    p.damping_ratio = 1.0;
    p.mount_stiffness_n_per_m = [1e9; 3];
    let base = BaseMotion::at_rest(Isometry3::identity());
    let mut m = Manipulator::new(p, &base).unwrap();
    let tip_wrench = Wrench { torque_nm: Vector3::y() * moment_nm, ..Wrench::zero() };
    let tendon = TendonCommand::Force([0.0; 2]);
    for _ in 0..1000 {
        m.step(DT_S, &StepInput { base, tendon, tip_wrench, contacts: &[] }).unwrap();
    }
    let tip = m.t_world_tip().translation.vector;
    [tip.x, tip.z]
}

/// Links along +z, hinges about +y; link i starts at hinge i, its body's origin there.
fn rapier(moment_nm: f64) -> [f64; 2] {
    let pitch = LENGTH_M / JOINTS as f64;
    let mut world = PhysicsWorld { gravity: Vector::ZERO, ..PhysicsWorld::default() };
    world.integration_parameters.dt = DT_S;
    world.integration_parameters.length_unit = 0.01;
    world.integration_parameters.num_solver_iterations = 1;
    let mut parent = world.bodies.insert(RigidBodyBuilder::fixed());
    let mut links: Vec<RigidBodyHandle> = Vec::new();
    let mut joints: Vec<MultibodyJointHandle> = Vec::new();
    for i in 0..JOINTS {
        let length = if i + 1 == JOINTS { 0.5 * pitch } else { pitch };
        let mass = MassProperties::new(
            Vector::new(0.0, 0.0, 0.5 * length),
            LINK_MASS_KG,
            Vector::new(3e-10, 3e-10, 6e-10),
        );
        let body = RigidBodyBuilder::dynamic()
            .translation(Vector::new(0.0, 0.0, (i as f64 + 0.5) * pitch))
            .additional_mass_properties(mass)
            .can_sleep(false);
        let link = world.bodies.insert(body);
        let anchor = Vector::new(0.0, 0.0, if i == 0 { 0.5 * pitch } else { pitch });
        let hinge = RevoluteJointBuilder::new(Vector::Y).local_anchor1(anchor).local_anchor2(Vector::ZERO);
        joints.push(world.multibody_joints.insert(parent, link, hinge.build(), true).unwrap());
        links.push(link);
        parent = link;
    }
    let stiffness = RIGIDITY_NM2 / pitch;
    for joint in &joints {
        let (multibody, id) = world.multibody_joints.get_mut(*joint).unwrap();
        // Axis 3 is the first angular one, about which a revolute joint rotates.
        multibody.link_mut(id).unwrap().joint.set_spring(3, stiffness, 0.0);
    }
    // The fixed root has its six degrees of freedom until the first step; only then do the dampings refer to
    // the hinges.
    world.step();
    let damping = 2.0 / 380.0 * stiffness;
    world.multibody_joints.get_mut(joints[0]).unwrap().0.damping_mut().fill(damping);
    let last = *links.last().unwrap();
    world.bodies[last].add_torque(Vector::Y * moment_nm, true);
    for _ in 0..1000 {
        world.step();
    }
    let tip = world.bodies[last].position().transform_point(Vector::new(0.0, 0.0, 0.5 * pitch));
    [tip.x, tip.z]
}

#[test]
fn end_moment_bends_our_chain_and_rapiers_multibody_to_the_same_place() {
    for moment_nm in [0.01, 0.03, 0.06] {
        let (a, b) = (ours(moment_nm), rapier(moment_nm));
        let apart_m = (a[0] - b[0]).hypot(a[1] - b[1]);
        println!(
            "{moment_nm} N m: ours ({:.6}, {:.6}) mm, Rapier ({:.6}, {:.6}) mm, {:.2e} um apart",
            a[0] * 1e3,
            a[1] * 1e3,
            b[0] * 1e3,
            b[1] * 1e3,
            apart_m * 1e6
        );
        // Both satisfy the discrete equilibrium exactly; the rest is the mount (1e9 N/m) and rounding.
        assert!(apart_m < 1e-9);
    }
}
