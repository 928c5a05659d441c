//! The stiffness of a flexure computed from the shape of its notches.
#![allow(clippy::unwrap_used, missing_docs)]

use simulation::manipulator::{ManipulatorParameters, Notch, Section, StiffnessRatios};

const RADII_M: [f64; 2] = [3.0e-3, 2.0e-3];

/// For 1 Pa, from `trabecula-lab chart flexure` (scikit-fem, the middle one of three, 0.15 mm), at the pitch
/// of the first, the middle and the last flexure.
#[test]
fn the_formulas_are_within_a_tenth_of_finite_elements() {
    for (pitch_m, elements) in [
        (1.32488e-3, [1.0024e-4, 8.9407e-4, 5.7806e-5, 2.6232e-11, 6.5105e-10, 7.4198e-10]),
        (1.20393e-3, [7.6300e-5, 7.2094e-4, 5.3726e-5, 1.5447e-11, 4.8956e-10, 6.4480e-10]),
        (1.12972e-3, [6.1377e-5, 6.1438e-4, 5.0605e-5, 1.0305e-11, 3.9079e-10, 5.7476e-10]),
    ] {
        let own = Notch::JHU.unit_stiffness(pitch_m, RADII_M, 0.33);
        let own = [
            own.axial_n_per_m,
            own.shear_toward_n_per_m,
            own.shear_across_n_per_m,
            own.bending_nm_per_rad,
            own.lateral_nm_per_rad,
            own.torsion_nm_per_rad,
        ];
        for (own, elements) in own.into_iter().zip(elements) {
            assert!(
                (own / elements - 1.0).abs() < 0.1,
                "pitch {pitch_m} m: {own}, finite elements {elements}"
            );
        }
    }
}

/// The table of bending stiffnesses is published, and the geometry is from CAD; a single nitinol modulus
/// reconciles them. The simulation does not use it.
#[test]
fn one_modulus_gives_the_published_bending_stiffness_of_every_flexure() {
    let tool = ManipulatorParameters::jhu_27();
    let z = &tool.joint_positions_m;
    for (i, k) in tool.joint_stiffness_nm_per_rad.iter().enumerate().skip(1).take(z.len() - 2) {
        let own = Notch::JHU.unit_stiffness(0.5 * (z[i + 1] - z[i - 1]), RADII_M, 0.33);
        let modulus_gpa = k / own.bending_nm_per_rad * 1e-9;
        assert!((26.0..33.0).contains(&modulus_gpa), "flexure {i}: {modulus_gpa} GPa");
    }
}

#[test]
fn compliances_in_series_add_up_whatever_the_number_of_links() {
    let tool = ManipulatorParameters::jhu_27();
    let total = |tool: &ManipulatorParameters, of: fn(&StiffnessRatios) -> f64| -> f64 {
        let own = tool.joint_stiffness_nm_per_rad.iter().enumerate();
        own.map(|(i, k)| 1.0 / (k * of(&tool.stiffness_ratios(i)))).sum()
    };
    for links in [1, 4, 13, 27, 64] {
        let merged = tool.with_links(links).unwrap();
        assert!(matches!(&merged.section, Section::Ratios(ratios) if ratios.len() == links));
        for of in [
            (|own| own.lateral) as fn(&StiffnessRatios) -> f64,
            |own| own.torsion,
            |own| own.axial_per_m2,
            |own| own.shear_toward_per_m2,
            |own| own.shear_across_per_m2,
        ] {
            assert!((total(&merged, of) / total(&tool, of) - 1.0).abs() < 1e-12, "{links} links");
        }
    }
}

#[test]
fn a_scene_sets_the_lateral_and_the_torsional_ratio_by_hand() {
    let mut tool = ManipulatorParameters::jhu_27();
    let own = tool.stiffness_ratios(3);
    tool.lateral_stiffness_ratio = Some(2.0);
    assert_eq!(tool.stiffness_ratios(3), StiffnessRatios { lateral: 2.0, ..own });
}
