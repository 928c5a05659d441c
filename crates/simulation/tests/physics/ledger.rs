//! Every term of the energy ledger against a closed form, and what the integrator takes against its order.

#![allow(clippy::unwrap_used, reason = "a scene that cannot be built fails the test")]

use std::f64::consts::{PI, TAU};
use std::path::Path;

use messages::{ArmMode, BurrMode, Command, ContactPart, SOURCE_FRESH, State, TendonMode};
use nalgebra::{Isometry3, Vector3};
use scene::Scene;
use simulation::bone::cutting::lever_share;
use simulation::bone::{CuttingLaw, GridGeometry, MaterialLaw};
use simulation::manipulator::{AnyManipulator, BaseMotion, ManipulatorModel, ManipulatorParameters};
use simulation::{CtView, Simulation, manipulator_parameters, rung};

use crate::common;

const GRAVITY_M_PER_S2: f64 = 9.81;
const CHAINS: [&str; 4] = ["modal", "planar", "spatial", "full"];

fn scene(dt_ms: f64, text: &str) -> Scene {
    let text = format!(
        "name = \"ledger\"\nrun = {{ mode = \"lockstep\", dt_ms = {dt_ms:?}, duration_s = 60.0 }}\n{text}\n\
         [tool]\nburr_start_mm = [0.0, 0.0, 0.0]\ndirection = [0.0, 0.0, 1.0]\n\
         bend_toward = [1.0, 0.0, 0.0]\n\
         [[controller]]\nname = \"me\"\ndrives = [\"tendon\", \"arm\", \"burr\"]\nexternal = true\n"
    );
    Scene::parse(&text, Path::new("ledger.toml")).unwrap()
}

fn pull(tension_n: f64) -> Command {
    Command {
        sequence: 1,
        tendon_mode: TendonMode::ServoJf.code(),
        tendon_force_n: [tension_n, 0.0, 0.0, 0.0],
        burr_mode: BurrMode::Speed.code(),
        ..Command::zeroed()
    }
}

/// Runs `count` ticks from the present one on.
fn ticks(simulation: &mut Simulation<'_>, count: u64, mut command: impl FnMut(u64) -> Command) -> State {
    for _ in 0..count {
        let tick = simulation.state().tick;
        simulation.step(&common::latched(tick, SOURCE_FRESH, 0, command(tick))).unwrap();
    }
    *simulation.state()
}

/// What the tool gained, and what was lost, of all works: the ledger closes by definition, unless a term is
/// missing in the sum.
fn assert_closed(state: &State) {
    let side_j = state.motor_work_j - state.cutting_energy_j;
    let in_j = state.tendon_work_j + state.arm_work_j + state.gravity_work_j + state.body_work_j + side_j;
    let lost_j =
        state.friction_energy_j + state.damping_energy_j + state.numerical_energy_j + state.crushing_energy_j;
    let off_j = in_j - state.tool_energy_j - lost_j;
    assert!(off_j.abs() < 1e-9 * (in_j.abs() + lost_j.abs()).max(1e-6), "{off_j} J of {in_j} J");
    assert_eq!(state.energy_created_j, 0.0);
}

fn near(what: &str, value: f64, expected: f64, share: f64) {
    println!("{what}: {value:.6e}, closed form {expected:.6e}, ratio {:.4}", value / expected);
    assert!((value / expected - 1.0).abs() < share, "{what}: {value:e} instead of {expected:e}");
}

/// Elastic energy of the tool under its own weight: `sum M_i^2 / (2 k_i)`, where M_i is the moment of what is
/// distal to flexure i, for small angles, and that of the mount.
fn sag_j(p: &ManipulatorParameters) -> f64 {
    let burr_m = p.burr_centre_m();
    let moment_nm = |z_m: f64| {
        let arm_m = burr_m - z_m;
        GRAVITY_M_PER_S2 * (0.5 * p.linear_density_kg_per_m * arm_m * arm_m + p.burr_mass_kg * arm_m)
    };
    let flexures = p.joint_positions_m.iter().zip(&p.joint_stiffness_nm_per_rad);
    let tube_kg = p.linear_density_kg_per_m * (burr_m - p.joint_positions_m[0]);
    let weight_n = GRAVITY_M_PER_S2 * (p.shaft_mass_kg + tube_kg + p.burr_mass_kg);
    let mount_j = 0.5 * weight_n * weight_n / p.mount_stiffness_n_per_m[0];
    flexures.map(|(z_m, k)| 0.5 * moment_nm(*z_m).powi(2) / k).sum::<f64>() + mount_j
}

