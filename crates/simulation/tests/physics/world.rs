//! The whole tick: arm, manipulator, bone, burr.

use messages::{Command, ContactPart, Latched, SOURCE_HELD, State};
use nalgebra::Vector3;
use simulation::{CtView, Simulation, SimulationError};
use zerocopy::IntoBytes;

use crate::common::{TUNNEL, bone, feed_along_z, held, scene};

/// Feeds 1.5 mm/s along +z from the start with the burr on and 3 N on tendon 0.
fn latched(tick: u64, start: &State) -> Latched {
    held(tick, Command { arm_speed_m_per_s: 1.5e-3, ..feed_along_z(start) })
}

/// A tunnel like [`TUNNEL`], but in the CT itself, made of whole voxels.
const WHOLE_VOXELS: &str = r#"
name = "tight_tunnel"
run = { mode = "lockstep", duration_s = 3.0 }
volume = { phantom = "block" }
"#;

/// Regression: planes beyond 96 were dropped, including those of the burr, which comes last; the burr then
/// cut nothing, and the arm pressed with hundreds of newtons.
///
/// The tunnel is in the CT: the corners of its staircase of whole voxels touch a sphere on all sides. The
/// wall of a pilot hole is round, and a tube with 0.3 mm of play has planes within the 0.03 mm margin only up
/// to 26 degrees about the line it rests on (0.3 (1 - cos 26°) = 0.03): 61 in total, which is correct there,
/// but too few to exceed 96.
#[test]
fn the_burr_cuts_in_a_tunnel_in_which_every_sphere_has_several_planes() {
    let scene = scene(WHOLE_VOXELS);
    let (geometry, mut hu) = bone();
    for (number, hu) in hu.iter_mut().enumerate() {
        let [nx, ny, _] = geometry.dims;
        let centre = geometry.voxel_centre_world_m(number % nx, number / nx % ny, number / (nx * ny));
        let beyond_end_m = centre.z.max(0.0);
        if Vector3::new(centre.x, centre.y, beyond_end_m).norm() < 3.3e-3 {
            *hu = -1000;
        }
    }
    let mut simulation = Simulation::new(&scene, Some(CtView { geometry, hu: &hu })).unwrap();
    let start = *simulation.state();
    let (mut most, mut force_n) = (0, 0.0_f64);
    for tick in 0..3000 {
        simulation.step(&latched(tick, &start)).unwrap();
        let state = simulation.state();
        most = most.max(state.contact_total);
        let push = Vector3::from(state.flange_wrench.force_n).norm();
        force_n = force_n.max(push);
    }
    let state = simulation.state();
    println!("{most} planes at once, {} voxels drilled, {force_n:.2} N at most", state.removed_total);
    assert!(most > 96, "the tunnel must be tight for this test: {most} planes");
    assert!(state.removed_total > 500, "{} voxels", state.removed_total);
    // 3 N of tension and a few newtons from thrust, friction and the staircase; not hundreds.
    assert!(force_n < 60.0, "{force_n} N");
}

/// Regression: a stationary burr slid on bone without friction, as if it were spinning.
#[test]
fn a_burr_rubs_on_bone_like_the_tube_while_it_stands_still_and_not_while_it_turns() {
    let scene = scene(TUNNEL);
    let (geometry, hu) = bone();
    let friction_share = |burr_speed_rad_per_s: f64| {
        let mut simulation = Simulation::new(&scene, Some(CtView { geometry, hu: &hu })).unwrap();
        let start = *simulation.state();
        let mut most = 0.0_f64;
        for tick in 0..500 {
            let mut latched = latched(tick, &start);
            latched.commands[0].command.burr_speed_rad_per_s = burr_speed_rad_per_s;
            simulation.step(&latched).unwrap();
            let state = simulation.state();
            let contacts = &state.contacts[..state.contact_count as usize];
            for contact in contacts.iter().filter(|contact| contact.part == ContactPart::Burr.code()) {
                most = most.max(Vector3::from(contact.friction_force_n).norm() / contact.normal_force_n);
            }
        }
        most
    };
    let (still, turning) = (friction_share(0.0), friction_share(1.0));
    println!("friction over normal force: {still:.4} at rest, {turning:.4} while it turns");
    // The tube's coefficient is 0.2, which a sliding contact reaches.
    assert!((still - 0.2).abs() < 1e-6 && turning == 0.0);
}

