//! The moment-mode rung against all 27 flexures of the planar rung.

#![allow(clippy::unwrap_used, reason = "a test that cannot build its tool has failed")]

use crate::common;

use crate::common::rest;
use crate::common::tunnel::{RAMP_S, latched};
use nalgebra::{Unit, Vector3};
use simulation::Simulation;
use simulation::contact_plane::ContactPlane;
use simulation::manipulator::{
    AnyManipulator, Integrator, ManipulatorModel, ManipulatorParameters, MomentModes, Rung, StepInput,
    TendonCommand, TendonReach, TendonRoute, Wrench,
};

/// Position of the first flexure, m.
const FIRST_M: f64 = 36.02972e-3;

/// The 27 flexures, critically damped, with stops out of reach and without friction: statics.
fn tool() -> ManipulatorParameters {
    let mut p = ManipulatorParameters::jhu_27();
    p.damping_ratio = 1.0;
    p.joint_limit_rad = 0.5;
    p.contact.friction_coefficient = 0.0;
    p
}

fn modal(p: &ManipulatorParameters, modes: usize) -> AnyManipulator {
    let p = ManipulatorParameters { moment_modes: modes, ..p.clone() };
    AnyManipulator::new(Rung::Modal, p, &rest()).unwrap()
}

fn planar(p: &ManipulatorParameters) -> AnyManipulator {
    AnyManipulator::new(Rung::Planar, p.clone(), &rest()).unwrap()
}

fn tip(m: &AnyManipulator) -> Vector3<f64> {
    m.t_world_tip().translation.vector
}

/// A tunnel of the review: straight, then an arc toward +x; the tool's axis can be `clearance_m` off its
/// centre line.
#[derive(Clone, Copy)]
struct Tunnel {
    radius_m: f64,
    clearance_m: f64,
    /// Start of the arc, from the first flexure.
    straight_m: f64,
}

impl Tunnel {
    /// Both walls for every sphere of the flexible part.
    fn planes(&self, m: &AnyManipulator, out: &mut Vec<ContactPlane>) {
        for (sphere_index, sphere) in m.proxy_spheres().iter().enumerate() {
            let (x, z) = (sphere.centre_m.x, sphere.centre_m.z - FIRST_M - self.straight_m);
            if z < -self.straight_m {
                continue;
            }
            let (off, inward) = if z <= 0.0 && x < self.radius_m {
                (x, Vector3::x())
            } else {
                let from_middle = Vector3::new(x - self.radius_m, 0.0, z);
                (self.radius_m - from_middle.norm(), -from_middle.normalize())
            };
            for side in [1.0, -1.0] {
                let normal = Unit::new_unchecked(inward * side);
                let gap_m = self.clearance_m + side * off;
                let point_m = sphere.centre_m - normal.into_inner() * (gap_m + sphere.radius_m);
                out.push(ContactPlane::hard(sphere_index, point_m, normal, gap_m));
            }
        }
    }
}

/// A problem of the review (`physics-review.md`, section 5): tension of tendon 0, transverse force on the
/// burr, tunnel.
struct Problem {
    name: &'static str,
    tension_n: f64,
    across_n: f64,
    tunnel: Option<Tunnel>,
}

const NARROW: Tunnel = Tunnel { radius_m: 20e-3, clearance_m: 0.35e-3, straight_m: 12e-3 };
const WIDE: Tunnel = Tunnel { radius_m: 40e-3, straight_m: 5e-3, ..NARROW };
const PROBLEMS: [Problem; 6] = [
    Problem { name: "tendon 10 N", tension_n: 10.0, across_n: 0.0, tunnel: None },
    Problem { name: "tendon 5 N, 0.5 N across", tension_n: 5.0, across_n: -0.5, tunnel: None },
    Problem { name: "1 N across", tension_n: 0.0, across_n: 1.0, tunnel: None },
    Problem { name: "tunnel R 20 mm, 12 N", tension_n: 12.0, across_n: 0.0, tunnel: Some(NARROW) },
    Problem { name: "tunnel R 20 mm, 4 N", tension_n: 4.0, across_n: 0.0, tunnel: Some(NARROW) },
    Problem { name: "tunnel R 40 mm, 12 N", tension_n: 12.0, across_n: 0.0, tunnel: Some(WIDE) },
];

