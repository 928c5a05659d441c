//! From Hounsfield units to the energy needed to cut a volume of bone.

use super::BoneError;

/// Density law and specific cutting energy.
///
/// `rho(HU) = clamp(offset + slope HU, minimum, maximum)` and `u(rho) = u_ref (rho / rho_ref)^p`.
///
/// Sources. The default density line, 131 + 1.067 HU kg/m3, is the apparent density of Rho, Hobatho and Ashman 1995 (Med. Eng. Phys.
/// 17:347) as used in finite-element work. The exponent 2 is that of compressive strength in Carter and Hayes 1977 (J. Bone Joint Surg.
/// 59A:954), applied here to cutting energy. `u_ref` for cortical bone is the order of magnitude of orthogonal cutting, about 1e7 to 1e8
/// J/m3. These are defaults, not a calibration: a scene gives its own values.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MaterialLaw {
    /// Density at 0 HU in kg/m3.
    pub density_offset_kg_m3: f64,
    /// Density per Hounsfield unit in kg/m3.
    pub density_slope_kg_m3_hu: f64,
    /// Lowest density in kg/m3, above 0.
    pub density_min_kg_m3: f64,
    /// Highest density in kg/m3.
    pub density_max_kg_m3: f64,
    /// Specific cutting energy at the reference density in J/m3.
    pub specific_energy_ref_j_m3: f64,
    /// Reference density in kg/m3.
    pub density_ref_kg_m3: f64,
    /// Exponent p.
    pub exponent: f64,
}

impl Default for MaterialLaw {
    fn default() -> Self {
        Self {
            density_offset_kg_m3: 131.0,
            density_slope_kg_m3_hu: 1.067,
            density_min_kg_m3: 50.0,
            density_max_kg_m3: 2100.0,
            specific_energy_ref_j_m3: 5.0e7,
            density_ref_kg_m3: 1900.0,
            exponent: 2.0,
        }
    }
}

impl MaterialLaw {
    /// A law that gives every voxel the same specific cutting energy, for tests and homogeneous phantoms.
    pub fn uniform(specific_energy_j_m3: f64) -> Self {
        Self { specific_energy_ref_j_m3: specific_energy_j_m3, exponent: 0.0, ..Self::default() }
    }

    /// Apparent density in kg/m3.
    pub fn density_kg_m3(&self, hu: i16) -> f64 {
        let line = self.density_offset_kg_m3 + self.density_slope_kg_m3_hu * f64::from(hu);
        line.max(self.density_min_kg_m3).min(self.density_max_kg_m3)
    }

    /// Specific cutting energy in J/m3.
    pub fn specific_energy_j_m3(&self, hu: i16) -> f64 {
        let ratio = self.density_kg_m3(hu) / self.density_ref_kg_m3;
        self.specific_energy_ref_j_m3 * libm::pow(ratio, self.exponent)
    }

    fn check(&self) -> Result<(), BoneError> {
        let positive = [
            ("density_min_kg_m3", self.density_min_kg_m3),
            ("density_max_kg_m3", self.density_max_kg_m3),
            ("specific_energy_ref_j_m3", self.specific_energy_ref_j_m3),
            ("density_ref_kg_m3", self.density_ref_kg_m3),
        ];
        for (name, value) in positive {
            if !(value.is_finite() && value > 0.0) {
                return Err(BoneError::Parameter { name, value, expected: "a finite number above 0" });
            }
        }
        let finite = [
            ("density_offset_kg_m3", self.density_offset_kg_m3),
            ("density_slope_kg_m3_hu", self.density_slope_kg_m3_hu),
            ("exponent", self.exponent),
        ];
        for (name, value) in finite {
            if !value.is_finite() {
                return Err(BoneError::Parameter { name, value, expected: "a finite number" });
            }
        }
        Ok(())
    }
}

/// The law tabulated over all Hounsfield units from the bone threshold up, so that a tick computes no powers.
#[derive(Debug, Clone)]
pub(super) struct CuttingTable {
    threshold_hu: i16,
    specific_energy_j_m3: Vec<f64>,
}

impl CuttingTable {
    /// Tabulates `law` for `threshold_hu..=32767`.
    pub fn new(law: &MaterialLaw, threshold_hu: i16) -> Result<Self, BoneError> {
        law.check()?;
        let specific_energy_j_m3 = (threshold_hu..=i16::MAX).map(|hu| law.specific_energy_j_m3(hu)).collect();
        Ok(Self { threshold_hu, specific_energy_j_m3 })
    }

    /// Specific cutting energy in J/m3; values below the threshold return that of the threshold.
    #[inline]
    pub fn specific_energy_j_m3(&self, hu: i16) -> f64 {
        let steps = (i32::from(hu) - i32::from(self.threshold_hu)).max(0) as usize;
        self.specific_energy_j_m3[steps]
    }
}