#[test]
fn a_snapshot_continues_bit_for_bit_and_a_reset_returns_to_the_initial_state() {
    let scene = scene(TUNNEL);
    let (geometry, hu) = bone();
    let ct = Some(CtView { geometry, hu: &hu });
    let mut simulation = Simulation::new(&scene, ct).unwrap();
    let start = *simulation.state();
    (0..700).for_each(|tick| simulation.step(&latched(tick, &start)).unwrap());
    let snapshot = simulation.snapshot();
    let mut other = Simulation::new(&scene, ct).unwrap();
    other.restore(&snapshot).unwrap();
    for tick in 700..1200 {
        simulation.step(&latched(tick, &start)).unwrap();
        other.step(&latched(tick, &start)).unwrap();
        assert_eq!(simulation.state().as_bytes(), other.state().as_bytes(), "tick {tick}");
        assert_eq!(simulation.removed(), other.removed(), "tick {tick}");
    }
    // A tick with reset and without commands: the initial state one tick later.
    let nothing = Latched { tick: 1200, reset: 1, ..Latched::zeroed() };
    simulation.step(&nothing).unwrap();
    let mut fresh = Simulation::new(&scene, ct).unwrap();
    fresh.step(&Latched { tick: 0, ..Latched::zeroed() }).unwrap();
    let mut after = *simulation.state();
    (after.tick, after.sim_time_s, after.hash) = (1, fresh.state().sim_time_s, fresh.state().hash);
    assert_eq!(after.as_bytes(), fresh.state().as_bytes());
}

/// An unreachable goal is refused for the arm only: tendon and burr follow the same command.
#[test]
fn each_part_of_a_command_acts_or_is_refused_on_its_own() {
    let scene = scene(TUNNEL);
    let (geometry, hu) = bone();
    let mut simulation = Simulation::new(&scene, Some(CtView { geometry, hu: &hu })).unwrap();
    let start = *simulation.state();
    let mut first = latched(0, &start);
    first.commands[0].command.t_world_base.position_m[0] += 5.0;
    simulation.step(&first).unwrap();
    let refusals = simulation.refusals();
    assert!(refusals.len() == 1 && refusals[0].reason.starts_with("arm: "), "{refusals:?}");
    for tick in 1..200 {
        let mut held = first;
        (held.tick, held.commands[0].source) = (tick, SOURCE_HELD);
        simulation.step(&held).unwrap();
    }
    let state = simulation.state();
    assert_eq!(state.arm_joint_position_rad, start.arm_joint_position_rad, "the arm does not move");
    assert_eq!(state.burr_speed_rad_per_s, 800.0);
    assert!(state.tendon_tension_n[0] > 2.0, "{} N", state.tendon_tension_n[0]);
}

/// Both values are within their ranges; the tip reached 1e110 mm.
#[test]
fn a_lost_tool_is_an_error_and_its_last_state_is_sound() {
    let scene = scene(
        "name = \"lost\"\nrun = { mode = \"lockstep\", duration_s = 5.0 }\n\
         manipulator = { model = \"modal\", stiffness_scale = 0.001 }\n",
    );
    let mut simulation = Simulation::new(&scene, None).unwrap();
    let start = *simulation.state();
    let lost = (0..5000).find_map(|tick| {
        let mut latched = latched(tick, &start);
        latched.commands[0].command.tendon_force_n[0] = 60.0;
        simulation.step(&latched).err()
    });
    println!("{}", lost.as_ref().map(ToString::to_string).unwrap_or_default());
    assert!(matches!(lost, Some(SimulationError::Lost(_))), "{lost:?}");
}
