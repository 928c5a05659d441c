//! Error of the spectrum's table against the sum over energies.

use drr_proc::spectrum::SpectrumTable;
use drr_proc::{DrrError, Material, Spectrum};

/// Tube voltage, and the largest error of -ln I over 490 mm of tissue and 155 mm of bone.
pub fn errors() -> Result<Vec<(f64, f64)>, DrrError> {
    [60.0, 90.0, 120.0]
        .into_iter()
        .map(|tube_kv| {
            let table = SpectrumTable::new(&Spectrum { tube_kv, ..Spectrum::default() })?;
            let mut worst = 0.0_f64;
            for t in 0..197 {
                for b in 0..131 {
                    let (tissue, bone) = (f64::from(t) * 2.5e-3, f64::from(b) * 1.18e-3);
                    let exact = table.exact(tissue, bone, &[0.0; Material::COUNT]);
                    worst = worst.max((table.attenuation(tissue, bone) - exact).abs());
                }
            }
            Ok((tube_kv, worst))
        })
        .collect()
}
