//! Gravity, base acceleration, velocity-product terms and the tip load, as spatial forces on the links.

use nalgebra::Vector3;

use super::algebra::{
    Operator, Spatial, ZERO, add_body, add_scaled, cross_force, cross_motion, force_at, times, upper,
};
use super::layout::{Configuration, SpatialLayout};
use crate::manipulator::loads::Frame;

/// Forces on the links and their total moment at the flange.
#[derive(Debug, Clone)]
pub(super) struct Loads {
    /// Force on each link (index 0: the shaft).
    pub force: Vec<Spatial>,
    /// Inertia of each link, expressed at the base origin.
    inertia: Vec<Operator>,
    /// Total moment about the base origin, base axes, N m.
    pub moment: Vector3<f64>,
}

impl Loads {
    pub fn new(links: usize) -> Self {
        Self { force: vec![ZERO; links], inertia: vec![[ZERO; 6]; links], moment: Vector3::zeros() }
    }

    /// Evaluates all loads for the velocities `v`.
    ///
    /// Recursive Newton-Euler (Featherstone 2008, Rigid Body Dynamics Algorithms, table 5.1), in an inertial
    /// frame that coincides with the base frame at this instant and moves with its origin: `f = -(I a + V x*
    /// I V)`, with `a` the accelerations at zero joint acceleration.
    pub fn evaluate<const D: usize>(
        &mut self,
        layout: &SpatialLayout<D>,
        configuration: &Configuration<D>,
        v: &[f64],
        frame: &Frame,
    ) {
        let (w, alpha, g) = (&frame.angular_velocity, &frame.angular_acceleration, &frame.gravity);
        let mut motion = [w.x, w.y, w.z, 0.0, 0.0, 0.0];
        let mut acceleration = [alpha.x, alpha.y, alpha.z, -g.x, -g.y, -g.z];
        self.moment = Vector3::zeros();
        for link in 0..=layout.joints {
            for k in layout.freedoms_of(link) {
                let axis = &configuration.axis[k];
                let product = cross_motion(&motion, axis);
                add_scaled(&mut acceleration, v[k], &product);
                add_scaled(&mut motion, v[k], axis);
            }
            let body = &layout.body[link];
            let inertia = &mut self.inertia[link];
            *inertia = [ZERO; 6];
            let centre = configuration.point(link, body.centre_m);
            add_body(inertia, &layout.moments(link), &centre, &configuration.direction(link));
            let momentum = times(inertia, &motion);
            let mut force = times(inertia, &acceleration);
            add_scaled(&mut force, 1.0, &cross_force(&motion, &momentum));
            self.force[link] = force.map(|x| -x);
            self.moment += upper(&self.force[link]);
        }
        let n = layout.joints;
        let tip = configuration.point(n, layout.length_m[n - 1]);
        let load = force_at(&tip, &frame.tip_wrench.torque_nm, &frame.tip_wrench.force_n);
        add_scaled(&mut self.force[n], 1.0, &load);
        self.moment += upper(&load);
    }

    /// Returns the moment about the base origin that produces a change of the links' motions.
    pub fn momentum_moment(&self, change: &[Spatial]) -> Vector3<f64> {
        self.inertia.iter().zip(change).map(|(inertia, v)| upper(&times(inertia, v))).sum()
    }
}