/// A weight that acts at once on a linear spring does twice the work that the spring stores at rest
/// (Clapeyron); damping and integrator take the other half.
#[test]
fn gravity_does_twice_the_work_that_a_sagging_tool_stores() {
    for model in &CHAINS {
        let text = format!(
            "gravity_m_per_s2 = [{GRAVITY_M_PER_S2:?}, 0.0, 0.0]\narm = {{ model = \"fixed\" }}\n\
             manipulator = {{ model = \"{model}\", damping_ratio = 0.5, stiffness_scale = 3.0 }}"
        );
        let scene = scene(1.0, &text);
        let stored_j = sag_j(&manipulator_parameters(&scene).unwrap());
        let state = ticks(&mut Simulation::new(&scene, None).unwrap(), 800, |_| pull(0.0));
        assert_closed(&state);
        near(&format!("{model} stored"), state.tool_energy_j, stored_j, 0.002);
        near(&format!("{model} work"), state.gravity_work_j, 2.0 * stored_j, 0.002);
        let lost_j = state.damping_energy_j + state.numerical_energy_j;
        near(&format!("{model} lost"), lost_j, stored_j, 0.002);
    }
}

/// A pendulum of one flexure swings to rest under gravity. Its oscillation loses what viscous damping at the
/// ratio zeta takes, and, by linearly implicit Euler, as much as at a ratio of `omega dt / 2` more: of all
/// that is lost, `(omega dt / 2) / (zeta + omega dt / 2)` goes to the integrator. By `hybrid` it falls with
/// the square of the step.
#[test]
fn the_integrator_takes_what_its_order_says() {
    let zeta = 0.05;
    for model in ["planar", "spatial", "full"] {
        for integrator in ["linearly_implicit_euler", "hybrid"] {
            let mut shares = Vec::new();
            for dt_ms in [0.4, 0.2, 0.1] {
                let text = format!(
                    "gravity_m_per_s2 = [{GRAVITY_M_PER_S2:?}, 0.0, 0.0]\narm = {{ model = \"fixed\" }}\n\
                     manipulator = {{ model = \"{model}\", links = 1, damping_ratio = {zeta}, integrator = \
                     \"{integrator}\", mount_stiffness_n_per_m = 1e7 }}"
                );
                let scene = scene(dt_ms, &text);
                let p = manipulator_parameters(&scene).unwrap();
                let base = BaseMotion::at_rest(Isometry3::identity());
                let tool = AnyManipulator::new(rung(scene.manipulator.model.unwrap()), p, &base).unwrap();
                let state =
                    ticks(&mut Simulation::new(&scene, None).unwrap(), (0.6 / (dt_ms * 1e-3)) as u64, |_| {
                        pull(0.0)
                    });
                assert_closed(&state);
                let lost_j = state.damping_energy_j + state.numerical_energy_j;
                let share = state.numerical_energy_j / lost_j;
                let extra = 0.5 * TAU * tool.first_natural_frequency_hz() * dt_ms * 1e-3;
                if integrator == "linearly_implicit_euler" {
                    let what = format!("{model} Euler {dt_ms} ms, share of the integrator");
                    near(&what, share, extra / (zeta + extra), 0.05);
                } else {
                    println!("{model} hybrid {dt_ms} ms, share of the integrator: {share:.3e}");
                }
                shares.push(share);
            }
            if integrator == "hybrid" {
                assert!(shares[0].abs() < 0.02, "{shares:?}");
                let falls = |pair: &[f64]| pair[1].abs() < 0.3 * pair[0].abs();
                assert!(shares.windows(2).all(falls), "{shares:?}");
            }
        }
    }
}

