//! Errors of the polychromatic table relative to its sum over energies, and of a single energy relative to
//! both.

use xray::{DrrError, Material, Spectrum, SpectrumTable};

/// Tissue in front of the other material, metres.
const TISSUE_M: f64 = 0.2;

/// Errors at a tube voltage.
pub struct SpectrumErrors {
    pub tube_kv: f64,
    /// Largest difference of the table's -ln I over 490 mm of tissue and 155 mm of bone.
    pub table: f64,
    /// Photon energy at which 200 mm of tissue attenuates as much as with the spectrum, keV.
    pub effective_kev: f64,
    /// Relative overestimate of 20 mm of cortical bone and 3 mm of nitinol behind that tissue by that single
    /// energy.
    pub bone_20_mm: f64,
    pub nitinol_3_mm: f64,
}

/// Returns the errors at three tube voltages.
pub fn errors() -> Result<Vec<SpectrumErrors>, DrrError> {
    [60.0, 90.0, 120.0].into_iter().map(at).collect()
}

fn at(tube_kv: f64) -> Result<SpectrumErrors, DrrError> {
    let table = SpectrumTable::new(&Spectrum { tube_kv, ..Spectrum::default() })?;
    let nothing = [0.0; Material::COUNT];
    let mut worst = 0.0_f64;
    for t in 0..197 {
        for b in 0..131 {
            let (tissue, bone) = (f64::from(t) * 2.5e-3, f64::from(b) * 1.18e-3);
            let exact = table.exact(tissue, bone, &nothing);
            worst = worst.max((table.attenuation(tissue, bone) - exact).abs());
        }
    }
    let before = table.exact(TISSUE_M, 0.0, &nothing);
    // Water's attenuation coefficient decreases with energy.
    let (mut low, mut high) = (30.0, tube_kv);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        let thicker = Material::Water.mu_per_m(middle)? * TISSUE_M > before;
        (low, high) = if thicker { (middle, high) } else { (low, middle) };
    }
    let overrated = |material: Material, length_m: f64| {
        let mut lengths_m = nothing;
        lengths_m[material.index()] = length_m;
        let added = table.exact(TISSUE_M, 0.0, &lengths_m) - before;
        Ok::<f64, DrrError>(material.mu_per_m(low)? * length_m / added - 1.0)
    };
    Ok(SpectrumErrors {
        tube_kv,
        table: worst,
        effective_kev: low,
        bone_20_mm: overrated(Material::CorticalBone, 0.02)?,
        nitinol_3_mm: overrated(Material::Nitinol, 0.003)?,
    })
}
