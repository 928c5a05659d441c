//! The rungs of the manipulator ladder against closed forms, published tables and each other.

#![allow(clippy::unwrap_used, reason = "a test that cannot build its tool has failed")]

use crate::common::{rest, wall_at};
use nalgebra::Vector3;
use simulation::manipulator::{
    AnyManipulator, Integrator, Manipulator, ManipulatorModel, ManipulatorParameters, Rung, SpatialChain,
    StepInput, TendonCommand, Wrench,
};

const LENGTH_M: f64 = 0.035;
const RIGIDITY_NM2: f64 = 1.3369e-3;
const SLACK: TendonCommand = TendonCommand::Force([0.0; 2]);

fn beam(links: usize) -> ManipulatorParameters {
    let mut p = ManipulatorParameters::uniform_beam(links, LENGTH_M, RIGIDITY_NM2);
    p.damping_ratio = 1.0;
    p.mount_stiffness_n_per_m = [1e9; 3];
    // Thin, so that the axial and shear stiffnesses of the full rung, EI 4 / r^2, do not matter.
    p.tube_radii_m = [1e-5, 0.0];
    p
}

fn settle<M: ManipulatorModel>(m: &mut M, tendon: TendonCommand, tip_wrench: Wrench, steps: usize) {
    for _ in 0..steps {
        m.step(1e-3, &StepInput { base: rest(), tendon, tip_wrench, contacts: &[] }).unwrap();
    }
}

fn tip<M: ManipulatorModel>(m: &M) -> Vector3<f64> {
    m.t_world_tip().translation.vector
}

fn new(rung: Rung, p: ManipulatorParameters) -> AnyManipulator {
    AnyManipulator::new(rung, p, &rest()).unwrap()
}

#[test]
fn pure_end_moment_bends_every_rung_to_the_arc() {
    let moment = 0.06;
    let a = moment * LENGTH_M / RIGIDITY_NM2;
    let arc = Vector3::new(LENGTH_M * (1.0 - a.cos()) / a, 0.0, LENGTH_M * a.sin() / a);
    for rung in Rung::ALL {
        let mut last = f64::MAX;
        for links in [8, 16, 32, 64] {
            if matches!(rung, Rung::Modal | Rung::Planar) && links > 32 {
                // The maximum for these rungs.
                continue;
            }
            let mut m = new(rung, beam(links));
            settle(&mut m, SLACK, Wrench { torque_nm: Vector3::y() * moment, ..Wrench::zero() }, 600);
            let error = (tip(&m) - arc).norm();
            println!("{} n={links}: arc error {:.3} um", rung.name(), error * 1e6);
            if rung == Rung::ConstantCurvature {
                // Exact; the rest is the mount and rounding.
                assert!(error < 1e-9, "{error}");
            } else {
                // Second order: a factor of 4 each time; 3.5 leaves room for the next order.
                assert!(error < last / 3.5, "{} n={links}: {error} after {last}", rung.name());
            }
            last = error;
        }
        assert!(last < if matches!(rung, Rung::Modal | Rung::Planar) { 8e-6 } else { 2e-6 });
    }
}

/// P L^2 / EI.
const LOADS: [f64; 7] = [0.25, 0.5, 1.0, 2.0, 4.0, 6.0, 10.0];

/// Tip of the elastica under a transverse dead force at the tip, divided by L, and its angle: theta'' = -a
/// cos theta, theta(0) = 0, theta'(1) = 0, by shooting with RK4 in 4000 steps.
fn elastica(a: f64) -> [f64; 3] {
    let shoot = |k0: f64| {
        let n = 4000;
        let h = 1.0 / n as f64;
        let f = |y: [f64; 4]| [y[1], -a * y[0].cos(), y[0].sin(), y[0].cos()];
        let mut y = [0.0, k0, 0.0, 0.0];
        for _ in 0..n {
            let add = |y: [f64; 4], s: f64, k: [f64; 4]| [0, 1, 2, 3].map(|i| y[i] + s * k[i]);
            let k1 = f(y);
            let k2 = f(add(y, 0.5 * h, k1));
            let k3 = f(add(y, 0.5 * h, k2));
            let k4 = f(add(y, h, k3));
            y = [0, 1, 2, 3].map(|i| y[i] + h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]));
        }
        y
    };
    let (mut low, mut high) = (0.0, a);
    for _ in 0..80 {
        let middle = 0.5 * (low + high);
        if shoot(middle)[1] > 0.0 { high = middle } else { low = middle }
    }
    let y = shoot(0.5 * (low + high));
    [y[2], y[3], y[0]]
}