/// Angles of the flexures under a tension, `k q = T share d cos(q / 2)`, and how much tendon each takes up.
/// `mu` is the friction of the channel, whose wrap at a flexure is that of the flexures before it and half
/// its own.
fn bent(p: &ManipulatorParameters, tension_n: f64, mu: f64) -> Vec<[f64; 3]> {
    let mut wrap = 0.0;
    let each = p.joint_stiffness_nm_per_rad.iter().map(|k| {
        let (mut q, mut share) = (0.0f64, 1.0);
        for _ in 0..200 {
            share = (-mu * (wrap + 0.5 * q)).exp();
            q = tension_n * share * p.tendon.offset_m * (0.5 * q).cos() / k;
        }
        wrap += q;
        [q, 2.0 * p.tendon.offset_m * (0.5 * q).sin(), share]
    });
    each.collect()
}

/// A constant tension from the first tick on does the work T (l + T / k_t); the flexures' springs and the
/// tendon's keep their energy, the rest is damped. Once the tension is gone, all that the flexures kept is
/// lost, and without friction none of it to friction.
#[test]
fn a_pulled_spring_keeps_its_energy_and_loses_it_when_released() {
    let tension_n = 4.0;
    for model in &CHAINS {
        let text = format!(
            "arm = {{ model = \"fixed\" }}\n\
             manipulator = {{ model = \"{model}\", damping_ratio = 0.7, mount_stiffness_n_per_m = 1e7 }}"
        );
        let scene = scene(1.0, &text);
        let p = manipulator_parameters(&scene).unwrap();
        let flexures = bent(&p, tension_n, 0.0);
        let stretch_m = tension_n / p.tendon.stiffness_n_per_m;
        let take_up_m: f64 = flexures.iter().map(|[_, l_m, _]| l_m).sum();
        let springs = flexures.iter().zip(&p.joint_stiffness_nm_per_rad);
        let bent_j: f64 = springs.map(|([q, ..], k)| 0.5 * k * q * q).sum();
        let mut simulation = Simulation::new(&scene, None).unwrap();
        let pulled = ticks(&mut simulation, 800, |_| pull(tension_n));
        assert_closed(&pulled);
        // `full` also shortens under the tendon.
        let share = if *model == "full" { 0.03 } else { 0.005 };
        near(&format!("{model} kept"), pulled.tool_energy_j, bent_j + 0.5 * tension_n * stretch_m, share);
        near(&format!("{model} work"), pulled.tendon_work_j, tension_n * (take_up_m + stretch_m), share);
        let released = ticks(&mut simulation, 800, |_| pull(0.0));
        assert_closed(&released);
        assert!(released.tool_energy_j < 1e-4 * bent_j, "{} J", released.tool_energy_j);
        let lost_j = |state: &State| state.damping_energy_j + state.numerical_energy_j;
        let released_j = lost_j(&released) - lost_j(&pulled);
        near(&format!("{model} released"), released_j, pulled.tool_energy_j, 0.005);
        assert_eq!(released.friction_energy_j, 0.0);
    }
}

/// Loss of a tendon pulled slowly to `most_n` along one arc: `k bend = T d m` with the mean share m = (1 -
/// exp(-mu bend)) / (mu bend) of the tension, so the loss is the integral of `T (1 - m) d dbend`.
fn arc_friction_j(p: &ManipulatorParameters, most_n: f64, mu: f64, steps: u32) -> f64 {
    let k = 1.0 / p.joint_stiffness_nm_per_rad.iter().map(|k| 1.0 / k).sum::<f64>();
    let (mut friction_j, mut from_rad) = (0.0, 0.0f64);
    for step in 1..=steps {
        let tension_n = most_n * (f64::from(step) - 0.5) / f64::from(steps);
        let at = |tension_n: f64| {
            let (mut bend_rad, mut share) = (1e-9f64, 1.0);
            for _ in 0..200 {
                share = -(-mu * bend_rad).exp_m1() / (mu * bend_rad);
                bend_rad = tension_n * p.tendon.offset_m * share / k;
            }
            [bend_rad, share]
        };
        let [to_rad, _] = at(most_n * f64::from(step) / f64::from(steps));
        friction_j += tension_n * (1.0 - at(tension_n)[1]) * p.tendon.offset_m * (to_rad - from_rad);
        from_rad = to_rad;
    }
    friction_j
}

