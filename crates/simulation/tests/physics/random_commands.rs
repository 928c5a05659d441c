//! Random valid commands pull, push and swing the tool in its hole: the work of each tick is bounded.
//! Regression: a tick searched the planes of every sphere again in each attempt; the worst of 3,576 took
//! 357 ms.

#![allow(clippy::unwrap_used, reason = "a scene that cannot be built is a failed test")]

use messages::{ArmMode, BURR_SPEED, Command, CommandSource, Latched, TendonMode};
use simulation::{CtView, Simulation, ToolEffort};

use crate::common::{Draw, bone, scene};

const SEEDS: u64 = 6;
const TICKS: u64 = 130;

/// Steps the tool with random commands, each held for up to 100 ticks. Returns the work of each tick.
/// `tolerance_m_per_s` is that of the contact solver; `None` leaves it as it is.
fn efforts(seed: u64, tolerance_m_per_s: Option<f64>) -> Vec<ToolEffort> {
    let mut draw = Draw(seed);
    (0..5).for_each(|_| _ = draw.next());
    let hole_mm = 6.5 + 1.5 * draw.next();
    let scene = scene(&format!(
        "name = \"random\"\nrun = {{ mode = \"lockstep\", dt_ms = 1.0, duration_s = 1.0 }}\n\
         volume = {{ phantom = \"block\" }}\n[[predrill]]\nfrom_mm = [0.0, 0.0, -110.0]\n\
         to_mm = [0.0, 0.0, 0.0]\ndiameter_mm = {hole_mm:?}\n"
    ));
    let (geometry, hu) = bone();
    let mut simulation = Simulation::new(&scene, Some(CtView { geometry, hu: &hu })).unwrap();
    if let Some(tolerance_m_per_s) = tolerance_m_per_s {
        simulation.set_contact_tolerance(tolerance_m_per_s);
    }
    let (mut command, mut held) = (Command::zeroed(), 0);
    let step = |tick| {
        let mut latched = Latched { tick, controller_count: 1, ..Latched::zeroed() };
        let source = if held == 0 { CommandSource::Fresh } else { CommandSource::Held };
        if held == 0 {
            held = 1 + (draw.next() * 100.0) as u64;
            command = random(&mut draw, &simulation, command.sequence + 1);
        }
        held -= 1;
        (latched.commands[0].source, latched.commands[0].command) = (source.code(), command);
        simulation.step(&latched).unwrap();
        *simulation.tool_effort()
    };
    (0..TICKS).map(step).collect()
}

#[allow(clippy::approx_constant, reason = "a joint's speed, just below a turn per second")]
fn random(draw: &mut Draw, simulation: &Simulation, sequence: u64) -> Command {
    let tendons = [TendonMode::None, TendonMode::ServoJf, TendonMode::ServoJp, TendonMode::MoveJp];
    let arms = [ArmMode::None, ArmMode::ServoCp, ArmMode::MoveCp, ArmMode::Hold, ArmMode::ServoJv];
    let mut signed = |most: f64| most * (2.0 * draw.next() - 1.0);
    let mut command = Command {
        sequence,
        t_world_base: simulation.state().t_world_base,
        tendon_force_n: [0; 4].map(|_| signed(60.0).abs()),
        tendon_displacement_m: [0; 4].map(|_| signed(0.02)),
        arm_joint_velocity_rad_per_s: [0; 7].map(|_| signed(6.28)),
        arm_speed_m_per_s: signed(1.0).abs().max(1e-3),
        burr_mode: BURR_SPEED,
        burr_speed_rad_per_s: signed(6283.0).max(0.0),
        ..Command::zeroed()
    };
    let far_m = signed(0.1);
    command.t_world_base.position_m.iter_mut().for_each(|x_m| *x_m += signed(far_m));
    command.tendon_mode = tendons[(draw.next() * tendons.len() as f64) as usize].code();
    command.arm_mode = arms[(draw.next() * arms.len() as f64) as usize].code();
    command
}

#[test]
fn a_sphere_is_searched_again_only_if_it_has_moved_farther() {
    let all: Vec<ToolEffort> = (0..SEEDS).flat_map(|seed| efforts(seed, None)).collect();
    let spheres = all.iter().map(|effort| effort.searches).min().unwrap();
    let worst = all.iter().max_by_key(|effort| effort.searches).unwrap();
    let most_attempts = all.iter().map(|effort| effort.attempts).max().unwrap();
    println!("{spheres} spheres, at most {most_attempts} attempts, most searches: {worst:?}");
    assert!(spheres > 30 && most_attempts >= 5, "the commands must be violent");
    assert!(worst.searches <= 3 * spheres, "{worst:?}");
}

/// A solver that is never satisfied takes every iteration, twice.
#[test]
fn a_tick_ends_its_attempts_when_the_solver_has_iterated_enough() {
    const EACH: usize = 2 * 64;
    let all: Vec<ToolEffort> = (0..SEEDS).flat_map(|seed| efforts(seed, Some(0.0))).collect();
    let worst = all.iter().max_by_key(|effort| effort.iterations).unwrap();
    println!("{worst:?}");
    assert!(worst.iterations > 512, "the bound was not reached: {worst:?}");
    // The attempt that reaches the bound, and the last one.
    assert!(worst.iterations <= 512 + 2 * EACH, "{worst:?}");
}
