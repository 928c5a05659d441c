//! The burr and its cutting law: cutting energy as a function of force and speed.

use nalgebra::Vector3;

use super::BoneError;
use super::yielding::Indentation;

/// Law by which a burr converts force and speed to cutting energy.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CuttingLaw {
    /// Ratio mu_cut of cutting power to normal force times sliding speed. The default of 0.3 is an assumption
    /// for an abrasive burr; twist drills have a law of their own ([`super::twist_drill`]). For comparison,
    /// torque over (thrust times 2r/3) of 2.5 mm twist drills is 2.4 and 2.5 in bovine and 2.1 to 4.0 in
    /// other femurs (Orelaja et al. 2020, J. Healthcare Eng. 8817422), and of 3.2 mm twist drills 0.7 to 0.9
    /// in human femurs (MacAvelia et al. 2012, J. Biomech. Eng. 134:124503).
    pub cutting_friction: f64,
    /// Distance beyond its surface to which the burr cuts, in metres: contact compliance and tool run-out.
    /// The hole's radius is the burr's plus this.
    pub reach_m: f64,
    /// Maximum feed per revolution in metres: the depth of the teeth.
    pub feed_per_revolution_max_m: f64,
}

impl Default for CuttingLaw {
    fn default() -> Self {
        Self { cutting_friction: 0.3, reach_m: 1.0e-4, feed_per_revolution_max_m: 2.0e-4 }
    }
}

impl CuttingLaw {
    /// Returns the cutting power in W of a burr that cuts with its end; see the module.
    pub fn power_w(&self, burr: &BurrState) -> f64 {
        self.cutting_friction * burr.normal_force_n * burr.speed_rad_s.abs() * burr.radius_m * (2.0 / 3.0)
    }

    /// Returns the cutting power in W of a burr with these contacts, or with its end if there are none; see
    /// the module.
    pub(super) fn power_of_contacts_w(&self, burr: &BurrState, contacts: &[BurrContact]) -> f64 {
        if contacts.is_empty() {
            return self.power_w(burr);
        }
        let force_lever = |contact: &BurrContact| contact.normal_force_n * lever_share(contact.axis_cosine);
        let force_lever_n: f64 = contacts.iter().map(force_lever).sum();
        self.cutting_friction * force_lever_n * burr.speed_rad_s.abs() * burr.radius_m
    }

    /// Returns the maximum recession of a surface in m while the burr turns at `speed_rad_s` for `time_s`,
    /// from the teeth's feed per revolution.
    pub fn most_recession_m(&self, speed_rad_s: f64, time_s: f64) -> f64 {
        self.feed_per_revolution_max_m * speed_rad_s.abs() * time_s / core::f64::consts::TAU
    }

    /// Returns the cutting power in W of a cutter whose contacts cut at `lever_m`.
    pub(super) fn power_at_w(&self, burr: &BurrState, lever_m: f64) -> f64 {
        self.cutting_friction * burr.normal_force_n * burr.speed_rad_s.abs() * lever_m
    }

    pub(super) fn check(&self) -> Result<(), BoneError> {
        let above_zero = [
            ("cutting_friction", self.cutting_friction),
            ("reach_m", self.reach_m),
            ("feed_per_revolution_max_m", self.feed_per_revolution_max_m),
        ];
        for (name, value) in above_zero {
            if !(value.is_finite() && value > 0.0) {
                return Err(BoneError::Parameter { name, value, expected: "a finite number above 0" });
            }
        }
        Ok(())
    }
}

/// A spinning burr in contact: a ball, or the front ball of a longer cutter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BurrState {
    /// Centre in the world, metres.
    pub centre_m: Vector3<f64>,
    /// Radius in metres.
    pub radius_m: f64,
    /// Spin in rad/s; the sign does not matter.
    pub speed_rad_s: f64,
    /// Sum of the normal contact forces on the burr in N.
    pub normal_force_n: f64,
}

/// A ball of a cutter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ball {
    /// Centre in the world, metres.
    pub centre_m: Vector3<f64>,
    /// Radius in metres.
    pub radius_m: f64,
}

impl BurrState {
    /// Returns the burr as a ball.
    pub(super) fn ball(&self) -> Ball {
        Ball { centre_m: self.centre_m, radius_m: self.radius_m }
    }

