//! The contact plane: how bone and other obstacles describe a contact to the manipulator.

use nalgebra::{Unit, Vector3};

/// A plane that a proxy sphere must not cross, in the configuration before the step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ContactPlane {
    /// Index of the proxy sphere, as in `ManipulatorModel::proxy_spheres`.
    pub sphere_index: usize,
    /// Point on the obstacle's surface, world, m. The step itself needs only `normal` and `gap_m`.
    pub point_m: Vector3<f64>,
    /// World, from the obstacle to the sphere.
    pub normal: Unit<Vector3<f64>>,
    /// Distance between the sphere and the plane, negative when they overlap, m.
    pub gap_m: f64,
    /// Most normal force that the obstacle bears before it yields, N; infinite if it does not yield.
    pub strength_n: f64,
    /// How it recedes within the step under a tool that cuts it.
    pub give: Give,
}

/// How an obstacle recedes within a step under a tool that cuts it: at all its planes by `m_per_n` for each
/// newton above `from_n` of the sum of the forces on them, up to `most_m`. Without it the tool meets in each
/// step the obstacle of the step before, presses as hard as the contact is stiff, cuts too much, and finds
/// nothing to press on in the next. All planes that recede in a step are of one link and have one law.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Give {
    /// Force up to which nothing is cut, N.
    pub from_n: f64,
    /// 0: it does not recede.
    pub m_per_n: f64,
    /// m.
    pub most_m: f64,
}

impl ContactPlane {
    /// A plane that neither yields nor recedes.
    pub fn hard(
        sphere_index: usize,
        point_m: Vector3<f64>,
        normal: Unit<Vector3<f64>>,
        gap_m: f64,
    ) -> ContactPlane {
        ContactPlane {
            sphere_index,
            point_m,
            normal,
            gap_m,
            strength_n: f64::INFINITY,
            give: Give::default(),
        }
    }

    /// True if the gap is finite, the normal has unit length, which `Unit::new_unchecked` does not guarantee,
    /// and the strength is not negative.
    pub(crate) fn is_usable(&self) -> bool {
        self.gap_m.is_finite() && (self.normal.norm_squared() - 1.0).abs() < 1e-6 && self.strength_n >= 0.0
    }
}