/// Steps until the tool is at rest; returns the number of loaded contacts.
fn settle(m: &mut AnyManipulator, problem: &Problem) -> usize {
    let mut contacts = Vec::with_capacity(80);
    let mut pressing = 0;
    for k in 0..3000 {
        contacts.clear();
        if let Some(tunnel) = &problem.tunnel {
            tunnel.planes(m, &mut contacts);
        }
        // Loaded over the first second, so that no swing affects where the tool comes to rest.
        let share = (f64::from(k) * 1e-3).min(1.0);
        let input = StepInput {
            base: rest(),
            tendon: TendonCommand::Force([share * problem.tension_n, 0.0]),
            tip_wrench: Wrench { force_n: Vector3::x() * (share * problem.across_n), ..Wrench::zero() },
            contacts: &contacts,
        };
        pressing = m.step(1e-3, &input).unwrap().active_contact_count;
    }
    let fastest = m.joint_velocities_rad_per_s().iter().fold(0.0f64, |most, v| most.max(v.abs()));
    assert!(fastest < 1e-4, "{}: not at rest, {fastest} rad/s", problem.name);
    pressing
}

/// Largest distance between the two tools' links, m.
fn farthest_m(a: &AnyManipulator, b: &AnyManipulator) -> f64 {
    let apart = |link: usize| {
        (a.t_world_link(link).translation.vector - b.t_world_link(link).translation.vector).norm()
    };
    (0..=27).map(apart).fold(0.0, f64::max)
}

#[test]
fn five_modes_rest_within_25_um_of_27_flexures_on_every_problem_of_the_review() {
    for problem in &PROBLEMS {
        let mut reference = planar(&tool());
        let pressing = settle(&mut reference, problem);
        let bend = reference.bend_rad().to_degrees();
        print!("{}: bend {bend:.1} degrees, {pressing} contacts; tip, farthest link, um:", problem.name);
        for modes in [2, 3, 4, 5, 6, 8] {
            let mut m = modal(&tool(), modes);
            settle(&mut m, problem);
            let error_um = 1e6 * (tip(&m) - tip(&reference)).norm();
            print!("  {modes}: {error_um:.1}, {:.1}", 1e6 * farthest_m(&m, &reference));
            assert!(modes < 5 || error_um < 25.0, "{} with {modes} modes: {error_um} um", problem.name);
        }
        println!();
    }
}

/// Friction depends on history, so both tools follow the same one: up to a tension and part of the way back.
#[test]
fn with_friction_of_tendon_and_walls_five_modes_rest_near_27_flexures() {
    let mut p = tool();
    p.tendon.friction_coefficient = 0.2;
    p.contact.friction_coefficient = 0.3;
    for tunnel in [None, Some(NARROW), Some(WIDE)] {
        let mut tools = [planar(&p), modal(&p, 5)];
        let mut apart_um = 0.0f64;
        let mut contacts = Vec::with_capacity(80);
        for k in 0..4000 {
            let time_s = f64::from(k) * 1e-3;
            let tension_n = if time_s < 1.5 { 6.0 * time_s } else { (9.0 - 4.0 * (time_s - 1.5)).max(3.0) };
            for m in &mut tools {
                contacts.clear();
                tunnel.iter().for_each(|tunnel| tunnel.planes(m, &mut contacts));
                let tendon = TendonCommand::Force([tension_n, 0.0]);
                let input =
                    StepInput { base: rest(), tendon, tip_wrench: Wrench::zero(), contacts: &contacts };
                m.step(1e-3, &input).unwrap();
            }
            // The straight tools first have to leave the walls of a curved tunnel, at a bounded speed.
            if time_s > 1.0 {
                apart_um = apart_um.max(1e6 * (tip(&tools[0]) - tip(&tools[1])).norm());
            }
        }
        let end_um = 1e6 * (tip(&tools[0]) - tip(&tools[1])).norm();
        let bend = tools[0].bend_rad().to_degrees();
        let wrench = tools.each_ref().map(|m| m.last_report().flange_wrench);
        let (own_n, off_n) = (wrench[0].force_n.norm(), (wrench[0].force_n - wrench[1].force_n).norm());
        println!(
            "bend {bend:.1} degrees: {end_um:.1} um apart at the end, {apart_um:.1} at most, flange \
             {own_n:.3} N, off {off_n:.3} N"
        );
        assert!(end_um < 25.0, "{end_um} um");
        // In between, a wall can be met a step earlier or later: twice the bound at rest.
        assert!(apart_um < 50.0, "{apart_um} um");
        // With walls of 1 N/um, a micrometre of shape matters: forces in a tight tunnel are less accurate
        // than positions.
        assert!(off_n < 0.25 * own_n + 1e-3, "{off_n} N of {own_n} N");
    }
}

