//! The contact plane: how bone and other obstacles describe a contact to the manipulator.

use nalgebra::{Unit, Vector3};

/// A plane that a proxy sphere must not cross, in the configuration before the step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ContactPlane {
    /// Index of the proxy sphere in `ManipulatorModel::proxy_spheres`.
    pub sphere_index: usize,
    /// Point on the obstacle's surface, world, m. The step itself needs only `normal` and `gap_m`.
    pub point_m: Vector3<f64>,
    /// World-frame normal, from the obstacle to the sphere.
    pub normal: Unit<Vector3<f64>>,
    /// Distance between the sphere and the plane, negative when they overlap, m.
    pub gap_m: f64,
    /// Largest normal force that the obstacle supports before it yields, N; infinite if it never yields.
    pub strength_n: f64,
    /// How the obstacle recedes within the step under a cutting tool.
    pub give: RecessionLaw,
    /// Velocity of the obstacle's surface at the point during the step, world, m/s; `None` if it is
    /// stationary.
    pub surface_m_per_s: Option<Vector3<f64>>,
}

/// Law by which an obstacle recedes within a step under a cutting tool: all its planes recede by `m_per_n`
/// per newton of their total force above `from_n`, up to `most_m`. Without it, each step would meet the
/// obstacle of the previous step: the tool would press as hard as the contact is stiff, cut too much, and
/// find nothing to press on in the next step. All planes that recede in a step belong to one link and share
/// one law.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct RecessionLaw {
    /// Force below which nothing is cut, N.
    pub from_n: f64,
    /// Recession per force, m/N; 0 if the obstacle does not recede.
    pub m_per_n: f64,
    /// Largest recession, m.
    pub most_m: f64,
}

impl ContactPlane {
    /// Creates a plane that neither yields nor recedes.
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
            give: RecessionLaw::default(),
            surface_m_per_s: None,
        }
    }

    /// Returns the gap at the end of a step to a sphere that stays where it is, m.
    pub(crate) fn end_gap_m(&self, dt_s: f64) -> f64 {
        match &self.surface_m_per_s {
            None => self.gap_m,
            Some(surface) => self.gap_m - dt_s * surface.dot(&self.normal),
        }
    }

    /// Returns true if the gap is finite, the normal has unit length (`Unit::new_unchecked` does not
    /// guarantee it), and the strength is not negative.
    pub(crate) fn is_usable(&self) -> bool {
        self.gap_m.is_finite() && (self.normal.norm_squared() - 1.0).abs() < 1e-6 && self.strength_n >= 0.0
    }
}
