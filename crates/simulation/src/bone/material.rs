//! Material laws of bone as functions of Hounsfield units: density, cutting energy, strength and edge
//! pressure.

use voxel_grid::density;

use super::BoneError;

/// Density law, specific cutting energy, compressive strength and edge pressure.
///
/// `rho(HU) = clamp(offset + slope HU, minimum, maximum)`, `u(rho) = u_ref (rho / rho_ref)^p`, `s(rho) =
/// s_ref (rho / rho_ref)^q` and `p_e(rho) = p_ref (rho / rho_ref)^a`.
///
/// Sources. The default density line is the apparent density of [`density`], as used in finite-element work.
/// The exponent 2 is that of compressive strength in Carter and Hayes 1977 (J. Bone Joint Surg. 59A:954),
/// applied here to cutting energy. `u_ref` for cortical bone has the order of magnitude of orthogonal
/// cutting, about 1e7 to 1e8 J/m3. Strength is Carter and Hayes' law, 68 MPa (strain rate in 1/s)^0.06
/// (density in g/cm3)^2, at 0.01/s: 186 MPa at 1.9 g/cm3, 1.3 MPa at 0.16 and 5.3 MPa at 0.32 g/cm3. Foams of
/// these two densities yielded at 0.9 to 4.5 MPa (Patel et al. 2008, BMC Musculoskelet. Disord. 9:137,
/// abstract). These are defaults, not a calibration; a scene can set its own values.
///
/// The edge pressure is the pressure of a cutter's edges before they cut: the ploughing component that sawing
/// measurements separate from shearing (J. Manuf. Sci. Eng. 143:121009). It is 0 unless a scene sets it; its
/// exponent of 1.7 is an assumption, a little below that of strength.
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
    /// Exponent p of the cutting energy.
    pub exponent: f64,
    /// Compressive strength at the reference density in Pa; infinite for bone that does not yield.
    pub strength_ref_pa: f64,
    /// Exponent q of the strength.
    pub strength_exponent: f64,
    /// Edge pressure at the reference density in Pa; 0 for edges that cut under any force.
    pub edge_pressure_ref_pa: f64,
    /// Exponent a of the edge pressure.
    pub edge_exponent: f64,
}

impl Default for MaterialLaw {
    fn default() -> Self {
        Self {
            density_offset_kg_m3: density::AT_ZERO_KG_M3,
            density_slope_kg_m3_hu: density::PER_HU_KG_M3,
            density_min_kg_m3: 50.0,
            density_max_kg_m3: 2100.0,
            specific_energy_ref_j_m3: 5.0e7,
            density_ref_kg_m3: 1900.0,
            exponent: 2.0,
            strength_ref_pa: 186.2e6,
            strength_exponent: 2.0,
            edge_pressure_ref_pa: 0.0,
            edge_exponent: 1.7,
        }
    }
}

impl MaterialLaw {
    /// Returns a law that gives every voxel the same specific cutting energy, for tests and homogeneous
    /// phantoms.
    pub fn uniform(specific_energy_j_m3: f64) -> Self {
        Self { specific_energy_ref_j_m3: specific_energy_j_m3, exponent: 0.0, ..Self::default() }
    }

    /// Returns the apparent density in kg/m3.
    pub fn density_kg_m3(&self, hu: i16) -> f64 {
        let line = self.density_offset_kg_m3 + self.density_slope_kg_m3_hu * f64::from(hu);
        line.max(self.density_min_kg_m3).min(self.density_max_kg_m3)
    }

    /// Returns the specific cutting energy in J/m3.
    pub fn specific_energy_j_m3(&self, hu: i16) -> f64 {
        let ratio = self.density_kg_m3(hu) / self.density_ref_kg_m3;
        self.specific_energy_ref_j_m3 * libm::pow(ratio, self.exponent)
    }

    /// Returns the compressive strength in Pa.
    pub fn strength_pa(&self, hu: i16) -> f64 {
        let ratio = self.density_kg_m3(hu) / self.density_ref_kg_m3;
        self.strength_ref_pa * libm::pow(ratio, self.strength_exponent)
    }

    /// Returns the edge pressure in Pa.
    pub fn edge_pressure_pa(&self, hu: i16) -> f64 {
        let ratio = self.density_kg_m3(hu) / self.density_ref_kg_m3;
        self.edge_pressure_ref_pa * libm::pow(ratio, self.edge_exponent)
    }

    fn check(&self) -> Result<(), BoneError> {
        let value = self.strength_ref_pa;
        if value.is_nan() || value <= 0.0 {
            return Err(BoneError::Parameter { name: "strength_ref_pa", value, expected: "above 0" });
        }
        let value = self.edge_pressure_ref_pa;
        if !(value.is_finite() && value >= 0.0) {
            let expected = "a finite number of at least 0";
            return Err(BoneError::Parameter { name: "edge_pressure_ref_pa", value, expected });
        }
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
            ("strength_exponent", self.strength_exponent),
            ("edge_exponent", self.edge_exponent),
        ];
        for (name, value) in finite {
            if !value.is_finite() {
                return Err(BoneError::Parameter { name, value, expected: "a finite number" });
            }
        }
        Ok(())
    }
}

/// The material laws tabulated over all Hounsfield units from the bone threshold up, so that a tick computes
/// no powers.
#[derive(Debug, Clone)]
pub(super) struct MaterialTable {
    threshold_hu: i16,
    specific_energy_j_m3: Vec<f64>,
    strength_pa: Vec<f64>,
    least_strength_pa: f64,
    edge_pressure_pa: Vec<f64>,
}

impl MaterialTable {
    /// Tabulates `law` for `threshold_hu..=32767`.
    pub fn new(law: &MaterialLaw, threshold_hu: i16) -> Result<Self, BoneError> {
        law.check()?;
        let specific_energy_j_m3 = (threshold_hu..=i16::MAX).map(|hu| law.specific_energy_j_m3(hu)).collect();
        let strength_pa: Vec<f64> = (threshold_hu..=i16::MAX).map(|hu| law.strength_pa(hu)).collect();
        let least_strength_pa =
            strength_pa.iter().fold(f64::INFINITY, |least, strength| least.min(*strength));
        let edge_pressure_pa = (threshold_hu..=i16::MAX).map(|hu| law.edge_pressure_pa(hu)).collect();
        Ok(Self { threshold_hu, specific_energy_j_m3, strength_pa, least_strength_pa, edge_pressure_pa })
    }

    /// Returns the specific cutting energy in J/m3; values below the threshold return that of the threshold.
    #[inline]
    pub fn specific_energy_j_m3(&self, hu: i16) -> f64 {
        self.specific_energy_j_m3[self.step(hu)]
    }

    /// Returns the compressive strength in Pa; values below the threshold return that of the threshold.
    #[inline]
    pub fn strength_pa(&self, hu: i16) -> f64 {
        self.strength_pa[self.step(hu)]
    }

    /// Returns the edge pressure in Pa; values below the threshold return that of the threshold.
    #[inline]
    pub fn edge_pressure_pa(&self, hu: i16) -> f64 {
        self.edge_pressure_pa[self.step(hu)]
    }

    /// Returns the minimum compressive strength of any bone, Pa.
    pub fn least_strength_pa(&self) -> f64 {
        self.least_strength_pa
    }

    #[inline]
    fn step(&self, hu: i16) -> usize {
        (i32::from(hu) - i32::from(self.threshold_hu)).max(0) as usize
    }
}