/// The first vibration mode carries almost all of a swing; five modes include it and the next ones.
#[test]
fn a_free_swing_is_that_of_27_flexures() {
    for integrator in [Integrator::LinearlyImplicitEuler, Integrator::Hybrid] {
        let p = ManipulatorParameters { integrator, joint_limit_rad: 0.5, ..ManipulatorParameters::jhu_27() };
        let mut tools = [planar(&p), modal(&p, 5)];
        let (mut apart_m, mut swing_m) = (0.0f64, 0.0f64);
        for k in 0..500 {
            let tendon = TendonCommand::Force([if k < 200 { 6.0 } else { 0.0 }, 0.0]);
            for m in &mut tools {
                let input = StepInput { base: rest(), tendon, tip_wrench: Wrench::zero(), contacts: &[] };
                m.step(1e-3, &input).unwrap();
            }
            apart_m = apart_m.max((tip(&tools[0]) - tip(&tools[1])).norm());
            swing_m = swing_m.max(tip(&tools[0]).x.abs());
            let energy = tools.each_ref().map(|m| m.energy_j());
            assert!((energy[0] - energy[1]).abs() < 2e-3 * energy[0] + 1e-6, "{k}: {energy:?}");
        }
        println!("{integrator:?}: {:.1} um apart, swing of {:.1} mm", apart_m * 1e6, swing_m * 1e3);
        assert!(apart_m < 2e-3 * swing_m, "{apart_m} of {swing_m}");
    }
}

/// Flexures on their stops are held, and the tool reports that the model is not valid there.
#[test]
fn flexures_on_their_stops_are_said_and_held() {
    let p = ManipulatorParameters { damping_ratio: 1.0, ..ManipulatorParameters::jhu_27() };
    let least_n = p.first_stop_n().unwrap();
    for (tension_n, stands) in [(0.99 * least_n, false), (1.03 * least_n, true), (40.0, true)] {
        let mut m = MomentModes::<8>::new(p.clone(), &rest()).unwrap();
        let mut reference = planar(&p);
        for k in 0..2000 {
            let tendon = TendonCommand::Force([tension_n * (f64::from(k) * 1e-3).min(1.0), 0.0]);
            let input = StepInput { base: rest(), tendon, tip_wrench: Wrench::zero(), contacts: &[] };
            m.step(1e-3, &input).unwrap();
            reference.step(1e-3, &input).unwrap();
        }
        let most = m.joint_positions_rad().iter().fold(0.0f64, |most, q| most.max(q.abs()));
        let off_um = 1e6 * (m.t_world_tip().translation.vector - tip(&reference)).norm();
        let stopped = m.last_report().stopped_joint_count;
        println!(
            "{tension_n:.2} N: {stopped} flexures on stops, largest {:.2} degrees, tip {off_um:.1} um off",
            most.to_degrees()
        );
        assert_eq!(m.is_valid(), !stands);
        assert_eq!(stopped > 0, stands);
        assert!(most < 1.06 * p.joint_limit_rad, "{most}");
        assert!(stands || off_um < 1.0, "{off_um} um where it is valid");
    }
}

/// During a run, the modal rung reports which flexure is past its stop, and by how much, from the tension at
/// which the statics of the individual flexures bring the softest to its stop. The planar rung holds the stop
/// and reports nothing.
#[test]
fn a_run_says_from_which_tension_on_the_modes_are_not_valid() {
    let p = ManipulatorParameters::jhu_27();
    let least_n = p.first_stop_n().unwrap();
    for (model, tension_n, says) in [("modal", 12.0, true), ("modal", 10.0, false), ("planar", 12.0, false)] {
        let text = "name = \"pull\"\nrun = { mode = \"lockstep\", duration_s = 2.0 }\n";
        let scene = common::scene(&format!("{text}manipulator = {{ model = \"{model}\" }}\n"));
        let mut simulation = Simulation::new(&scene, None).unwrap();
        let mut first_n = None;
        for tick in 0..(RAMP_S * 1e3) as u64 {
            simulation.step(&latched(tick, 1e-3, tension_n)).unwrap();
            let (state, past) = (simulation.state(), simulation.invalid_flexure());
            let bends = state.joint_position_rad[..27].iter().map(|q| q.abs()).enumerate();
            let (farthest, most_rad) = bends.max_by(|a, b| a.1.total_cmp(&b.1)).unwrap();
            let excess_rad = (most_rad - p.joint_limit_rad).max(0.0);
            assert_eq!(state.stop_excess_rad, excess_rad, "{model}, tick {tick}");
            assert_eq!(past.is_some(), model == "modal" && excess_rad > 0.0, "{model}, tick {tick}");
            if let Some(past) = past {
                assert_eq!((past.model, past.flexure, past.excess_rad), ("modal", farthest, excess_rad));
                first_n.get_or_insert(state.tendon_tension_n[0]);
            }
        }
        println!("{model}, up to {tension_n} N: not valid from {first_n:?} N, in statics {least_n:.2} N");
        assert_eq!(first_n.is_some(), says, "{model}, {tension_n} N");
        // The ramp of 12 N/s leads the shape by 0.07 N: 12 N/s over the first mode's 164 rad/s.
        assert!(first_n.is_none_or(|first_n| (first_n - least_n).abs() < 0.15), "{first_n:?} N");
    }
}

