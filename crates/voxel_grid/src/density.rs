//! Apparent density of bone from its Hounsfield units: rho [kg/m³] = 131 + 1.067 HU.
//!
//! Source: Rho, Hobatho and Ashman 1995, Med Eng Phys 17:347.

/// Apparent density at 0 HU, kg/m³.
pub const AT_ZERO_KG_M3: f64 = 131.0;
/// Apparent density per Hounsfield unit, kg/m³.
pub const PER_HU_KG_M3: f64 = 1.067;

/// Hounsfield units of an apparent density.
pub fn hu_of(density_kg_m3: f64) -> f64 {
    (density_kg_m3 - AT_ZERO_KG_M3) / PER_HU_KG_M3
}
