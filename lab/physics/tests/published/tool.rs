//! The published tool in free space and pressed against a wall.

use nalgebra::{Isometry3, Vector3};
use physics_lab::Wall;
use simulation::contact_plane::ContactPlane;
use simulation::manipulator::{
    BaseMotion, Manipulator, ManipulatorModel, ManipulatorParameters, StepInput, TendonCommand, Wrench,
};

pub const DT_S: f64 = 1e-3;

pub fn rest() -> BaseMotion {
    BaseMotion::at_rest(Isometry3::identity())
}

pub fn pull(tension_n: [f64; 2], contacts: &[ContactPlane]) -> StepInput<'_> {
    let tendon = TendonCommand::Force(tension_n);
    StepInput { base: rest(), tendon, tip_wrench: Wrench::zero(), contacts }
}

/// Pulls the tool with 8 N against a wall 8 mm beside the axis, for a second; tool and wall can be moved
/// together.
pub fn pressed(place: Isometry3<f64>) -> Manipulator {
    let mut p = ManipulatorParameters { damping_ratio: 1.0, ..ManipulatorParameters::jhu_27() };
    p.contact.friction_coefficient = 0.0;
    let base = BaseMotion::at_rest(place);
    let mut m = Manipulator::new(p, &base).unwrap();
    let wall = Wall::new(-Vector3::x_axis(), Vector3::x() * 8e-3).moved(&place);
    let mut planes = Vec::new();
    for _ in 0..1000 {
        planes.clear();
        wall.planes(m.proxy_spheres(), 1e-3, DT_S, &mut planes);
        m.step(DT_S, &StepInput { base, ..pull([8.0, 0.0], &planes) }).unwrap();
    }
    m
}
