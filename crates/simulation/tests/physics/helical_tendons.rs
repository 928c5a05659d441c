//! Helical tendons. `clients/python/tests/test_helical_tendons.py` solves the statics of one in SciPy; these
//! tests need no solver.

#![allow(clippy::unwrap_used, reason = "a helper that fails is a failed test")]

use nalgebra::{Isometry3, Vector3};
use simulation::manipulator::{
    AnyManipulator, BaseMotion, ManipulatorError, ManipulatorModel, ManipulatorParameters, Rung, StepInput,
    TendonCommand, TendonRoute, Wrench,
};

const LENGTH_M: f64 = 0.04;
const RADIUS_M: f64 = 2.0e-3;
const TENSION_N: f64 = 4.0;

/// A round beam with tendons at equal angles about its axis.
fn beam(links: usize, tendons: usize, twist_rad_per_m: f64) -> ManipulatorParameters {
    let mut p = ManipulatorParameters::uniform_beam(links, LENGTH_M, 1.3e-3);
    p.damping_ratio = 1.0;
    p.mount_stiffness_n_per_m = [1e9; 3];
    // Thin: neither shear nor compression.
    p.tube_radii_m = [1e-5, 0.0];
    p.gravity_m_per_s2 = Vector3::zeros();
    let route = |number: usize| {
        let (sin, cos) = (core::f64::consts::TAU * number as f64 / tendons as f64).sin_cos();
        TendonRoute { channel_m: [RADIUS_M * cos, RADIUS_M * sin], twist_rad_per_m, ..TendonRoute::default() }
    };
    p.tendon_routes = Some((0..tendons).map(route).collect());
    p
}

fn settled(rung: Rung, p: &ManipulatorParameters, command: TendonCommand) -> AnyManipulator {
    let base = BaseMotion::at_rest(Isometry3::identity());
    let mut m = AnyManipulator::new(rung, p.clone(), &base).unwrap();
    for _ in 0..600 {
        let input = StepInput { base, tendon: command, tip_wrench: Wrench::zero(), contacts: &[] };
        m.step(1e-3, &input).unwrap();
    }
    m
}

/// Three equal tensions balance in bending, and twist a straight tool by `3 T r sin b` over its torsional
/// stiffness: `GJ`, by Poisson's ratio `EI / (1 + nu)`, along its whole length. b is the angle of the helix.
#[test]
fn three_helical_tendons_wind_a_straight_tool_as_the_closed_form_says() {
    for twist in [-60.0, 60.0] {
        let angle = |rung: Rung, links: usize| {
            let p = beam(links, 3, twist);
            let m = settled(rung, &p, TendonCommand::EachForce([TENSION_N, TENSION_N, TENSION_N, 0.0]));
            let tip = m.t_world_tip();
            assert!(
                tip.translation.vector.xy().norm() < 1e-7,
                "it stays straight: {}",
                tip.translation.vector
            );
            tip.rotation.scaled_axis().z
        };
        let ratio = beam(8, 3, twist).stiffness_ratios(0).torsion;
        // The twist rotates the helix itself; at equilibrium its twist rate differs by the angle per length.
        let exact = {
            let mut wound = 0.0;
            for _ in 0..50 {
                let slope = (RADIUS_M * (twist + wound)).atan();
                wound = -3.0 * TENSION_N * RADIUS_M * slope.sin() / (ratio * 1.3e-3);
            }
            wound * LENGTH_M
        };
        for rung in [Rung::Spatial, Rung::Full] {
            let (coarse, fine) = (angle(rung, 16), angle(rung, 32));
            println!(
                "{rung:?}, {twist} rad/m: {coarse:.6} rad at 16 links, {fine:.6} at 32, closed form \
                 {exact:.6}"
            );
            // Second order: the chords' arm r cos(f/2), with f = 0.075 rad per flexure, is 7e-4 too short.
            assert!((fine / exact - 1.0).abs() < 2e-3, "{fine} {exact}");
            assert!((fine - exact).abs() < 0.3 * (coarse - exact).abs(), "{coarse} {fine} {exact}");
        }
    }
}

/// A tendon with negligible twist behaves like a parallel one.
#[test]
fn a_tendon_that_hardly_winds_bends_as_a_parallel_one() {
    for rung in [Rung::Spatial, Rung::Full] {
        let tip_m = |twist: f64| {
            let m = settled(rung, &beam(32, 1, twist), TendonCommand::EachForce([TENSION_N, 0.0, 0.0, 0.0]));
            m.t_world_tip().translation.vector
        };
        let (parallel_m, wound_m) = (tip_m(0.0), tip_m(1e-6));
        println!("{rung:?}: {:.2e} m apart", (parallel_m - wound_m).norm());
        // Straight from hole to hole over a pitch of 1.25 mm instead of continuous: the chord of an arc of
        // 0.25 rad over 40 mm.
        assert!((parallel_m - wound_m).norm() < 10e-6, "{parallel_m} {wound_m}");
    }
}

#[test]
fn rungs_that_do_not_twist_refuse_it() {
    let base = BaseMotion::at_rest(Isometry3::identity());
    for rung in [Rung::Planar, Rung::ConstantCurvature] {
        let refused = AnyManipulator::new(rung, beam(16, 1, 60.0), &base).unwrap_err();
        assert!(
            matches!(refused, ManipulatorError::OutOfRange { field: "tendon_routes.twist_rad_per_m", .. }),
            "{refused}"
        );
    }
    let refused = AnyManipulator::new(Rung::Spatial, beam(4, 1, 100.0), &base).unwrap_err();
    assert!(refused.to_string().contains("at most an eighth of a turn"), "{refused}");
}
