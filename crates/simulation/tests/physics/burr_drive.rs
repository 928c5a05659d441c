//! Reaction of cutting on the tool and on the burr's motor, against closed forms.

#![allow(clippy::unwrap_used, reason = "a scene that cannot be built fails the test")]

use std::path::Path;

use crate::common;
use messages::{BurrMode, Command, ContactPart, Latched, SOURCE_FRESH, State, TendonMode};
use nalgebra::{Isometry3, Vector3};
use scene::Scene;
use simulation::bone::GridGeometry;
use simulation::bone::cutting::lever_share;
use simulation::manipulator::{
    AnyManipulator, BaseMotion, ManipulatorModel, Rung, StepInput, TendonCommand, Wrench,
};
use simulation::{CtView, Simulation, manipulator_parameters};

const COEFFICIENT: f64 = 0.3;
const RADIUS_M: f64 = 3.25e-3;
const SPEED_RAD_S: f64 = 500.0;
const VOXEL_M: f64 = 0.5e-3;

/// The burr's side against a wall of bone that is too hard to cut in a second.
fn scene(keys: &str, tool: &str) -> Scene {
    Scene::parse(&scene_text(keys, tool), Path::new("side.toml")).unwrap()
}

fn scene_text(keys: &str, tool: &str) -> String {
    format!(
        "name = \"side\"\n[run]\nmode = \"lockstep\"\nduration_s = 60.0\n[volume]\nphantom = \"block\"\n\
         [manipulator]\nmodel = \"spatial\"\nlateral_stiffness_ratio = 1.0\ntorsion_stiffness_ratio = 1.0\n\
         damping_ratio = 1.0\n{tool}\
         [drilling]\nspecific_energy_j_per_mm3 = 10.0\ndensity_exponent = 0.0\n\
         cutting_coefficient = {COEFFICIENT:?}\n{keys}\
         [tool]\nburr_start_mm = [0.0, 0.0, 0.0]\ndirection = [0.0, 0.0, 1.0]\n\
         bend_toward = [1.0, 0.0, 0.0]\n\
         [[controller]]\nname = \"feed\"\ndrives = [\"tendon\", \"arm\", \"burr\"]\nexternal = true\n"
    )
}

fn latched(tick: u64, tension_n: f64, speed_rad_per_s: f64) -> Latched {
    let command = Command {
        sequence: 1,
        tendon_mode: TendonMode::ServoJf.code(),
        tendon_force_n: [tension_n, 0.0, 0.0, 0.0],
        burr_mode: BurrMode::Speed.code(),
        burr_speed_rad_per_s: speed_rad_per_s,
        ..Command::zeroed()
    };
    common::latched(tick, SOURCE_FRESH, 0, command)
}

/// A wall with its face normal to x, 1.5 mm from the straight tool's burr on the +x side.
fn wall() -> (GridGeometry, Vec<i16>) {
    let dims = [16, 64, 48];
    let origin = Vector3::new(RADIUS_M + 1.5e-3, -16.0e-3, -16.0e-3).add_scalar(0.5 * VOXEL_M);
    let geometry = GridGeometry::axis_aligned(dims, [VOXEL_M; 3], origin);
    (geometry, vec![1500; geometry.voxel_count()])
}

/// Force, normal and lever of the burr's contacts.
fn burr_contacts(state: &State) -> (f64, Vector3<f64>, f64) {
    let contacts = &state.contacts[..state.contact_count as usize];
    let axis = Isometry3::from_parts(
        nalgebra::Translation3::identity(),
        nalgebra::UnitQuaternion::from_quaternion(nalgebra::Quaternion::from(
            state.t_world_burr.orientation_xyzw,
        )),
    ) * Vector3::z();
    let (mut force_n, mut push, mut lever_nm) = (0.0, Vector3::zeros(), 0.0);
    for contact in contacts.iter().filter(|contact| contact.part == ContactPart::Burr.code()) {
        let normal = Vector3::from(contact.normal);
        force_n += contact.normal_force_n;
        push += axis.cross(&normal) * contact.normal_force_n;
        lever_nm += contact.normal_force_n * RADIUS_M * lever_share(normal.dot(&axis));
    }
    (force_n, push, lever_nm)
}

