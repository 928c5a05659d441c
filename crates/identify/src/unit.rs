//! Units of measured columns.

use foreign_text::nearest_name;

/// What a unit measures.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Dimension {
    /// Metre.
    Length,
    /// Radian.
    Angle,
    /// Newton.
    Force,
    /// Newton metre.
    Torque,
    /// 1 / metre.
    Curvature,
    /// Metre per second.
    Speed,
    /// Radian per second.
    AngularSpeed,
    /// Joule.
    Energy,
    /// Second.
    Time,
    /// Pixel.
    Pixel,
    /// A number.
    Number,
}

/// Every unit: name, dimension, and its size in SI units.
const UNITS: [(&str, Dimension, f64); 29] = [
    ("m", Dimension::Length, 1.0),
    ("cm", Dimension::Length, 1e-2),
    ("mm", Dimension::Length, 1e-3),
    ("um", Dimension::Length, 1e-6),
    ("rad", Dimension::Angle, 1.0),
    ("mrad", Dimension::Angle, 1e-3),
    ("deg", Dimension::Angle, core::f64::consts::PI / 180.0),
    ("N", Dimension::Force, 1.0),
    ("mN", Dimension::Force, 1e-3),
    ("gf", Dimension::Force, 9.806_65e-3),
    ("Nm", Dimension::Torque, 1.0),
    ("Nmm", Dimension::Torque, 1e-3),
    ("mNm", Dimension::Torque, 1e-3),
    ("1/m", Dimension::Curvature, 1.0),
    ("1/mm", Dimension::Curvature, 1e3),
    ("m/s", Dimension::Speed, 1.0),
    ("mm/s", Dimension::Speed, 1e-3),
    ("mm/min", Dimension::Speed, 1e-3 / 60.0),
    ("rad/s", Dimension::AngularSpeed, 1.0),
    ("deg/s", Dimension::AngularSpeed, core::f64::consts::PI / 180.0),
    ("rpm", Dimension::AngularSpeed, core::f64::consts::PI / 30.0),
    ("J", Dimension::Energy, 1.0),
    ("mJ", Dimension::Energy, 1e-3),
    ("s", Dimension::Time, 1.0),
    ("ms", Dimension::Time, 1e-3),
    ("us", Dimension::Time, 1e-6),
    ("ns", Dimension::Time, 1e-9),
    ("px", Dimension::Pixel, 1.0),
    ("1", Dimension::Number, 1.0),
];

impl Dimension {
    /// Returns its units, the first of which is that of SI.
    pub fn units(self) -> Vec<&'static str> {
        UNITS.iter().filter(|(_, dimension, _)| *dimension == self).map(|(name, ..)| *name).collect()
    }

    /// Returns the size of a unit of this dimension in SI units. Spaces do not count: `N mm` is `Nmm`.
    ///
    /// # Errors
    /// The units that it has, with the nearest one, for another or unknown unit.
    pub fn size_of(self, unit: &str) -> Result<f64, String> {
        let compact = unit.replace(' ', "");
        let own = UNITS.iter().find(|(name, dimension, _)| *name == compact && *dimension == self);
        own.map(|(.., size)| *size).ok_or_else(|| {
            let units = self.units();
            let near = nearest_name(unit, units.iter().copied());
            let meant = near.map_or(String::new(), |near| format!(" (did you mean `{near}`?)"));
            format!("one of `{}`{meant}", units.join("`, `"))
        })
    }

    /// Returns the dimension that the end of a field's name states: `_m`, `_n`, `_rad_per_s` and others.
    pub fn of_field(name: &str) -> Dimension {
        const ENDINGS: [(&str, Dimension); 8] = [
            ("_rad_per_s", Dimension::AngularSpeed),
            ("_m_per_s", Dimension::Speed),
            ("_rad", Dimension::Angle),
            ("_nm", Dimension::Torque),
            ("_n", Dimension::Force),
            ("_j", Dimension::Energy),
            ("_s", Dimension::Time),
            ("_m", Dimension::Length),
        ];
        let name = name.split('[').next().unwrap_or(name);
        let ending = ENDINGS.iter().find(|(ending, _)| name.ends_with(ending));
        ending.map_or(Dimension::Number, |(_, dimension)| *dimension)
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test fails by it")]
mod tests {
    use super::*;

    #[test]
    fn a_unit_of_another_dimension_is_refused_with_those_that_fit() {
        assert_eq!(Dimension::Length.size_of("mm").unwrap(), 1e-3);
        assert_eq!(Dimension::Torque.size_of("N mm").unwrap(), 1e-3);
        assert_eq!(Dimension::Force.size_of("mm").unwrap_err(), "one of `N`, `mN`, `gf`");
        assert!(Dimension::Angle.size_of("degs").unwrap_err().ends_with("(did you mean `deg`?)"));
    }

    #[test]
    fn the_end_of_a_fields_name_is_its_dimension() {
        for (field, dimension) in [
            ("tendon_force_n[0]", Dimension::Force),
            ("arm_joint_velocity_rad_per_s[2]", Dimension::AngularSpeed),
            ("flange_wrench.torque_nm[1]", Dimension::Torque),
            ("t_world_tip.position_m[0]", Dimension::Length),
            ("strength_share", Dimension::Number),
        ] {
            assert_eq!(Dimension::of_field(field), dimension, "{field}");
        }
    }
}