#[test]
fn tip_force_follows_the_elastica() {
    // Mattiasson 1981 (Numerical results from large deflection beam and frame problems analysed by means of
    // elliptic integrals, Int. J. Numer. Methods Eng. 17, 145), cantilever with an end load: checks the
    // shooting itself.
    for (a, lateral, shortening) in
        [(1.0, 0.30172, 0.05643), (5.0, 0.71379, 0.38763), (10.0, 0.81061, 0.55500)]
    {
        let [x, z, _] = elastica(a);
        assert!((x - lateral).abs() < 6e-6 && (1.0 - z - shortening).abs() < 6e-6, "{a}: {x} {z}");
    }
    for a in LOADS {
        let [x, z, angle_rad] = elastica(a);
        let exact = Vector3::new(x, 0.0, z) * LENGTH_M;
        let force_n = Vector3::x() * (a * RIGIDITY_NM2 / (LENGTH_M * LENGTH_M));
        for rung in [Rung::Planar, Rung::Spatial, Rung::Full] {
            // The planar rung supports up to 32 links.
            let coarser = if rung == Rung::Planar { 2 } else { 1 };
            let errors = [16, 32, 64].map(|links| links / coarser).map(|links| {
                let mut m = new(rung, beam(links));
                settle(&mut m, SLACK, Wrench { force_n, ..Wrench::zero() }, 700);
                let off_rad = (m.bend_rad() - angle_rad).abs();
                assert!(off_rad < 3e-3 * (32.0 / links as f64).powi(2), "{links}: {off_rad} rad");
                (tip(&m) - exact).norm()
            });
            let um = errors.map(|e| e * 1e6);
            println!("{} a={a}: {um:.3?} um, the links doubled each time", rung.name());
            // Second order; a prototype with 26 hinges was off by 21 um at a = 10.
            assert!(errors[1] < errors[0] / 3.0 && errors[2] < errors[1] / 3.0, "{um:?}");
            assert!(errors[2] < 5e-6 * (coarser * coarser) as f64, "{um:?}");
        }
    }
}

#[test]
fn loads_out_of_the_plane_follow_euler_bernoulli_and_saint_venant() {
    let links = 40;
    for rung in [Rung::Spatial, Rung::Full] {
        let mut p = beam(links);
        p.lateral_stiffness_ratio = Some(3.0);
        p.torsion_stiffness_ratio = Some(0.7);
        // Small: 1e-4 of the length, so the elastica's next order is the square of that.
        let force = 3e-4 * 3.0 * RIGIDITY_NM2 / (LENGTH_M * LENGTH_M);
        let mut m = new(rung, p.clone());
        settle(&mut m, SLACK, Wrench { force_n: Vector3::y() * force, ..Wrench::zero() }, 500);
        let exact = force * LENGTH_M.powi(3) / (3.0 * 3.0 * RIGIDITY_NM2);
        let lateral = tip(&m).y / exact - 1.0;
        let mut m = new(rung, p.clone());
        let moment = 0.02;
        settle(&mut m, SLACK, Wrench { torque_nm: Vector3::z() * moment, ..Wrench::zero() }, 500);
        let twist = m.t_world_tip().rotation.scaled_axis();
        let exact = moment * LENGTH_M / (0.7 * RIGIDITY_NM2);
        println!("{}: lateral {lateral:+.2e}, twist {:+.2e} off", rung.name(), twist.z / exact - 1.0);
        // The discrete cantilever is off by 1 / (2 n^2) = 3e-4; torsion is exact.
        assert!(lateral.abs() < 4e-4, "{lateral}");
        assert!((twist.z / exact - 1.0).abs() < 1e-9 && twist.xy().norm() < 1e-9);
    }
}