/// The deflection is `mu F / k` across contact and axis, on the side given by the burr's spin, and zero
/// without the key. k is measured on the tool alone.
#[test]
fn cutting_with_the_side_pushes_an_isotropic_tool_across_by_its_force_over_its_stiffness() {
    let (geometry, hu) = wall();
    let tension_n = 3.0;
    let across = |keys: &str, speed: f64| {
        let mut simulation = Simulation::new(&scene(keys, ""), Some(CtView { geometry, hu: &hu })).unwrap();
        for tick in 0..1500 {
            simulation.step(&latched(tick, tension_n, speed)).unwrap();
        }
        *simulation.state()
    };
    let bent = {
        let parameters = manipulator_parameters(&scene("", "")).unwrap();
        move |force_n: f64, contact_n: f64| {
            let base = BaseMotion::at_rest(Isometry3::identity());
            let mut tool = AnyManipulator::new(Rung::Spatial, parameters.clone(), &base).unwrap();
            let force_n = Vector3::new(-contact_n, force_n, 0.0);
            for _ in 0..1500 {
                let input = StepInput {
                    base,
                    tendon: TendonCommand::Force([tension_n, 0.0]),
                    tip_wrench: Wrench { force_n, ..Wrench::zero() },
                    contacts: &[],
                };
                tool.step(1e-3, &input).unwrap();
            }
            tool.t_world_tip().translation.vector.y
        }
    };
    let without = across("", SPEED_RAD_S);
    let (force_n, _, _) = burr_contacts(&without);
    let stiffness_n_per_m = 0.1 / bent(0.1, force_n);
    assert!(force_n > 0.2 && without.t_world_burr.position_m[1].abs() < 1e-5, "{force_n} N");
    for speed in [SPEED_RAD_S, -SPEED_RAD_S] {
        let with = across("side_force = true\n", speed);
        let (force_n, push, _) = burr_contacts(&with);
        let expected_m = speed.signum() * COEFFICIENT * push.y / stiffness_n_per_m;
        let y = with.t_world_burr.position_m[1];
        println!(
            "{speed} rad/s: {force_n:.3} N, across {:.4} mm, mu F / k {:.4} mm (k {stiffness_n_per_m:.1} \
             N/m)",
            y * 1e3,
            expected_m * 1e3
        );
        assert!(push.y.abs() > 0.9 * force_n, "a contact of the side");
        assert!((y / expected_m - 1.0).abs() < 0.03, "{y} {expected_m}");
    }
}

/// Asserts that a keyframe continues bit for bit under 3 N, and returns the last state.
fn continued<'s>(new: impl Fn() -> Simulation<'s>) -> State {
    let mut bytes = vec![0; 1 << 20];
    let (mut whole, mut other) = (new(), new());
    (0..800).for_each(|tick| whole.step(&latched(tick, 3.0, SPEED_RAD_S)).unwrap());
    let length = whole.write_keyframe(&mut bytes).unwrap();
    other.restore_keyframe(&bytes[..length]).unwrap();
    for tick in 800..900 {
        whole.step(&latched(tick, 3.0, SPEED_RAD_S)).unwrap();
        other.step(&latched(tick, 3.0, SPEED_RAD_S)).unwrap();
    }
    assert_eq!(whole.state().hash, other.state().hash);
    *whole.state()
}

/// The motor's speed falls linearly with the contact torque, which is the cutting power over the speed.
/// Beyond the stall torque it stops, cuts nothing, reports the stall once, and turns again when released. A
/// keyframe continues bit for bit.
#[test]
fn a_motor_slows_stands_and_turns_again() {
    let (geometry, hu) = wall();
    let (stall_nmm, tension_n) = (0.6, 3.0);
    let scene = scene("", &format!("burr_stall_torque_nmm = {stall_nmm:?}\n"));
    let new = || Simulation::new(&scene, Some(CtView { geometry, hu: &hu })).unwrap();
    let mut simulation = new();
    let (mut told, mut slowed) = (Vec::new(), false);
    let mut torque_nm = 0.0;
    for tick in 0..4000 {
        // Pressed with increasing force, then released.
        let tension_n = if tick < 3000 { tension_n + 4.0 * tick as f64 / 1000.0 } else { 0.5 };
        let before_j = simulation.state().cutting_energy_j;
        simulation.step(&latched(tick, tension_n, SPEED_RAD_S)).unwrap();
        let state = *simulation.state();
        let expected = SPEED_RAD_S * (1.0_f64 - torque_nm / (stall_nmm * 1e-3)).max(0.0);
        assert!((state.burr_speed_rad_per_s - expected).abs() < 1e-6 * SPEED_RAD_S, "{tick}: {expected}");
        let lever_nm = burr_contacts(&state).2;
        torque_nm = COEFFICIENT * lever_nm;
        let cut_j = state.cutting_energy_j - before_j;
        // Energy that no voxel can absorb is not used.
        assert!(cut_j <= torque_nm * state.burr_speed_rad_per_s * 1e-3 * (1.0 + 1e-9), "{tick}: {cut_j} J");
        slowed |= (0.2..0.8).contains(&(expected / SPEED_RAD_S));
        told.extend(simulation.refusals().iter().map(|refusal| refusal.reason.clone()));
        if tick == 2999 {
            assert_eq!((state.burr_speed_rad_per_s, cut_j), (0.0, 0.0), "{torque_nm} N m");
        }
    }
    assert!(slowed && simulation.state().burr_speed_rad_per_s > 0.9 * SPEED_RAD_S, "it turns again");
    assert!(told.iter().all(|told| told.contains("motor stalled")), "{told:?}");
    // At the limit of stalling, its friction moves the bent tool, so that it may turn again for a tick.
    assert!((1..30).contains(&told.len()), "{} times", told.len());
    assert!(continued(new).burr_speed_rad_per_s < SPEED_RAD_S);
}

