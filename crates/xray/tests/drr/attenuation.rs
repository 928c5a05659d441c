//! Attenuation against independent tables.

use xray::{Material, MuTable, cortical_bone_hu};

fn assert_relative(got: f64, want: f64, tolerance: f64) {
    assert!((got / want - 1.0).abs() < tolerance, "got {got}, want {want}");
}

#[test]
fn log_log_interpolation_gives_the_published_values_at_70_kev() {
    // mu/rho (cm2/g) at 70 keV interpolated log-log from NIST by another program, to four digits.
    for (material, density, mass_mu) in [
        (Material::Water, 1.0, 0.1936),
        (Material::SoftTissue, 1.06, 0.1924),
        (Material::CorticalBone, 1.92, 0.2616),
        (Material::Nitinol, 6.45, 0.8083),
        (Material::Steel316L, 7.99, 0.8655),
        (Material::Titanium, 4.506, 0.5446),
    ] {
        // The other program also interpolates between 60 and 80 keV, so the difference is rounding only.
        assert_relative(material.mu_per_m(70.0).unwrap(), 100.0 * density * mass_mu, 3e-3);
    }
}

#[test]
fn a_second_table_agrees_within_its_slightly_different_compositions() {
    // 1/cm, from another set of mixtures (NiTi 55.8/44.2, steel Fe70Cr18Ni12 of 7.9 g/cm3, Ti 4.54 g/cm3).
    for (energy, water, soft, bone, niti, steel, titanium) in [
        (40.0, 0.2683, 0.2849, 1.278, 22.9, 28.5, 10.05),
        (60.0, 0.2059, 0.2171, 0.6044, 7.63, 9.47, 3.48),
        (100.0, 0.1707, 0.1795, 0.3562, 2.37, 2.92, 1.24),
    ] {
        let mu = |m: Material| m.mu_per_m(energy).unwrap() / 100.0;
        assert_relative(mu(Material::Water), water, 1e-3);
        assert_relative(mu(Material::SoftTissue), soft, 1e-3);
        assert_relative(mu(Material::CorticalBone), bone, 1e-3);
        assert_relative(mu(Material::Nitinol), niti, 0.01);
        assert_relative(mu(Material::Titanium), titanium, 0.012);
        // 316L has 2 to 3 % molybdenum and 1 % more density.
        assert_relative(mu(Material::Steel316L), steel, 0.07);
    }
}

#[test]
fn energies_outside_the_table_are_refused() {
    for energy in [29.9, 120.1, f64::NAN, -60.0] {
        let error = Material::Water.mu_per_m(energy).unwrap_err().to_string();
        assert!(error.contains("energy_kev") && error.contains("30 to 120 keV"), "{error}");
    }
    assert!(MuTable::new(10.0, -900).is_err());
}

#[test]
fn water_scaling_is_the_hounsfield_definition_and_air_is_nothing() {
    let water = Material::Water.mu_per_m(60.0).unwrap();
    let table = MuTable::new(60.0, -900).unwrap();
    assert_eq!(table.mu_per_m(0), water);
    assert_relative(table.mu_per_m(1000), 2.0 * water, 1e-15);
    assert_relative(table.mu_per_m(-500), 0.5 * water, 1e-15);
    assert_relative(table.mu_per_m(i16::MAX), 33.767 * water, 1e-15);
    assert_relative(table.mu_per_m(-900), 0.1 * water, 1e-12);
    for padding in [-901, -1000, -1024, -3024, i16::MIN] {
        assert_eq!(table.mu_per_m(padding), 0.0);
    }
    let clamped = MuTable::new(60.0, i16::MIN).unwrap();
    assert_eq!(clamped.mu_per_m(-2000), 0.0);
}

#[test]
fn cortical_bone_has_its_published_hounsfield_units_and_water_scaling_errs_by_12_percent() {
    // HU of ICRU-44 cortical bone by energy.
    for (energy, hu) in [(50.0, 2590.0), (60.0, 1936.0), (70.0, 1595.0), (80.0, 1331.0), (100.0, 1087.0)] {
        assert!((cortical_bone_hu(energy).unwrap() - hu).abs() < 6.0, "{energy}");
    }
    // At 60 keV, for a CT of 70 keV.
    let bone_hu = cortical_bone_hu(70.0).unwrap().round() as i16;
    let table = MuTable::new(60.0, -900).unwrap();
    let error = table.mu_per_m(bone_hu) / Material::CorticalBone.mu_per_m(60.0).unwrap() - 1.0;
    assert!((error + 0.12).abs() < 0.01, "{error}");
}

/// Values of xraylib 4.3 (CS_Total, cm2/g) at energies that are no nodes of the tables, among them both sides
/// of the K edges.
#[test]
fn materials_of_objects_have_xcoms_coefficients_between_the_nodes() {
    for (material, density, energy, mass_mu) in [
        (Material::CobaltChromium, 8.3, 35.0, 6.104),
        (Material::CobaltChromium, 8.3, 70.0, 0.9382),
        (Material::CobaltChromium, 8.3, 110.0, 0.3444),
        (Material::Tantalum, 16.65, 55.0, 4.464),
        (Material::Tantalum, 16.65, 67.3, 2.664),
        (Material::Tantalum, 16.65, 67.5, 11.76),
        (Material::Tantalum, 16.65, 90.0, 5.621),
        (Material::Lead, 11.35, 45.0, 10.57),
        (Material::Lead, 11.35, 87.9, 1.915),
        (Material::Lead, 11.35, 88.1, 7.662),
        (Material::Lead, 11.35, 110.0, 4.363),
        (Material::Pmma, 1.19, 35.0, 0.2602),
        (Material::Pmma, 1.19, 70.0, 0.1825),
        (Material::Pmma, 1.19, 110.0, 0.1596),
    ] {
        assert_relative(material.mu_per_m(energy).unwrap(), 100.0 * density * mass_mu, 0.021);
    }
}
