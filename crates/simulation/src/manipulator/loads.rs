//! Gravity, base acceleration, velocity-product terms and the tip load, as planar forces on the links.

use nalgebra::Vector3;

use super::MAX_JOINTS;
use super::articulated::{Spatial, force_at};
use super::geometry::{Configuration, Layout};
use super::state::Wrench;

/// Loads from the motion of the base frame and the tip wrench, in base axes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Frame {
    /// Gravity minus the base origin's acceleration, m/s^2.
    pub gravity: Vector3<f64>,
    pub angular_velocity: Vector3<f64>,
    pub angular_acceleration: Vector3<f64>,
    /// Wrench on the burr centre.
    pub tip_wrench: Wrench,
}

/// Forces on the links, and their resultant at the flange.
#[derive(Debug, Clone)]
pub(super) struct Loads {
    /// Planar force on each link, expressed at the base origin (index 0: the shaft).
    pub force: [Spatial; MAX_JOINTS + 1],
    /// Total out-of-plane force on the tool, N.
    pub lateral: f64,
    /// Total moment about the base origin, base axes, N m.
    pub moment: Vector3<f64>,
}

impl Loads {
    pub fn new() -> Self {
        Self { force: [[0.0; 3]; MAX_JOINTS + 1], lateral: 0.0, moment: Vector3::zeros() }
    }

    /// Evaluates all loads for joint velocities `rate` and mount displacement and velocity `mount`.
    ///
    /// Neglects the gyroscopic moment of a link whose base turns about two axes at once: about I omega^2 =
    /// 1e-9 N m at 1 rad/s.
    pub fn evaluate(
        &mut self,
        layout: &Layout,
        configuration: &Configuration,
        rate: &[f64; MAX_JOINTS],
        (mount, mount_rate): (&[f64; 3], &[f64; 3]),
        frame: &Frame,
    ) {
        let turning =
            frame.angular_velocity != Vector3::zeros() || frame.angular_acceleration != Vector3::zeros();
        self.lateral = 0.0;
        self.moment = Vector3::zeros();
        let mut omega = 0.0;
        // Velocity and velocity-product acceleration of the link origin, (x, z).
        let mut v = [mount_rate[0], mount_rate[2]];
        let mut a = [0.0; 2];
        for link in 0..=layout.joints {
            let body = &layout.body[link];
            let along = body.centre_m;
            let e = configuration.axis[link];
            if link > 0 {
                omega += rate[link - 1];
            }
            let c = configuration.point(link, along);
            let centripetal = omega * omega;
            let mut acceleration = Vector3::new(
                frame.gravity.x - a[0] + centripetal * along * e[0],
                frame.gravity.y,
                frame.gravity.z - a[1] + centripetal * along * e[1],
            );
            let position = Vector3::new(c[0], mount[1], c[1]);
            if turning {
                let velocity =
                    Vector3::new(v[0] + omega * along * e[1], mount_rate[1], v[1] - omega * along * e[0]);
                let w = &frame.angular_velocity;
                acceleration -= frame.angular_acceleration.cross(&position)
                    + w.cross(&w.cross(&position))
                    + w.cross(&velocity) * 2.0;
            }
            let force = acceleration * body.mass_kg;
            let spin = -body.inertia_kg_m2 * frame.angular_acceleration.y;
            self.force[link] = force_at(&c, spin, &[force.x, force.z]);
            self.lateral += force.y;
            self.moment += position.cross(&force) + Vector3::new(0.0, spin, 0.0);
            let length = if link == 0 { layout.first_joint_m } else { layout.length_m[link - 1] };
            v = [v[0] + omega * length * e[1], v[1] - omega * length * e[0]];
            a = [a[0] - centripetal * length * e[0], a[1] - centripetal * length * e[1]];
        }
        self.add_tip(layout, configuration, mount[1], &frame.tip_wrench);
    }

    fn add_tip(&mut self, layout: &Layout, configuration: &Configuration, lateral_m: f64, wrench: &Wrench) {
        let n = layout.joints;
        let tip = configuration.point(n, layout.length_m[n - 1]);
        let planar = force_at(&tip, wrench.torque_nm.y, &[wrench.force_n.x, wrench.force_n.z]);
        for k in 0..3 {
            self.force[n][k] += planar[k];
        }
        self.lateral += wrench.force_n.y;
        let position = Vector3::new(tip[0], lateral_m, tip[1]);
        self.moment += position.cross(&wrench.force_n) + wrench.torque_nm;
    }

    /// Returns the moment about the base origin that produces a change of motion `x` (generalised velocities;
    /// link motions in `motions`).
    pub fn momentum_moment(
        layout: &Layout,
        configuration: &Configuration,
        motions: &[Spatial; MAX_JOINTS + 1],
        (lateral_m, lateral_change): (f64, f64),
    ) -> Vector3<f64> {
        let mut sum = Vector3::zeros();
        for link in 0..=layout.joints {
            let body = &layout.body[link];
            let c = configuration.point(link, body.centre_m);
            let v = super::articulated::velocity_at(&c, &motions[link]);
            let momentum = Vector3::new(v[0], lateral_change, v[1]) * body.mass_kg;
            let position = Vector3::new(c[0], lateral_m, c[1]);
            sum += position.cross(&momentum);
            sum.y += body.inertia_kg_m2 * motions[link][0];
        }
        sum
    }
}