    pub(super) fn check(&self, max_burr_radius_m: f64) -> Result<(), BoneError> {
        let refuse =
            |name, value, expected| Err(BoneError::Burr { name, value, expected, max_burr_radius_m });
        if let Some(value) = self.centre_m.iter().find(|x| !x.is_finite()) {
            return refuse("centre_m", *value, "finite coordinates");
        }
        if !(self.radius_m > 0.0 && self.radius_m <= max_burr_radius_m) {
            return refuse("radius_m", self.radius_m, "above 0 and at most the largest");
        }
        if !self.speed_rad_s.is_finite() {
            return refuse("speed_rad_s", self.speed_rad_s, "a finite number");
        }
        if !(self.normal_force_n.is_finite() && self.normal_force_n >= 0.0) {
            return refuse("normal_force_n", self.normal_force_n, "a finite number of at least 0");
        }
        Ok(())
    }
}

/// A contact of the burr with bone.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BurrContact {
    /// Contact normal, from the bone to the burr, world, unit length.
    pub normal: Vector3<f64>,
    /// Normal force, N.
    pub normal_force_n: f64,
    /// Cosine of the angle between the normal and the burr's axis; the sign does not matter.
    pub axis_cosine: f64,
    /// Distance from the burr centre back to the centre of the touching ball, m; 0 for a ball.
    pub behind_m: f64,
}

/// The tool's action on the bone in a tick.
#[derive(Debug, Clone, Copy)]
pub struct TickLoads<'a> {
    /// The burr.
    pub burr: &'a BurrState,
    /// The balls behind the front one, if the cutter is longer than a ball.
    pub behind: &'a [Ball],
    /// The burr's contacts with bone, whose forces add up to the burr's; empty for a burr that cuts with its
    /// end.
    pub contacts: &'a [BurrContact],
    /// Indentations made by the tool's spheres.
    pub indentations: &'a [Indentation],
}

impl TickLoads<'_> {
    /// Returns the radius where the cutter is widest, m.
    pub(super) fn widest_radius_m(&self) -> f64 {
        self.behind.iter().fold(self.burr.radius_m, |widest, ball| ball.radius_m.max(widest))
    }

    /// Checks the balls behind the front one.
    pub(super) fn check_behind(&self, max_burr_radius_m: f64, cutter_span_m: f64) -> Result<(), BoneError> {
        for ball in self.behind {
            BurrState { centre_m: ball.centre_m, radius_m: ball.radius_m, ..*self.burr }
                .check(max_burr_radius_m)?;
            let value = (ball.centre_m - self.burr.centre_m).norm();
            // Allow for rounding in the chain's arithmetic.
            if value > cutter_span_m * (1.0 + 1e-6) {
                let expected = "at most cutter_span_m";
                let name = "distance from the front ball to one behind it";
                return Err(BoneError::Burr { name, value, expected, max_burr_radius_m });
            }
        }
        Ok(())
    }
}

/// Returns the mean distance from the axis, as a fraction of the radius, over the half of a ball that faces a
/// contact, weighted by projected area along the contact normal: the lever arm at which the contact cuts.
/// `axis_cosine` is the cosine of the angle between normal and axis.
///
/// `L = (1/pi) integral over n.u > 0 of sqrt(1 - (u.a)^2) (n.u) dS`, for unit vectors n (normal), a (axis)
/// and u. The lever of a point, the sine of its angle from the axis, is a sum of Legendre polynomials, pi/4
/// (1 - 5/8 P2 - 9/64 P4 - 65/1024 P6); facing the contact multiplies each by the coefficient of a clamped
/// cosine, 1, 1/4, -1/24 and 1/64 (Funk-Hecke theorem; coefficients from Ramamoorthi and Hanrahan 2001, J.
/// Opt. Soc. Am. A 18:2448, divided by pi). The four terms are within 2e-4 of the integral, which is 2/3 at
/// the end and 8/(3 pi) at the side.
pub fn lever_share(axis_cosine: f64) -> f64 {
    let c2 = (axis_cosine * axis_cosine).min(1.0);
    let p2 = 0.5 * (3.0 * c2 - 1.0);
    let p4 = 0.125 * ((35.0 * c2 - 30.0) * c2 + 3.0);
    let p6 = 0.0625 * (((231.0 * c2 - 315.0) * c2 + 105.0) * c2 - 5.0);
    core::f64::consts::FRAC_PI_4 * (1.0 - 5.0 / 32.0 * p2 + 3.0 / 512.0 * p4 - 65.0 / 65_536.0 * p6)
}

pub(super) fn check_time_step(dt_s: f64, max_burr_radius_m: f64) -> Result<(), BoneError> {
    if dt_s.is_finite() && dt_s > 0.0 {
        return Ok(());
    }
    let expected = "a finite number of seconds above 0";
    Err(BoneError::Burr { name: "time step", value: dt_s, expected, max_burr_radius_m })
}
