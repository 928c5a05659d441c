//! Half-spaces: the obstacles supported by every method.

use nalgebra::{Isometry3, Unit, Vector3};
use simulation::contact_plane::ContactPlane;
use simulation::manipulator::ProxySphere;

/// A plane with a solid half-space behind it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wall {
    /// World, out of the solid.
    pub normal: Unit<Vector3<f64>>,
    /// Point on the surface, world, m.
    pub point_m: Vector3<f64>,
}

impl Wall {
    /// A wall through a point; `normal` points out of the solid.
    pub fn new(normal: Unit<Vector3<f64>>, point_m: Vector3<f64>) -> Self {
        Self { normal, point_m }
    }

    /// Returns the same wall, moved with a frame.
    pub fn moved(&self, by: &Isometry3<f64>) -> Self {
        Self { normal: by * self.normal, point_m: by.transform_point(&self.point_m.into()).coords }
    }

    /// Contact planes of the spheres that come within `margin_m` (plus their travel in `dt_s`) of the wall.
    pub fn planes(&self, spheres: &[ProxySphere], margin_m: f64, dt_s: f64, out: &mut Vec<ContactPlane>) {
        for (sphere_index, sphere) in spheres.iter().enumerate() {
            let distance = self.normal.dot(&(sphere.centre_m - self.point_m));
            let gap_m = distance - sphere.radius_m;
            if gap_m < margin_m + dt_s * sphere.velocity_m_per_s.norm() {
                let point_m = sphere.centre_m - self.normal.into_inner() * distance;
                out.push(ContactPlane::hard(sphere_index, point_m, self.normal, gap_m));
            }
        }
    }
}
