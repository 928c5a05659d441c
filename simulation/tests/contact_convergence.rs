//! The contact solver in the four tunnels of the published experiment, with its step and finer ones, and in every model.

#![allow(clippy::unwrap_used, reason = "a scene that cannot be built is a failed test")]

mod common;

use messages::{ArmMode, BurrMode, Command, CommandSource, Latched, TendonMode};
use nalgebra::Vector3;
use scene::Scene;
use simulation::bone::{GridGeometry, MaterialLaw};
use simulation::{CtView, Simulation};
use std::path::Path;

/// Duration of the tension ramp before the feed, s.
const RAMP_S: f64 = 1.0;
/// The whole run: 4 mm are drilled after the ramp.
const RUN_S: f64 = 5.0;
const FEED_M_PER_S: f64 = 1e-3;
/// Sawbones foam of 10 pounds per cubic foot, kg/m³.
const FOAM_KG_PER_M3: f64 = 160.0;

fn foam() -> (GridGeometry, Vec<i16>) {
    let law = MaterialLaw::default();
    let hu = ((FOAM_KG_PER_M3 - law.density_offset_kg_m3) / law.density_slope_kg_m3_hu).round() as i16;
    let dims = [48, 32, 108];
    let origin = Vector3::new(-9.75e-3, -7.75e-3, -37.75e-3);
    (GridGeometry::axis_aligned(dims, [0.5e-3; 3], origin), vec![hu; dims.iter().product()])
}

fn tunnel(model: &str, dt_ms: f64) -> Scene {
    let text = format!(
        "name = \"tunnel\"\n[run]\nmode = \"lockstep\"\ndt_ms = {dt_ms:?}\nduration_s = 10.0\n\
         [volume]\nphantom = \"block\"\nbone_threshold_hu = -100\n\
         [[predrill]]\nfrom_mm = [0.0, 0.0, -60.0]\nto_mm = [0.0, 0.0, 0.0]\ndiameter_mm = 7.0\n\
         [manipulator]\nmodel = \"{model}\"\ntendon_friction = 0.1\n[contact]\nfriction = 0.2\n\
         [tool]\nburr_start_mm = [0.0, 0.0, 0.0]\ndirection = [0.0, 0.0, 1.0]\nbend_toward = [1.0, 0.0, 0.0]\n\
         [[controller]]\nname = \"feed\"\ndrives = [\"tendon\", \"arm\", \"burr\"]\nexternal = true\n"
    );
    Scene::parse(&text, Path::new("tunnel.toml")).unwrap()
}

fn latched(tick: u64, dt_s: f64, tension_n: f64) -> Latched {
    let time_s = tick as f64 * dt_s;
    let feeding = time_s >= RAMP_S;
    let fresh = time_s < RAMP_S + dt_s;
    let command = Command {
        sequence: ((RAMP_S / dt_s) as u64 + 1).min(tick) + 1,
        tendon_mode: TendonMode::ServoJf.code(),
        tendon_force_n: [tension_n * (time_s / RAMP_S).min(1.0), 0.0, 0.0, 0.0],
        burr_mode: BurrMode::Speed.code(),
        burr_speed_rad_per_s: 235.6,
        arm_mode: if feeding { ArmMode::Insert } else { ArmMode::None }.code(),
        arm_axis: [0.0, 0.0, 1.0],
        arm_depth_m: 0.03,
        arm_speed_m_per_s: FEED_M_PER_S,
        ..Command::zeroed()
    };
    let mut latched = Latched { tick, controller_count: 1, ..Latched::zeroed() };
    latched.commands[0].source = if fresh { CommandSource::Fresh } else { CommandSource::Held }.code();
    latched.commands[0].command = command;
    latched
}

/// Ticks with contact, those whose residual is above 1e-6 m/s, and the mean number of iterations.
fn run(model: &str, tension_n: f64, dt_ms: f64) -> (usize, usize) {
    let (geometry, hu) = foam();
    let mut simulation = Simulation::new(&tunnel(model, dt_ms), Some(CtView { geometry, hu: &hu })).unwrap();
    let dt_s = dt_ms * 1e-3;
    let (mut touching, mut missed, mut iterations, mut most, mut worst) = (0, 0, 0, 0, 0.0f64);
    for tick in 0..(RUN_S / dt_s) as u64 {
        simulation.step(&latched(tick, dt_s, tension_n)).unwrap();
        assert!(simulation.refusals().is_empty(), "{}", simulation.refusals()[0].reason);
        let report = simulation.tool_report();
        if report.active_contact_count > 0 {
            touching += 1;
            missed += usize::from(report.contact_residual_m_per_s > 1e-6);
            iterations += report.contact_iterations;
            most = most.max(report.contact_iterations);
            worst = worst.max(report.contact_residual_m_per_s);
        }
    }
    println!(
        "{model} {tension_n} N, {dt_ms} ms: {missed} of {touching} ticks above 1e-6 m/s, {worst:.1e} at most, {:.1} iterations, {most} at most; {} voxels, bend {:.1} degrees",
        iterations as f64 / touching.max(1) as f64,
        simulation.state().removed_total,
        simulation.state().bend_rad.to_degrees()
    );
    assert!(simulation.state().removed_total > 100, "the burr must drill");
    (touching, missed)
}

#[test]
fn contact_converges_in_the_four_tunnels() {
    for dt_ms in [1.0, 2.0, 5.0] {
        let (mut all, mut missed) = (0, 0);
        for tension_n in [6.0, 10.0, 15.0, 25.0] {
            let (ticks, above) = run("planar", tension_n, dt_ms);
            (all, missed) = (all + ticks, missed + above);
        }
        assert!(all as f64 * dt_ms > 8000.0, "{all} ticks in contact");
        assert!(missed * 1000 <= all, "{dt_ms} ms: {missed} of {all} ticks above 1e-6 m/s");
    }
}

#[test]
fn contact_converges_in_every_model() {
    for model in ["constant_curvature", "spatial", "full"] {
        let (ticks, above) = run(model, 10.0, 5.0);
        assert!(ticks > 800, "{model}: {ticks} ticks in contact");
        assert!(above * 1000 <= ticks, "{model}: {above} of {ticks} ticks above 1e-6 m/s");
    }
}