/// A discontinuous moment is not a sum of smooth modes.
#[test]
fn tools_whose_moments_jump_or_that_have_too_many_modes_are_refused() {
    let refused = |p: ManipulatorParameters| {
        AnyManipulator::new(Rung::Modal, p, &rest()).map(|_| ()).unwrap_err().to_string()
    };
    let route = TendonRoute { reach: TendonReach { from: 0, to: Some(13) }, ..[2.5e-3, 0.0].into() };
    let partly = ManipulatorParameters { tendon_routes: Some(vec![route]), ..tool() };
    assert!(refused(partly).contains("the modal model cannot represent the moment jump at a tendon's end"));
    for modes in [1, 9] {
        let said = refused(ManipulatorParameters { moment_modes: modes, ..tool() });
        assert!(said.contains("moment_modes") && said.contains("2 to 8"), "{said}");
    }
    assert!(refused(tool().with_links(40).unwrap()).contains("1 to 32 for the modal model"));
}

/// The vector instructions of another machine do not change a bit.
#[test]
fn plain_instructions_give_the_same_bits() {
    let mut p = ManipulatorParameters { integrator: Integrator::Hybrid, ..tool() };
    p.tendon.friction_coefficient = 0.1;
    p.contact.friction_coefficient = 0.3;
    for modes in [5, 7] {
        let run = |plain: bool| {
            let mut m = modal(&p, modes);
            if plain {
                m.use_plain_instructions();
            }
            let (mut contacts, mut trace) = (Vec::with_capacity(80), Vec::new());
            for k in 0..400 {
                contacts.clear();
                NARROW.planes(&m, &mut contacts);
                let tendon = TendonCommand::Displacement([f64::from(k) * 5e-6, 0.0]);
                let input =
                    StepInput { base: rest(), tendon, tip_wrench: Wrench::zero(), contacts: &contacts };
                m.step(1e-3, &input).unwrap();
                trace.extend(tip(&m).iter().map(|x| x.to_bits()));
                trace.extend(m.contact_results().iter().map(|c| c.normal_force_n.to_bits()));
            }
            trace
        };
        assert_eq!(run(false), run(true), "{modes} modes");
    }
}

/// A wall not near the tool before: the first step of a sudden pull already ends at it, as in the planar
/// rung.
#[test]
fn a_sudden_pull_ends_at_a_wall_within_the_first_step() {
    let p = tool();
    let mut tools = [planar(&p), modal(&p, 5)];
    for k in 0..50 {
        let mut overlap_m = [0.0; 2];
        for (m, overlap_m) in tools.iter_mut().zip(&mut overlap_m) {
            let wall = |m: &AnyManipulator| {
                let (sphere_index, burr) = m.proxy_spheres().iter().enumerate().next_back().unwrap();
                let gap_m = 0.05e-3 - burr.centre_m.x;
                let point_m = burr.centre_m + Vector3::x() * (burr.radius_m + gap_m);
                ContactPlane::hard(sphere_index, point_m, -Vector3::x_axis(), gap_m)
            };
            let contacts = [wall(m)];
            let tendon = TendonCommand::Force([20.0, 0.0]);
            let input = StepInput { base: rest(), tendon, tip_wrench: Wrench::zero(), contacts: &contacts };
            m.step(1e-3, &input).unwrap();
            *overlap_m = -wall(m).gap_m;
        }
        let force_n = tools.each_ref().map(|m| m.last_report().burr_normal_force_n.norm());
        assert!(force_n[0] > 0.1 && (force_n[1] / force_n[0] - 1.0).abs() < 0.05, "{k}: {force_n:?} N");
        // The overlap of a contact that carries this force, plus the error from the shape's rotation within a
        // step.
        for (overlap_m, force_n) in overlap_m.iter().zip(&force_n) {
            assert!(*overlap_m < force_n / p.contact.stiffness_n_per_m + 20e-6, "{k}: {overlap_m} m");
        }
    }
}
