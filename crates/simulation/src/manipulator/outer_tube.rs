//! Springs of the flexures of a tool that slides out of a straight outer tube.
//!
//! Two concentric tubes without clearance bend by the same angle. The unloaded outer tube is straight, so
//! where both overlap, the curvature is the mean of theirs, weighted by bending stiffness: `kappa = k_i
//! kappa_i / (k_i + k_o)` (Dupont, Lock, Itkowitz and Butler 2010, "Design and control of concentric-tube
//! robots", IEEE Trans. Robotics 26, 209, eq. 6; Webster, Romano and Cowan 2009, IEEE Trans. Robotics 25,
//! 67). For a flexure whose section of tube is deployed by the fraction f, the two parts are in series:
//!
//! `1/k = f / k_i + (1 - f) / (k_i + k_o)`, `q_0 = q_i (f + (1 - f) k_i / (k_i + k_o))`, with `k_o = E I /
//! length`.
//!
//! The outer tube bends only where it contains flexures; the rest is rigid, like the tool's shaft. The tool
//! slides and turns in it without friction, so stretch, shear and torsion are those of the tool alone.

use super::common::Common;
use super::geometry::SphereKind;
use super::parameters::ManipulatorParameters;

/// A straight outer tube on the tool base, out of which the tool slides.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OuterTube {
    /// Distance from the base to its end, m.
    pub end_m: f64,
    /// Outer radius, m, which is that of the contact spheres that it covers.
    pub outer_radius_m: f64,
    /// Bending stiffness E I, N m².
    pub bending_nm2: f64,
}

/// The bending spring of a flexure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BendingSpring {
    /// Stiffness in the bending plane, N m/rad.
    pub bend_nm_per_rad: f64,
    /// Stiffness across the bending plane, N m/rad.
    pub lateral_nm_per_rad: f64,
    /// Unloaded bend, rad.
    pub rest_rad: f64,
}

impl OuterTube {
    /// Returns the radius of a contact sphere at `along_m` from the base of the retracted tool, whose own
    /// radius is `own_m`. The outer tube's end is round.
    fn radius_m(&self, along_m: f64, own_m: f64, deployed_m: f64) -> f64 {
        let behind_m = self.end_m - (along_m + deployed_m);
        let share = (behind_m / self.outer_radius_m).clamp(0.0, 1.0);
        own_m + share * (self.outer_radius_m - own_m)
    }
}

impl ManipulatorParameters {
    /// Returns the spring of flexure `joint` with `deployed_m` of the tool out of its outer tube; without an
    /// outer tube, that of the tool.
    pub fn bending_spring(&self, joint: usize, deployed_m: f64) -> BendingSpring {
        let own = self.joint_stiffness_nm_per_rad.get(joint).copied().unwrap_or(0.0);
        let lateral = self.stiffness_ratios(joint).lateral * own;
        let rest_rad = self.rest_rad(joint);
        let Some(outer) = &self.outer_tube else {
            return BendingSpring { bend_nm_per_rad: own, lateral_nm_per_rad: lateral, rest_rad };
        };
        let [from_m, to_m] = [joint, joint + 1].map(|edge| self.cell_edge_m(edge));
        let length_m = to_m - from_m;
        let out = ((to_m + deployed_m - outer.end_m) / length_m).clamp(0.0, 1.0);
        let added = outer.bending_nm2 / length_m;
        let with = |k: f64| 1.0 / (out / k + (1.0 - out) / (k + added));
        BendingSpring {
            bend_nm_per_rad: with(own),
            lateral_nm_per_rad: with(lateral),
            rest_rad: rest_rad * (out + (1.0 - out) * own / (own + added)),
        }
    }
}

impl Common {
    /// Sets the radius of every shaft and segment sphere with `deployed_m` of the tool out of its outer tube.
    pub(super) fn cover_spheres(&mut self, deployed_m: f64) {
        let p = &self.parameters;
        let Some(outer) = &p.outer_tube else { return };
        for (sphere, shown) in self.sphere_layout.iter_mut().zip(&mut self.spheres) {
            let (own_m, link_m) = match sphere.kind {
                SphereKind::Shaft => (p.shaft_sphere_radius_m, 0.0),
                SphereKind::Segment(joint) => {
                    (p.segment_sphere_radius_m, p.joint_positions_m.get(joint).copied().unwrap_or(0.0))
                }
                SphereKind::Burr => continue,
            };
            sphere.radius_m = outer.radius_m(link_m + sphere.along_m, own_m, deployed_m);
            shown.radius_m = sphere.radius_m;
        }
    }
}