#[test]
fn full_rung_shears_and_stretches_as_a_timoshenko_beam() {
    let mut p = beam(40);
    p.tube_radii_m = [3e-3, 2e-3];
    let (nu, area_over_moment) = (p.poisson_ratio, 4.0 / (9e-6 + 4e-6));
    let axial_n = RIGIDITY_NM2 * area_over_moment;
    let force = 0.01;
    let mut m = new(Rung::Full, p.clone());
    let force_n = Vector3::new(force, 0.0, 0.0);
    settle(&mut m, SLACK, Wrench { force_n, ..Wrench::zero() }, 500);
    let bending = force * LENGTH_M.powi(3) / (3.0 * RIGIDITY_NM2);
    let shear = force * LENGTH_M / (axial_n / (4.0 + 3.0 * nu));
    let off = (tip(&m).x - bending - shear) / (bending + shear);
    let mut m = new(Rung::Full, p);
    settle(&mut m, SLACK, Wrench { force_n: Vector3::z(), ..Wrench::zero() }, 500);
    let stretch = (tip(&m).z - LENGTH_M) / (LENGTH_M / axial_n) - 1.0;
    println!(
        "shear is {:.2} % of the deflection; off {off:+.1e}; stretch off {stretch:+.1e}",
        100.0 * shear / bending
    );
    assert!(shear > 5e-3 * bending && off.abs() < 4e-4);
    // Accounts for the mount's 1e9 N/m in series with the tool's EA / L.
    assert!(stretch.abs() < 1.5 * axial_n / LENGTH_M / 1e9);
}

#[test]
fn isotropic_load_at_any_angle_gives_the_planar_answer() {
    let force = 2.0 * RIGIDITY_NM2 / (LENGTH_M * LENGTH_M);
    let off = |links: usize, degrees: f64| {
        let mut m = new(Rung::Planar, beam(links));
        settle(&mut m, SLACK, Wrench { force_n: Vector3::x() * force, ..Wrench::zero() }, 600);
        let planar = tip(&m);
        let (sin, cos) = degrees.to_radians().sin_cos();
        let mut m = new(Rung::Spatial, beam(links));
        let force_n = Vector3::new(cos, sin, 0.0) * force;
        settle(&mut m, SLACK, Wrench { force_n, ..Wrench::zero() }, 600);
        let t = tip(&m);
        Vector3::new(t.x * cos + t.y * sin - planar.x, t.y * cos - t.x * sin, t.z - planar.z).norm()
    };
    for degrees in [0.0, 30.0, 45.0, 90.0] {
        let [coarse, fine] = [16, 32].map(|links| off(links, degrees));
        println!("{degrees} deg: {:.4}, {:.4} um from the planar answer", coarse * 1e6, fine * 1e6);
        if degrees == 0.0 || degrees == 90.0 {
            // In the plane of one degree of freedom: the planar result, to within rounding of the mount's 1e9
            // N/m.
            assert!(fine < 1e-9, "{fine}");
        } else {
            // Two successive rotations of a flexure differ from a single one by the square of its angle:
            // second order in the links, and below the chain's own error against the elastica.
            assert!(fine < coarse / 3.0 && fine < 6e-6, "{coarse} {fine}");
        }
    }
}

#[test]
fn one_freedom_a_flexure_is_the_planar_rung() {
    for integrator in [Integrator::LinearlyImplicitEuler, Integrator::Hybrid] {
        let mut p = ManipulatorParameters { integrator, ..ManipulatorParameters::jhu_27() };
        p.tendon.friction_coefficient = 0.15;
        p.tendon.gap_m = 0.5e-3;
        let mut planar = Manipulator::new(p.clone(), &rest()).unwrap();
        let mut chain = SpatialChain::<1>::new(p.clone(), &rest()).unwrap();
        let mut spatial = SpatialChain::<3>::new(p, &rest()).unwrap();
        let (mut worst, mut worst_spatial, mut touched) = (0.0f64, 0.0f64, 0);
        for k in 0..400 {
            let tendon = if k % 200 < 150 {
                TendonCommand::Force([6.0, 0.5])
            } else {
                TendonCommand::Displacement([1.0e-3, -1.0e-3])
            };
            let a = stepped(&mut planar, tendon);
            let b = stepped(&mut chain, tendon);
            let c = stepped(&mut spatial, tendon);
            worst = worst.max((a - b).norm());
            worst_spatial = worst_spatial.max((a - c).norm());
            touched += usize::from(planar.last_report().active_contact_count > 0);
        }
        println!(
            "{integrator:?}: tips at most {worst:.1e} m apart, spatial {worst_spatial:.1e} m, {touched} \
             steps in contact"
        );
        assert!(touched > 50);
        // Two solvers of the same contact problem, each to 1e-6 m/s per row and 1 ms step: a nanometre per
        // step, which the restoring springs keep from accumulating over more than a few dozen steps.
        assert!(worst < 1e-7 && worst_spatial < 1e-7, "{worst} {worst_spatial}");
    }
}

