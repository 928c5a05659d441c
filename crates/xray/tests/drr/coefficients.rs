//! Attenuation coefficients compared with xraylib's, which are NIST's XCOM values.

use xray::{Material, Spectrum};

const PACKAGES: [&str; 1] = ["xraylib==4.3.0"];

/// Elements by atomic number and mass fraction: ICRU-44 as NIST lists it, and the alloys' nominal
/// compositions.
const COMPOSITIONS: [(Material, &[(u32, f64)]); 10] = [
    (Material::Water, &[(1, 0.111898), (8, 0.888102)]),
    (
        Material::SoftTissue,
        &[
            (1, 0.102),
            (6, 0.143),
            (7, 0.034),
            (8, 0.708),
            (11, 0.002),
            (15, 0.003),
            (16, 0.003),
            (17, 0.002),
            (19, 0.003),
        ],
    ),
    (
        Material::CorticalBone,
        &[
            (1, 0.034),
            (6, 0.155),
            (7, 0.042),
            (8, 0.435),
            (11, 0.001),
            (12, 0.002),
            (15, 0.103),
            (16, 0.003),
            (20, 0.225),
        ],
    ),
    (Material::Nitinol, &[(28, 0.55), (22, 0.45)]),
    (Material::Steel316L, &[(26, 0.655), (24, 0.17), (28, 0.12), (42, 0.025), (25, 0.02), (14, 0.01)]),
    (Material::Titanium, &[(22, 1.0)]),
    (Material::CobaltChromium, &[(27, 0.66), (24, 0.28), (42, 0.06)]),
    (Material::Tantalum, &[(73, 1.0)]),
    (Material::Lead, &[(82, 1.0)]),
    (Material::Pmma, &[(1, 0.080538), (6, 0.599848), (8, 0.319614)]),
];
const DENSITIES_G_PER_CM3: [f64; 10] = [1.0, 1.06, 1.92, 6.45, 7.99, 4.506, 8.3, 16.65, 11.35, 1.19];

/// cm2/g of each composition at each energy.
fn xraylib(compositions: &[&[(u32, f64)]], energies_kev: &[f64]) -> Option<Vec<f64>> {
    let lists: Vec<Vec<[f64; 2]>> =
        compositions.iter().map(|c| c.iter().map(|(z, w)| [f64::from(*z), *w]).collect()).collect();
    let script = format!(
        "import xraylib\n\
         for parts in {lists:?}:\n    for e in {energies_kev:?}:\n        \
         print(sum(w * xraylib.CS_Total(int(z), e) for z, w in parts) / sum(w for _, w in parts))"
    );
    let text = crate::run_python("xraylib-4.3.0", &PACKAGES, "xraylib", &script)?;
    Some(text.lines().map(|line| line.parse().unwrap()).collect())
}

#[test]
fn coefficients_are_those_of_xcom() {
    let table = [30.0, 40.0, 50.0, 60.0, 80.0, 100.0, 120.0];
    // Between the table's energies: linear in the logarithms, 2.1 % off at most;
    // and on both sides of the K edges of tantalum and lead.
    let between = [35.0, 45.0, 55.0, 67.41, 67.42, 70.0, 88.0, 88.01, 90.0, 110.0];
    for (energies, tolerance) in [(&table[..], 1e-3), (&between[..], 0.021)] {
        let compositions = COMPOSITIONS.map(|(_, parts)| parts);
        let Some(theirs) = xraylib(&compositions, energies) else { return };
        let mut worst = 0.0_f64;
        for (i, (material, _)) in COMPOSITIONS.into_iter().enumerate() {
            for (j, energy) in energies.iter().enumerate() {
                let mass_mu = material.mu_per_m(*energy).unwrap() / 100.0 / DENSITIES_G_PER_CM3[i];
                worst = worst.max((mass_mu / theirs[i * energies.len() + j] - 1.0).abs());
            }
        }
        println!("xraylib: at {energies:?} keV worst relative difference {worst:.1e}");
        assert!(worst < tolerance, "{worst}");
    }
}

/// Attenuation by 10 mm of aluminium at each energy against xraylib's coefficient. The weights are relative,
/// so pairs are compared.
#[test]
fn the_filter_is_xcoms_aluminium() {
    let weights =
        |aluminium_mm| xray::weights(&Spectrum { tube_kv: 120.0, aluminium_mm, ..Spectrum::default() });
    let (open, filtered) = (weights(0.0), weights(10.0));
    let energies: Vec<f64> = open.iter().map(|(energy, _)| *energy).collect();
    let Some(theirs) = xraylib(&[&[(13, 1.0)]], &energies) else { return };
    let depth = |i: usize| -(filtered[i].1 / open[i].1).ln();
    let mut worst = 0.0_f64;
    for i in 1..energies.len() {
        // 2.699 g/cm3 times 1 cm.
        let (ours, want) = (depth(0) - depth(i), 2.699 * (theirs[0] - theirs[i]));
        worst = worst.max((ours - want).abs());
    }
    println!("xraylib: optical depth of 10 mm of aluminium within {worst:.1e}");
    // Interpolation of a coefficient of 1.1 to 0.15 cm2/g within 2 %, at 31 keV and at the other energy.
    assert!(worst < 0.04, "{worst}");
}
