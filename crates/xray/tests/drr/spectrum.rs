//! The polychromatic model against the sum over energies, one energy, and published bounds.

use xray::{
    DetectorParameters, DrrParameters, DrrRenderer, FrameSeed, Grid, Material, Spectrum, SpectrumTable, Tool,
    ToolPart, VolumeView, cortical_bone_hu, weights,
};

use crate::machine::Desk;

const NONE: [f64; Material::COUNT] = [0.0; Material::COUNT];

/// The exact sum, written out here from the public weights and coefficients.
fn by_hand(spectrum: &Spectrum, lengths_m: &[(Material, f64)]) -> f64 {
    let passed: f64 = weights(spectrum)
        .iter()
        .map(|(energy, weight)| {
            let depth: f64 = lengths_m.iter().map(|(m, l)| m.mu_per_m(*energy).unwrap() * l).sum();
            weight * (-depth).exp()
        })
        .sum();
    -passed.ln()
}

#[test]
fn the_table_is_the_sum_over_energies_to_the_error_stated() {
    for tube_kv in [60.0, 90.0, 120.0] {
        let spectrum = Spectrum { tube_kv, ..Spectrum::default() };
        let table = SpectrumTable::new(&spectrum).unwrap();
        let mut worst = 0.0_f64;
        for i in 0..173 {
            for j in 0..97 {
                let (tissue, bone) = (f64::from(i) * 0.49 / 173.0, f64::from(j) * 0.155 / 97.0);
                let exact = by_hand(&spectrum, &[(Material::Water, tissue), (Material::CorticalBone, bone)]);
                worst = worst.max((table.attenuation(tissue, bone) - exact).abs());
            }
        }
        println!("{tube_kv} kV: worst error of -ln I over 490 mm of tissue and 155 mm of bone {worst:.2e}");
        // The error of linear interpolation is h^2/8 times the curvature, which is the variance of mu over
        // the remaining spectrum: at most (60 /m)^2 for bone at 60 kV, with steps of 0.625 mm: 2e-4.
        assert!(worst < 2e-4, "{worst}");
        // Outside the table, the sum itself is used.
        let far = by_hand(&spectrum, &[(Material::Water, 0.6), (Material::CorticalBone, 0.2)]);
        assert!((table.attenuation(0.6, 0.2) - far).abs() < 1e-9 * far);
    }
}

#[test]
fn a_beam_hardens() {
    let table = SpectrumTable::new(&Spectrum::default()).unwrap();
    let mut before = f64::INFINITY;
    for i in 1..40 {
        let length = f64::from(i) * 0.01;
        let mean_mu = table.exact(length, 0.0, &NONE) / length;
        assert!(mean_mu < before, "the mean coefficient falls with depth");
        before = mean_mu;
    }
    // It stays between those of the highest and of the lowest energy.
    let mu = |energy| Material::Water.mu_per_m(energy).unwrap();
    assert!(before > mu(90.0) && table.exact(1e-4, 0.0, &NONE) / 1e-4 < mu(30.0));
}

#[test]
fn weights_sum_to_one_and_bad_spectra_are_refused() {
    let spectrum = Spectrum::default();
    let weights = weights(&spectrum);
    assert!((weights.iter().map(|(_, w)| w).sum::<f64>() - 1.0).abs() < 1e-12);
    assert!(weights.iter().all(|(e, w)| (30.0..90.0).contains(e) && *w > 0.0));
    for (bad, name) in [
        (Spectrum { tube_kv: 30.0, ..spectrum }, "tube_kv"),
        (Spectrum { tube_kv: f64::NAN, ..spectrum }, "tube_kv"),
        (Spectrum { aluminium_mm: -1.0, ..spectrum }, "aluminium_mm"),
        (Spectrum { ct_energy_kev: 10.0, ..spectrum }, "ct_energy_kev"),
        (Spectrum { bone_above_hu: 2000.0, ..spectrum }, "bone_above_hu"),
    ] {
        assert!(SpectrumTable::new(&bad).unwrap_err().to_string().contains(name));
    }
}

/// Slabs of water and bone along the beam, with a metal rod across it, behind each pixel by closed form.
#[test]
fn a_frame_of_slabs_and_metal_is_the_sum_over_energies() {
    let spectrum = Spectrum::default();
    let bone_hu = cortical_bone_hu(spectrum.ct_energy_kev).unwrap().round() as i16;
    let grid = Grid::centred([40, 40, 40], [1e-3; 3]).unwrap();
    // The beam of the frontal view runs along y: 25 mm of water, 15 mm of bone.
    let hu: Vec<i16> =
        (0..grid.voxels()).map(|i| if grid.voxel_of(i)[1] < 25 { 0 } else { bone_hu }).collect();
    let view = VolumeView::new(grid, &hu).unwrap();
    let rod = ToolPart::tube([-0.01, -0.01, 0.0], [0.01, -0.01, 0.0], [2e-3, 0.0], Material::Nitinol);
    let c_arm = crate::poses::c_arm(0.0, 0.0, 41, 0.05);
    let detector = DetectorParameters { quantum_noise: false, blur_sigma_px: 0.0, ..Default::default() };
    let parameters = DrrParameters { spectrum: Some(spectrum), detector, threads: 2, ..Default::default() };
    let mut renderer = DrrRenderer::new(&view, parameters, &Desk).unwrap();
    let mut image = vec![0; c_arm.pixels()];
    let tool = Tool { parts: vec![rod], ..Tool::default() };
    renderer.render(&view, &c_arm, &tool, FrameSeed::default(), &mut image).unwrap();
    let got = renderer.line_integrals()[20 * 41 + 20];
    let metal = [(Material::Water, 0.021), (Material::CorticalBone, 0.015), (Material::Nitinol, 0.004)];
    let want = by_hand(&spectrum, &metal);
    // Half a Hounsfield unit of bone over 15 mm.
    assert!((got - want).abs() < 1e-3, "{got} {want}");
    renderer.render(&view, &c_arm, &Tool::default(), FrameSeed::default(), &mut image).unwrap();
    let got = renderer.line_integrals()[20 * 41 + 20];
    let want = by_hand(&spectrum, &[(Material::Water, 0.025), (Material::CorticalBone, 0.015)]);
    assert!((got - want).abs() < 1e-3, "{got} {want}");
    // Removal removes both parts: pixel by pixel the same as a renderer that never had them.
    let gone: Vec<u32> = (0..grid.voxels() as u32).filter(|i| i % 7 == 2).collect();
    renderer.remove(&view, &gone).unwrap();
    renderer.render(&view, &c_arm, &tool, FrameSeed::default(), &mut image).unwrap();
    let mut drilled = hu.clone();
    gone.iter().for_each(|&i| drilled[i as usize] = -1000);
    let drilled = VolumeView::new(grid, &drilled).unwrap();
    let mut fresh = DrrRenderer::new(&drilled, parameters, &Desk).unwrap();
    let mut other = vec![0; c_arm.pixels()];
    fresh.render(&drilled, &c_arm, &tool, FrameSeed::default(), &mut other).unwrap();
    assert!(image == other && renderer.line_integrals() == fresh.line_integrals());
}