/// One step against a wall at x = 6 mm; the tip afterwards.
fn stepped<M: ManipulatorModel>(m: &mut M, tendon: TendonCommand) -> Vector3<f64> {
    let planes = wall_at(m, 0.006);
    m.step(1e-3, &StepInput { base: rest(), tendon, tip_wrench: Wrench::zero(), contacts: &planes }).unwrap();
    tip(m)
}

#[test]
fn natural_frequencies_are_the_cantilevers() {
    // Roots of cos x cosh x = -1; the period of each mode comes from the free decay of its own shape.
    const ROOTS: [f64; 3] = [1.875_104_068_711_961, 4.694_091_132_974_175, 7.854_757_438_237_613];
    let density = 0.101;
    for rung in [Rung::Planar, Rung::Spatial, Rung::Full] {
        for (mode, root) in ROOTS.iter().enumerate() {
            let exact = root * root / (2.0 * std::f64::consts::PI) * (RIGIDITY_NM2 / density).sqrt()
                / (LENGTH_M * LENGTH_M);
            // The planar rung supports up to 32 links.
            let mut p = beam(if rung == Rung::Planar { 32 } else { 40 });
            p.damping_ratio = 0.0;
            p.tube_radii_m = [1e-5, 0.0];
            // An undamped swing.
            let p = ManipulatorParameters { integrator: Integrator::Hybrid, ..p };
            let hz = ringing_hz(new(rung, p), mode, exact);
            println!(
                "{} mode {mode}: {hz:.2} Hz, beam {exact:.2} Hz, {:+.3} %",
                rung.name(),
                (hz / exact - 1.0) * 100.0
            );
            // The discrete modes are off by O(mode^2 / n^2): the eigenvalues of 27 links without rotary
            // inertia by 0.03, 0.11, 0.18 %.
            assert!((hz / exact - 1.0).abs() < [1e-3, 4e-3, 1.2e-2][mode], "{hz} {exact}");
        }
    }
}

/// Drives the straight tool at its tip with a small force at and around the beam's expected frequency.
/// Returns the frequency of the largest response, refined by a parabola through the neighbouring logarithms.
fn ringing_hz(m: AnyManipulator, mode: usize, expected_hz: f64) -> f64 {
    let start = m.snapshot();
    let mut m = m;
    let dt = 1.0 / (expected_hz * 60.0);
    let cycles = 40.0;
    let answer = |m: &mut AnyManipulator, hz: f64| {
        m.restore(&start);
        let steps = (cycles / hz / dt) as usize;
        for k in 0..steps {
            // A Hann-windowed burst: its spectrum is narrow, so the remaining energy is a smooth peak over
            // hz.
            let t = k as f64 * dt;
            let window = (std::f64::consts::PI * t * hz / cycles).sin().powi(2);
            let force = 1e-5 * window * (2.0 * std::f64::consts::PI * hz * t).sin();
            let tip_wrench = Wrench { force_n: Vector3::x() * force, ..Wrench::zero() };
            m.step(dt, &StepInput { base: rest(), tendon: SLACK, tip_wrench, contacts: &[] }).unwrap();
        }
        m.energy_j().ln()
    };
    let width = [0.01, 0.01, 0.015][mode];
    let at = [1.0 - width, 1.0, 1.0 + width].map(|share| answer(&mut m, share * expected_hz));
    let shift = 0.5 * (at[0] - at[2]) / (at[0] - 2.0 * at[1] + at[2]);
    expected_hz * (1.0 + shift * width)
}

#[test]
fn unpulled_manipulator_buckles_at_eulers_load() {
    let critical = std::f64::consts::PI.powi(2) * RIGIDITY_NM2 / (4.0 * LENGTH_M * LENGTH_M);
    for rung in [Rung::Planar, Rung::Spatial, Rung::Full] {
        let deflection = |share: f64| {
            let mut m = new(rung, beam(32));
            let force_n = Vector3::new(1e-5, 0.0, -share * critical);
            settle(&mut m, SLACK, Wrench { force_n, ..Wrench::zero() }, 4000);
            tip(&m).x.abs()
        };
        // Below: the amplified deflection F L^3 / (3 EI) / (1 - share); above: it has buckled.
        let (below, above) = (deflection(0.98), deflection(1.02));
        println!(
            "{}: {:.2} um at 0.98, {:.2} mm at 1.02 of Euler's load",
            rung.name(),
            below * 1e6,
            above * 1e3
        );
        assert!(below < 10e-6 && above > 3e-3, "{below} {above}");
    }
}

