//! Rules of the published simulator as arithmetic, so that tests can show where they fail. Constants and
//! formulas come from its source (htp2/continuum-manip-volumetric-drilling-plugin, 2023, and Bullet's
//! `btGeneric6DofSpring2Constraint`).

/// Contact force in N: `w m ((b / dt) penetration - 2 v_n)`, one pass, nothing accumulated. At rest it is a
/// spring of stiffness `w m b / dt`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PenaltyContact {
    /// Mass of the body, kg.
    pub mass_kg: f64,
    /// Impulse weight w.
    pub weight: f64,
    /// Fraction b of the penetration that one step removes.
    pub bias: f64,
    /// Step, s.
    pub dt_s: f64,
}

impl PenaltyContact {
    /// The constants of the later version: w = 50, m = 1 g, b = 0.4.
    pub fn published(dt_s: f64) -> Self {
        Self { mass_kg: 1e-3, weight: 50.0, bias: 0.4, dt_s }
    }

    /// Force out of the surface, N. Penetration is positive for overlap, m; speed is positive out of the
    /// surface, m/s.
    pub fn force_n(&self, penetration_m: f64, speed_m_per_s: f64) -> f64 {
        if penetration_m <= 0.0 {
            return 0.0;
        }
        self.weight * self.mass_kg * (self.bias / self.dt_s * penetration_m - 2.0 * speed_m_per_s)
    }
}

/// Penetration as the first version computed it, m. It uses the contact point on the anatomy, an absolute
/// position, as a lever arm from the anatomy's origin, which counts the height of that origin twice.
pub fn penetration_with_absolute_arm_m(penetration_m: f64, anatomy_height_m: f64) -> f64 {
    penetration_m - anatomy_height_m
}

/// Returns the effective stiffness of Bullet's six-axis spring: if `omega dt` exceeds 1/4 it is `m_eff / (16
/// dt^2)`, regardless of the requested stiffness. N m/rad with `m_eff` in kg m².
pub fn spring_that_runs(asked: f64, effective_inertia: f64, dt_s: f64) -> f64 {
    let omega = libm::sqrt(asked / effective_inertia);
    if omega * dt_s > 0.25 { effective_inertia / (16.0 * dt_s * dt_s) } else { asked }
}

/// Returns voxel hardness as stored by the published script: `(HU - min) / (max - min)` above -1000 HU,
/// written to a
/// 16-bit integer array, with 0.5 added on reading.
pub fn hardness_through_integers(hu: &[i16]) -> Vec<f64> {
    let inside = |hu: &&i16| **hu > -1000;
    let low = hu.iter().filter(inside).min().copied().unwrap_or(0);
    let high = hu.iter().filter(inside).max().copied().unwrap_or(1);
    let range = (f64::from(high) - f64::from(low)).max(1.0);
    let share = |hu: &i16| if *hu > -1000 { (f64::from(*hu) - f64::from(low)) / range } else { 0.0 };
    hu.iter().map(|hu| f64::from(share(hu) as i16) + 0.5).collect()
}

/// Converts a CT value to a stack of 8-bit images over the given window, as in the published system's
/// volumes, and back.
pub fn through_eight_bits(hu: i16, low: i16, high: i16) -> i16 {
    let range = f64::from(high) - f64::from(low);
    let level = (255.0 * (f64::from(hu) - f64::from(low)) / range).round().clamp(0.0, 255.0);
    (f64::from(low) + level * range / 255.0).round() as i16
}