/// A motor outside the simulation reads the torque of a state and sets the speed of the next tick. One with
/// the built-in motor's line turns the burr as that does, bit for bit.
#[test]
fn a_motor_outside_that_answers_the_torque_turns_as_the_built_in_one() {
    let (geometry, hu) = wall();
    let stall_nm: f64 = 0.6e-3;
    let side = "side_force = true\n";
    let inside = scene(side, &format!("burr_stall_torque_nmm = {:?}\n", stall_nm * 1e3));
    let new = |scene: &Scene| Simulation::new(scene, Some(CtView { geometry, hu: &hu })).unwrap();
    let (mut inside, mut outside) = (new(&inside), new(&scene(side, "")));
    let mut slowest = f64::INFINITY;
    for tick in 0..2000 {
        let tension_n = 3.0 + tick as f64 / 500.0;
        let speed = SPEED_RAD_S * (1.0 - outside.state().burr_torque_nm / stall_nm).max(0.0);
        inside.step(&latched(tick, tension_n, SPEED_RAD_S)).unwrap();
        outside.step(&latched(tick, tension_n, speed)).unwrap();
        let of = |state: &State| {
            [state.burr_speed_rad_per_s, state.burr_torque_nm, state.bend_rad, state.cutting_energy_j]
        };
        assert_eq!(of(inside.state()), of(outside.state()), "tick {tick}");
        slowest = slowest.min(outside.state().burr_speed_rad_per_s);
    }
    assert!(slowest < 0.5 * SPEED_RAD_S, "{slowest} rad/s");
}

/// The standard tool from its file, with a drive shaft.
fn scene_with_shaft(keys: &str) -> Scene {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/tools/jhu_27.toml");
    let read = |_: &Path| Ok(std::fs::read_to_string(&file)? + "\n[drive_shaft]\n" + keys);
    let text = scene_text("", "").replace("[manipulator]\n", "[manipulator]\nfile = \"tool.toml\"\n");
    Scene::parse_with(&text, Path::new("side.toml"), &read).unwrap()
}

/// A shaft winds up by `M L / (G J)` under the torque of bone and friction. Its burr stops at the stall
/// torque, the stall is reported once, and the event names the key. A keyframe continues bit for bit.
#[test]
fn a_burr_on_a_shaft_lags_stands_and_continues() {
    let (geometry, hu) = wall();
    let (stall_nmm, friction_nmm, torsional_nm2, length_m) = (0.9, 0.1, 2e-3, 0.3);
    let scene = scene_with_shaft(&format!(
        "torsional_stiffness_nm2 = {torsional_nm2:?}\nlength_mm = {:?}\ntorsional_damping_ratio = 0.3\n\
         stall_torque_nmm = {stall_nmm:?}\nfriction_torque_nmm = {friction_nmm:?}\n",
        length_m * 1e3
    ));
    let new = || Simulation::new(&scene, Some(CtView { geometry, hu: &hu })).unwrap();
    let (mut simulation, mut told) = (new(), Vec::new());
    // Pressed steadily, for the wind-up; then with increasing force.
    let mut pressed = 0.0;
    for tick in 0..5000 {
        let tension_n = 3.0 + (tick as f64 - 1500.0).max(0.0) / 500.0;
        // Torque of the previous tick's burr contacts, which loads this tick.
        let brake_nm = COEFFICIENT * burr_contacts(simulation.state()).2 + friction_nmm * 1e-3;
        simulation.step(&latched(tick, tension_n, SPEED_RAD_S)).unwrap();
        let stalls = brake_nm >= stall_nmm * 1e-3;
        told.extend(simulation.refusals().iter().map(|refusal| (tick, stalls, refusal.reason.clone())));
        if tick == 1499 {
            let expected_rad = brake_nm * length_m / torsional_nm2;
            let wind_up_rad = simulation.state().drive_shaft_wind_up_rad;
            let speed = SPEED_RAD_S * (1.0 - brake_nm / (stall_nmm * 1e-3));
            println!(
                "{:.4} N mm: wound up by {wind_up_rad:.6} rad, M L/GJ {expected_rad:.6} rad",
                brake_nm * 1e3
            );
            println!("{:.2} rad/s, on the line {speed:.2}", simulation.state().burr_speed_rad_per_s);
            assert!(brake_nm > 1.5e-3 * friction_nmm, "it cuts");
            assert!((wind_up_rad / expected_rad - 1.0).abs() < 0.01);
            assert!((simulation.state().burr_speed_rad_per_s / speed - 1.0).abs() < 0.01);
        }
        if stalls {
            pressed += 1.0;
        }
    }
    assert_eq!(simulation.state().burr_speed_rad_per_s, 0.0);
    assert!(pressed > 100.0 && !told.is_empty(), "{pressed} ticks");
    // Reported in the very tick that demands the stall torque.
    for (tick, stalls, reason) in &told {
        assert!(*stalls, "{tick}: {reason}");
        assert!(reason.contains("`drive_shaft.stall_torque_nmm` is 0.9"), "{reason}");
    }
    println!("reported in tick {}: {}", told[0].0, told[0].2);
    assert!(continued(new).drive_shaft_wind_up_rad != 0.0);
}
