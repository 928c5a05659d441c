//! The contact solver in the four tunnels of the published experiment, at the standard and finer steps, and
//! in every model.

#![allow(clippy::unwrap_used, reason = "a scene that cannot be built is a failed test")]

use crate::common::tunnel::{RUN_S, foam, latched, tunnel};
use simulation::{CtView, Simulation};

/// Number of ticks with contact, and of those with a residual above 1e-6 m/s.
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
        "{model} {tension_n} N, {dt_ms} ms: {missed} of {touching} ticks above 1e-6 m/s, {worst:.1e} at \
         most, {:.1} iterations, {most} at most; {} voxels, bend {:.1} degrees",
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
    for model in ["constant_curvature", "modal", "spatial", "full"] {
        let (ticks, above) = run(model, 10.0, 5.0);
        assert!(ticks > 800, "{model}: {ticks} ticks in contact");
        assert!(above * 1000 <= ticks, "{model}: {above} of {ticks} ticks above 1e-6 m/s");
    }
}