/// A slowly pulled tendon loses the tension that friction takes at each flexure, over the length that the
/// flexure takes up: the integral of `T (1 - exp(-mu wrap)) dl`. Until it slides over the presliding length,
/// friction is less; `full` also shortens.
#[test]
fn the_friction_of_a_tendon_takes_the_tension_that_it_holds_back() {
    let (most_n, mu, steps) = (6.0, 0.3, 400);
    for model in CHAINS.iter().chain(&["constant_curvature"]) {
        let text = format!(
            "arm = {{ model = \"fixed\" }}\n\
             manipulator = {{ model = \"{model}\", damping_ratio = 0.7, tendon_friction = {mu} }}"
        );
        let scene = scene(1.0, &text);
        let p = manipulator_parameters(&scene).unwrap();
        let mut friction_j = 0.0;
        let mut before = bent(&p, 0.0, mu);
        for step in 1..=steps {
            let tension_n = most_n * f64::from(step) / f64::from(steps);
            let after = bent(&p, tension_n, mu);
            let mean_n = tension_n - 0.5 * most_n / f64::from(steps);
            for ([_, from_m, share], [_, to_m, to_share]) in before.iter().zip(&after) {
                friction_j += mean_n * (1.0 - 0.5 * (share + to_share)) * (to_m - from_m);
            }
            before = after;
        }
        if *model == "constant_curvature" {
            friction_j = arc_friction_j(&p, most_n, mu, steps);
        }
        let count = 1500;
        let ramp = |tick: u64| pull(most_n * (tick + 1).min(count) as f64 / count as f64);
        let state = ticks(&mut Simulation::new(&scene, None).unwrap(), count + 300, ramp);
        assert_closed(&state);
        near(&format!("{model} friction"), state.friction_energy_j, friction_j, 0.03);
        let rest_j = state.numerical_energy_j.abs();
        assert!(rest_j < 0.1 * friction_j, "{model}: {rest_j} J left of {friction_j} J");
    }
}

/// A wall of bone that does not yield, its face across x, in front of the bent burr's side.
fn wall(voxel_m: f64) -> (GridGeometry, Vec<i16>) {
    let dims = [16, 64, 96];
    let origin = Vector3::new(3.25e-3 + 1.0e-3, -16.0e-3, -24.0e-3).add_scalar(0.5 * voxel_m);
    let geometry = GridGeometry::axis_aligned(dims, [voxel_m; 3], origin);
    (geometry, vec![1500; geometry.voxel_count()])
}

/// A standing burr pressed with N on a wall and drawn along it by the arm: the arm's work over the way s is
/// mu N s, which friction takes.
#[test]
fn a_drawn_tool_loses_the_work_of_its_arm_to_friction() {
    let (mu, speed_m_per_s) = (0.3, 5.0e-3);
    let (geometry, hu) = wall(0.5e-3);
    for model in &CHAINS {
        let text = format!(
            "manipulator = {{ model = \"{model}\", damping_ratio = 1.0 }}\n\
             volume = {{ phantom = \"block\" }}\ncontact = {{ friction = {mu}, strength_mpa = 1e5 }}"
        );
        let scene = scene(1.0, &text);
        let mut simulation = Simulation::new(&scene, Some(CtView { geometry, hu: &hu })).unwrap();
        ticks(&mut simulation, 500, |_| pull(3.0));
        let drawn = |_| Command {
            arm_mode: ArmMode::Insert.code(),
            arm_axis: [0.0, 0.0, 1.0],
            arm_depth_m: 8.0e-3,
            arm_speed_m_per_s: speed_m_per_s,
            ..pull(3.0)
        };
        let from = ticks(&mut simulation, 700, drawn);
        let mut expected_j = 0.0;
        for _ in 0..600 {
            let state = ticks(&mut simulation, 1, drawn);
            expected_j += mu * (state.burr_force_n + state.wall_force_n) * speed_m_per_s * 1e-3;
        }
        let to = *simulation.state();
        assert_closed(&to);
        assert!(to.burr_force_n > 0.1, "{} N", to.burr_force_n);
        near(&format!("{model} friction"), to.friction_energy_j - from.friction_energy_j, expected_j, 0.02);
        near(&format!("{model} arm"), to.arm_work_j - from.arm_work_j, expected_j, 0.02);
    }
}

