//! The cutting law of a twist drill: thrust and torque from its chisel edge and its two lips.
//!
//! The division into lips and chisel edge is that of Lee, Gozen and Ozdoganlar 2012 (Modeling and
//! experimentation of bone drilling forces, J. Biomech. 45:1076, doi 10.1016/j.jbiomech.2011.12.012). A drill
//! of radius R with a chisel edge of length 2c, a half point angle k and lips of rake a advances by f per
//! revolution:
//!
//! - Each lip cuts a chip of section `f/2 (R - c)` at the specific energy u. Its force along the feed is
//!   `tan(b - a) sin k` times its cutting force, where b is the friction angle (Merchant 1945, J. Appl. Phys.
//!   16:267).
//! - The chisel edge is a wedge that indents by f/2 in half a revolution: its width of contact is `f tan k`,
//!   its pressure `CHISEL_PRESSURE` times u.
//! - All edges, `2 (R - c) / sin k + 2c` long, plough with a force per length that does not depend on f.
//!
//! `F = E L + u f G` with `L = 2 (R - c) / sin k + 2c` and `G = (R - c) tan(b - a) sin k + 2 C c tan k`.
//!
//! In the terms of [`super::cutting::CuttingLaw`], a cutter with lever 2R/3 and thrust F - E L removes `pi
//! R^2 f` per revolution at u if its cutting coefficient is `3 R / (4 G)`; its torque is that coefficient
//! times `F 2R/3`. Torque, thrust and energy are then consistent, and drilling, motor and contacts need no
//! other code.
//!
//! Force per length, u and C are fitted to half of the published rows of `trabecula-lab reproduce --only 5`,
//! which prints how the law stands against the other half. The exponents of the density are not fitted: no
//! source gives the density of its bone. They are those of strength in [`super::material`].

use super::cutting::CuttingLaw;
use super::material::MaterialLaw;

/// Ploughing force of the edges per length, in bone of the reference density, N/m.
pub const EDGE_N_PER_M: f64 = 4490.0;
/// Specific cutting energy at the reference density, J/m³.
pub const ENERGY_J_PER_M3: f64 = 0.711e9;
/// Pressure of the chisel edge over the specific cutting energy.
pub const CHISEL_PRESSURE: f64 = 1.11;
/// Exponent of the density for energy and edge force.
pub const EXPONENT: f64 = 2.0;
/// Friction angle between chip and lip, degrees: an assumption, for a friction coefficient of 0.58.
const FRICTION_DEG: f64 = 30.0;

/// The constants that are fitted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TwistDrillLaw {
    /// Ploughing force of the edges per length at the reference density, N/m.
    pub edge_n_per_m: f64,
    /// Specific cutting energy at the reference density, J/m³.
    pub energy_j_per_m3: f64,
    /// Pressure of the chisel edge over the specific cutting energy.
    pub chisel_pressure: f64,
}

impl Default for TwistDrillLaw {
    fn default() -> Self {
        Self {
            edge_n_per_m: EDGE_N_PER_M,
            energy_j_per_m3: ENERGY_J_PER_M3,
            chisel_pressure: CHISEL_PRESSURE,
        }
    }
}

/// Geometry of a drill's point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DrillPoint {
    /// Radius of the drill, m.
    pub radius_m: f64,
    /// Half the length of the chisel edge, m.
    pub chisel_radius_m: f64,
    /// Point angle, from flank to flank, degrees.
    pub point_deg: f64,
    /// Rake angle of the lips, degrees.
    pub rake_deg: f64,
}

impl DrillPoint {
    /// Rake angle of the lips if a tool states none, degrees: an assumption, half the usual helix angle.
    pub const STANDARD_RAKE_DEG: f64 = 20.0;

    /// Returns the length of all edges, m.
    pub fn edge_length_m(&self) -> f64 {
        2.0 * (self.radius_m - self.chisel_radius_m) / libm::sin(self.half_point_rad())
            + 2.0 * self.chisel_radius_m
    }

    fn half_point_rad(&self) -> f64 {
        0.5 * self.point_deg.to_radians()
    }

    /// Returns G of the module: thrust without ploughing, over specific energy and feed per revolution, m.
    fn thrust_length_m(&self, chisel_pressure: f64) -> f64 {
        let half_point_rad = self.half_point_rad();
        let lip = libm::tan((FRICTION_DEG - self.rake_deg).to_radians()) * libm::sin(half_point_rad);
        // A rake beyond the friction angle pulls the lips into the bone, at most as strongly as the chisel
        // edge pushes back.
        let chisel_m = 2.0 * chisel_pressure * self.chisel_radius_m * libm::tan(half_point_rad);
        ((self.radius_m - self.chisel_radius_m) * lip + chisel_m).max(0.01 * self.radius_m)
    }
}

