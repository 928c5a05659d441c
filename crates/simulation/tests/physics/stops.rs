//! No flexure passes its stop. Regression: only the stops that the motion without contacts approached were
//! part of the solve, so the impulses of others threw flexures past theirs: by 10.8 degrees in one tick of a
//! soft, light tool.

#![allow(clippy::unwrap_used, reason = "a scene that cannot be built is a failed test")]

use messages::{BurrMode, Command, CommandSource, Latched, TendonMode};
use simulation::{CtView, Simulation};

use crate::common::arm::Uniform;
use crate::common::{bone, scene};

/// Largest angle past a stop, degrees: half of it is the soft part of a stop, the rest its hard part under an
/// impact or a jam.
const MOST_PAST_DEG: f64 = 0.1;
/// A solve that does not converge ends exactly there.
const ROUNDING_DEG: f64 = 1e-9;

/// Pulls a tool and returns its largest angle past a stop, degrees, and the last bend. `text` is the scene
/// without name, run and tool.
fn pull(text: &str, dt_ms: f64, tension_n: f64, burr_rad_per_s: f64, in_bone: bool) -> [f64; 2] {
    let (geometry, hu) = bone();
    let scene = scene(&format!(
        "name = \"stops\"\nrun = {{ mode = \"lockstep\", dt_ms = {dt_ms:?}, duration_s = 1.0 }}\n\
         arm = {{ model = \"fixed\" }}\n{text}"
    ));
    let mut simulation = Simulation::new(&scene, in_bone.then_some(CtView { geometry, hu: &hu })).unwrap();
    let command = Command {
        sequence: 1,
        tendon_mode: TendonMode::ServoJf.code(),
        tendon_force_n: [tension_n, 0.0, 0.0, 0.0],
        burr_mode: BurrMode::Speed.code(),
        burr_speed_rad_per_s: burr_rad_per_s,
        ..Command::zeroed()
    };
    let mut past_rad = 0.0f64;
    for tick in 0..((60.0 / dt_ms) as u64).clamp(20, 100) {
        let mut latched = Latched { tick, controller_count: 1, ..Latched::zeroed() };
        let source = if tick == 0 { CommandSource::Fresh } else { CommandSource::Held };
        (latched.commands[0].source, latched.commands[0].command) = (source.code(), command);
        simulation.step(&latched).unwrap();
        past_rad = past_rad.max(simulation.state().stop_excess_rad);
    }
    [past_rad.to_degrees(), simulation.state().bend_rad.to_degrees()]
}

#[test]
fn a_soft_light_tool_is_not_thrown_past_its_stops() {
    let soft = "manipulator = { stiffness_scale = 0.1, mass_scale = 0.1, damping_ratio = 0.01 }\n";
    let softer = "manipulator = { stiffness_scale = 0.05, mass_scale = 0.065, damping_ratio = 0.005, \
                  tendon_friction = 0.3 }\n";
    for (text, dt_ms, tension_n) in [(soft, 1.0, 20.0), (softer, 5.0, 60.0)] {
        let [past_deg, bend_deg] = pull(text, dt_ms, tension_n, 0.0, false);
        println!("{tension_n} N: {past_deg:.4} degrees past a stop at most, bend {bend_deg:.1} degrees");
        assert!(past_deg > 0.0 && past_deg < MOST_PAST_DEG + ROUNDING_DEG);
        // Its 27 flexures of 5 degrees are at their stops.
        assert!((bend_deg - 135.0).abs() < 27.0 * MOST_PAST_DEG);
    }
}

/// Log-uniform within the validated ranges of stiffness, mass, damping and contact stiffness.
#[test]
fn no_flexure_of_a_random_scene_passes_its_stop() {
    let mut draw = Uniform(4646);
    let (mut at_stops, mut worst_deg) = (0, 0.0f64);
    const SCENES: usize = 60;
    for number in 0..SCENES {
        let mut within = |low: f64, high: f64| libm::exp(draw.between(libm::log(low), libm::log(high)));
        let [dt_ms, stiffness, mass] = [within(0.1, 5.0), within(0.05, 10.0), within(0.01, 100.0)];
        let [damping, contact, tension_n] = [within(0.005, 5.0), within(1e4, 1e8), within(10.0, 60.0)];
        let [hole_mm, friction] = [within(6.6, 14.0), within(0.01, 0.5)];
        let model = ["planar", "spatial", "full", "constant_curvature"][number % 4];
        let in_bone = number % 3 > 0;
        let burr_rad_per_s = if number % 3 == 2 { 800.0 } else { 0.0 };
        let mut text = format!(
            "contact = {{ stiffness_n_per_m = {contact:?}, friction = {friction:?} }}\n\
             manipulator = {{ model = \"{model}\", stiffness_scale = {stiffness:?}, mass_scale = {mass:?}, \
             damping_ratio = {damping:?} }}\n"
        );
        if in_bone {
            text += &format!(
                "volume = {{ phantom = \"block\" }}\n[[predrill]]\nfrom_mm = [0.0, 0.0, -110.0]\n\
                 to_mm = [0.0, 0.0, 0.0]\ndiameter_mm = {hole_mm:?}\n"
            );
        }
        let [past_deg, bend_deg] = pull(&text, dt_ms, tension_n, burr_rad_per_s, in_bone);
        at_stops += usize::from(past_deg > 0.0);
        worst_deg = worst_deg.max(past_deg);
        if past_deg > MOST_PAST_DEG + ROUNDING_DEG {
            println!("{number} {dt_ms} ms {tension_n} N: {past_deg:.3} past, bend {bend_deg:.1}\n{text}");
        }
    }
    println!("{at_stops} of {SCENES} scenes reach a stop, {worst_deg:.3} degrees past at most");
    assert!(at_stops > SCENES / 4 && worst_deg < MOST_PAST_DEG + ROUNDING_DEG);
}