#[test]
fn free_swing_never_gains_energy() {
    for rung in Rung::ALL {
        for integrator in [Integrator::LinearlyImplicitEuler, Integrator::Hybrid] {
            let mut p = ManipulatorParameters { integrator, ..ManipulatorParameters::jhu_27() };
            p.damping_ratio = 0.01;
            let mut m = new(rung, p);
            settle(
                &mut m,
                TendonCommand::Force([7.0, 0.0]),
                Wrench { force_n: Vector3::y() * 0.5, ..Wrench::zero() },
                300,
            );
            let start = m.energy_j();
            let mut last = start;
            let mut gained = 0.0f64;
            for _ in 0..400 {
                settle(&mut m, SLACK, Wrench::zero(), 1);
                gained = gained.max(m.energy_j() - last);
                last = m.energy_j();
            }
            println!(
                "{} {integrator:?}: {start:.2e} J to {last:.2e} J, largest gain of a step {:.1e} of the \
                 start",
                rung.name(),
                gained / start
            );
            // The second-order method can return within a swing what its error took: below a thousandth of
            // the energy.
            assert!(gained < 2e-3 * start && last < 0.9 * start, "{gained} {start} {last}");
        }
    }
}

#[test]
fn every_rung_repeats_bit_for_bit_and_continues_from_a_snapshot() {
    for rung in Rung::ALL {
        let mut p =
            ManipulatorParameters { integrator: Integrator::Hybrid, ..ManipulatorParameters::jhu_27() };
        p.tendon.friction_coefficient = 0.15;
        let run = |m: &mut AnyManipulator, from: usize, to: usize| {
            let mut trace = Vec::new();
            for k in from..to {
                let tension = if k % 100 < 50 { [9.0, 0.0] } else { [0.0, 4.0] };
                let t = stepped(m, TendonCommand::Force(tension));
                trace.extend(t.iter().map(|x| x.to_bits()));
                trace.extend(m.contact_results().iter().map(|c| c.normal_force_n.to_bits()));
            }
            trace
        };
        let (mut a, mut b) = (new(rung, p.clone()), new(rung, p.clone()));
        let first = run(&mut a, 0, 150);
        assert_eq!(first, run(&mut b, 0, 150));
        let snapshot = a.snapshot();
        let rest_of_a = run(&mut a, 150, 300);
        let mut c = new(rung, p);
        c.restore(&snapshot);
        assert_eq!(rest_of_a, run(&mut c, 150, 300));
        assert_eq!(a.snapshot(), c.snapshot());
        println!("{}: {} values bit-equal", rung.name(), first.len() + rest_of_a.len());
    }
}

#[test]
fn resampled_tool_keeps_its_compliance() {
    let tool = ManipulatorParameters::jhu_27();
    let compliance =
        |p: &ManipulatorParameters| p.joint_stiffness_nm_per_rad.iter().map(|k| 1.0 / k).sum::<f64>();
    let exact = compliance(&tool);
    let mut last = f64::MAX;
    let reference = pulled(&tool.with_links(64).unwrap());
    for links in [1, 2, 4, 8, 16, 32, 64] {
        let p = tool.with_links(links).unwrap();
        // The same end angle under a moment, for any number of links.
        assert!((compliance(&p) / exact - 1.0).abs() < 1e-12);
        let reach = |p: &ManipulatorParameters| p.joint_positions_m.last().unwrap() + p.tip_offset_m;
        assert!((reach(&p) - reach(&tool)).abs() < 1e-15);
        let off = (pulled(&p) - reference).norm();
        println!("{links} links: tip {:.3} mm from that of 64 links at 8 N", off * 1e3);
        assert!(off < last);
        last = off;
    }
    for links in [0, 65] {
        assert!(tool.with_links(links).is_err());
    }
}

fn pulled(p: &ManipulatorParameters) -> Vector3<f64> {
    let p = ManipulatorParameters { damping_ratio: 1.0, joint_limit_rad: 3.0, ..p.clone() };
    let mut m = new(Rung::Spatial, p);
    settle(&mut m, TendonCommand::Force([8.0, 0.0]), Wrench::zero(), 500);
    tip(&m)
}