impl TwistDrillLaw {
    /// Returns the ratio of cutting force to thrust without ploughing.
    pub fn cutting_coefficient(&self, point: &DrillPoint) -> f64 {
        0.75 * point.radius_m / point.thrust_length_m(self.chisel_pressure)
    }

    /// Returns thrust in N and torque in N m at a feed per revolution, in bone of `density_ratio` times the
    /// reference density.
    pub fn load(&self, point: &DrillPoint, feed_m: f64, density_ratio: f64) -> [f64; 2] {
        let share = libm::pow(density_ratio, EXPONENT);
        let cutting_n = self.energy_j_per_m3 * feed_m * point.thrust_length_m(self.chisel_pressure);
        let thrust_n = share * (self.edge_n_per_m * point.edge_length_m() + cutting_n);
        [thrust_n, self.cutting_coefficient(point) * thrust_n * point.radius_m * (2.0 / 3.0)]
    }

    /// Sets the laws of material and cutting to those of a drill whose hole has the radius `hole_m`. The
    /// ploughing force is distributed evenly over the cross-section of the hole. The energy is that of the
    /// drill's cross-section: what the reach adds to the hole is not cut.
    pub fn apply(
        &self,
        point: &DrillPoint,
        hole_m: f64,
        material: &mut MaterialLaw,
        cutting: &mut CuttingLaw,
    ) {
        let share = (point.radius_m / hole_m) * (point.radius_m / hole_m);
        material.specific_energy_ref_j_m3 = self.energy_j_per_m3 * share;
        material.exponent = EXPONENT;
        let area_m2 = core::f64::consts::PI * hole_m * hole_m;
        material.edge_pressure_ref_pa = self.edge_n_per_m * point.edge_length_m() / area_m2;
        material.edge_exponent = EXPONENT;
        cutting.cutting_friction = self.cutting_coefficient(point);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const POINT: DrillPoint =
        DrillPoint { radius_m: 1.6e-3, chisel_radius_m: 0.32e-3, point_deg: 118.0, rake_deg: 20.0 };

    /// The energy balance of a drill (Shaw, Metal Cutting Principles): the torque of the cutting force alone
    /// is `u f D^2 / 8`, whatever the geometry of the point.
    #[test]
    fn torque_without_ploughing_is_the_energy_of_the_chips() {
        for (point_deg, rake_deg, chisel) in [(118.0, 20.0, 0.2), (90.0, 0.0, 0.1), (140.0, 30.0, 0.3)] {
            let point = DrillPoint { point_deg, rake_deg, chisel_radius_m: chisel * 1.6e-3, ..POINT };
            let law = TwistDrillLaw { edge_n_per_m: 0.0, ..TwistDrillLaw::default() };
            let [_, torque_nm] = law.load(&point, 0.1e-3, 1.0);
            let exact_nm = law.energy_j_per_m3 * 0.1e-3 * 3.2e-3 * 3.2e-3 / 8.0;
            assert!((torque_nm / exact_nm - 1.0).abs() < 1e-12, "{torque_nm} {exact_nm}");
        }
    }

    /// Trends that Saha et al. 1982 (J. Biomech. Eng. 104:245) and Sui and Sugita 2019 (doi
    /// 10.1007/s10439-018-02196-8) report: a longer chisel edge, a larger diameter and a larger feed raise
    /// the thrust; a larger rake lowers it.
    #[test]
    fn thrust_follows_chisel_diameter_feed_and_rake() {
        let law = TwistDrillLaw::default();
        let thrust_n = |point: DrillPoint, feed_m: f64| law.load(&point, feed_m, 1.0)[0];
        let base_n = thrust_n(POINT, 0.1e-3);
        assert!(thrust_n(DrillPoint { chisel_radius_m: 0.48e-3, ..POINT }, 0.1e-3) > 1.2 * base_n);
        let wider = DrillPoint { radius_m: 2.0e-3, chisel_radius_m: 0.4e-3, ..POINT };
        assert!(thrust_n(wider, 0.1e-3) > 1.2 * base_n);
        assert!(thrust_n(POINT, 0.2e-3) > 1.5 * base_n);
        assert!(thrust_n(DrillPoint { rake_deg: 0.0, ..POINT }, 0.1e-3) > 1.1 * base_n);
    }
}