/// A free body in front of the bent tool is pushed off without gravity: it gains as kinetic energy what it
/// takes from the tool.
#[test]
fn a_pushed_body_gains_what_it_takes_from_the_tool() {
    let radius_mm = 6.0f64;
    for model in ["planar", "spatial"] {
        // Touching the burr's side at half the burr's radius.
        let text = format!(
            "arm = {{ model = \"fixed\" }}\nmanipulator = {{ model = \"{model}\" }}\n\
             contact = {{ friction = 0.0 }}\n\
             [[body]]\nname = \"ball\"\nball = {{ radius_mm = {radius_mm:?} }}\nmotion = \"free\"\n\
             position_mm = [{:?}, 0.0, 0.0]\nfriction = 0.0",
            radius_mm + 3.251
        );
        let scene = scene(0.1, &text);
        let mut simulation = Simulation::new(&scene, None).unwrap();
        let place = |state: &State| Vector3::from(state.t_world_body[0].position_m);
        let before = ticks(&mut simulation, 400, |_| pull(3.0));
        let after = ticks(&mut simulation, 1, |_| pull(3.0));
        assert_closed(&after);
        let speed_m_per_s = (place(&after) - place(&before)).norm() / 0.1e-3;
        let mass_kg = 1900.0 * 4.0 / 3.0 * PI * (radius_mm * 1e-3).powi(3);
        assert!(speed_m_per_s > 0.05, "{speed_m_per_s} m/s");
        let kinetic_j = 0.5 * mass_kg * speed_m_per_s * speed_m_per_s;
        near(&format!("{model} body"), -after.body_work_j, kinetic_j, 0.05);
    }
}

/// A straight feed at constant speed: the motor's work is torque times angle, with the torque from the
/// contacts' forces and levers, and the bone's specific energy times the volume of the hole.
#[test]
fn cutting_takes_torque_times_angle_and_energy_times_volume() {
    let (speed_rad_per_s, feed_m_per_s, hu_value) = (235.6, 1.0e-3, 600);
    let voxel_m = 0.25e-3;
    let dims = [40, 40, 56];
    let origin = Vector3::new(-5.0e-3, -5.0e-3, 0.0).add_scalar(0.5 * voxel_m)
        + Vector3::new(0.28, 0.16, 0.0) * voxel_m;
    let geometry = GridGeometry::axis_aligned(dims, [voxel_m; 3], origin);
    let hu = vec![hu_value; geometry.voxel_count()];
    let text = "manipulator = { stiffness_scale = 1000.0 }\nvolume = { phantom = \"block\" }";
    let mut scene = scene(1.0, text);
    scene.tool.burr_start_mm = [0.0, 0.0, -4.0];
    let mut simulation = Simulation::new(&scene, Some(CtView { geometry, hu: &hu })).unwrap();
    let feed = |_| Command {
        arm_mode: ArmMode::Insert.code(),
        arm_axis: [0.0, 0.0, 1.0],
        arm_depth_m: 0.012,
        arm_speed_m_per_s: feed_m_per_s,
        burr_speed_rad_per_s: speed_rad_per_s,
        ..pull(0.0)
    };
    let from = ticks(&mut simulation, 5000, feed);
    let law = CuttingLaw::default();
    let mut turned_j = 0.0;
    let count = 2000;
    for _ in 0..count {
        let state = ticks(&mut simulation, 1, feed);
        let contacts = &state.contacts[..state.contact_count as usize];
        let burr = contacts.iter().filter(|contact| contact.part == ContactPart::Burr.code());
        let lever_nm = |normal_z: f64| 3.25e-3 * lever_share(normal_z);
        let torque_nm: f64 =
            burr.map(|c| law.cutting_friction * c.normal_force_n * lever_nm(c.normal[2])).sum();
        turned_j += torque_nm * speed_rad_per_s * 1e-3;
    }
    let to = *simulation.state();
    let way_m = feed_m_per_s * count as f64 * 1e-3;
    let volume_m3 = PI * (3.25e-3 + law.reach_m).powi(2) * way_m;
    let cut_j = to.cutting_energy_j - from.cutting_energy_j;
    near("torque times angle", cut_j, turned_j, 0.01);
    near(
        "energy times volume",
        cut_j,
        MaterialLaw::default().specific_energy_j_m3(hu_value) * volume_m3,
        0.02,
    );
    near("motor", to.motor_work_j - from.motor_work_j, cut_j, 1e-9);
}
