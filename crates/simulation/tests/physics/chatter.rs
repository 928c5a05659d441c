//! Chatter: a burr fed slowly into bone follows its path and does not jump from wall to wall.

#![allow(clippy::unwrap_used, reason = "a scene that cannot be built is a failed test")]

use crate::common::tunnel::{RAMP_S, RUN_S, foam, latched, tunnel};
use nalgebra::Vector3;
use simulation::{CtView, Simulation};

/// Path length of the burr over the straight distance (largest over all seconds of feed), and its largest
/// move in a tick, mm.
fn walked_over_net(model: &str, tension_n: f64, dt_ms: f64) -> (f64, f64) {
    let (geometry, hu) = foam();
    let mut simulation = Simulation::new(&tunnel(model, dt_ms), Some(CtView { geometry, hu: &hu })).unwrap();
    let dt_s = dt_ms * 1e-3;
    let burr_m = |simulation: &Simulation<'_>| Vector3::from(simulation.state().t_world_burr.position_m);
    let (ramp, ticks) = ((RAMP_S / dt_s) as u64, (RUN_S / dt_s) as u64);
    let mut last_m = burr_m(&simulation);
    let (mut worst, mut walked_m, mut from_m, mut largest_m) = (0.0f64, 0.0, last_m, 0.0f64);
    for tick in 0..ticks {
        simulation.step(&latched(tick, dt_s, tension_n)).unwrap();
        let now_m = burr_m(&simulation);
        if tick == ramp {
            (walked_m, from_m) = (0.0, now_m);
        }
        if tick > ramp {
            walked_m += (now_m - last_m).norm();
            largest_m = largest_m.max((now_m - last_m).norm());
            if ((tick - ramp) as f64 * dt_s).fract() < 0.5 * dt_s {
                worst = worst.max(walked_m / (now_m - from_m).norm());
                (walked_m, from_m) = (0.0, now_m);
            }
        }
        last_m = now_m;
    }
    let bend = simulation.state().bend_rad.to_degrees();
    println!(
        "{model} {tension_n} N, {dt_ms} ms: walked {worst:.2} times the net way, {:.3} mm a tick at most, \
         {bend:.1} degrees",
        largest_m * 1e3
    );
    (worst, largest_m * 1e3)
}

/// Regression: the planes of the two sides of a groove alternated, and the gap jumped where voxels hid behind
/// others that were cut deeper. The burr moved up to 27 times its path (10 N, 1 ms), and up to 0.19 mm in a
/// tick (25 N, 5 ms).
///
/// Bounds: 1.5 times the path, as the tool still vibrates on the cutting edge (1.4 observed); 0.05 mm per
/// tick is the requirement at 25 N and 5 ms, and elsewhere 1.5 times the observed maximum, also 0.05 mm.
#[test]
fn a_burr_in_its_tunnel_walks_no_detours() {
    for dt_ms in [1.0, 5.0] {
        for tension_n in [0.0, 3.0, 6.0, 10.0, 25.0] {
            let (ratio, largest_mm) = walked_over_net("planar", tension_n, dt_ms);
            assert!(ratio < 1.5, "{tension_n} N, {dt_ms} ms: {ratio}");
            let most_mm = if tension_n == 25.0 { 0.05 } else { 0.08 };
            assert!(largest_mm < most_mm, "{tension_n} N, {dt_ms} ms: {largest_mm} mm");
        }
    }
}

/// The bend does not depend on the step (before the fix it differed by 4.4 degrees at 25 N between 1 and 5
/// ms). Bound: 1 degree, 2 percent.
#[test]
fn the_tunnel_is_the_same_at_every_step() {
    for tension_n in [6.0, 15.0, 25.0] {
        let bends = [1.0, 2.0, 5.0].map(|dt_ms| end_deg("planar", tension_n, dt_ms));
        println!("{tension_n} N: bends of {bends:.2?} degrees at 1, 2 and 5 ms");
        let (low, high) = (bends.into_iter().fold(90.0, f64::min), bends.into_iter().fold(0.0, f64::max));
        assert!(high - low < 1.0, "{tension_n} N: {bends:?}");
    }
}

/// The tool's bend at the end of the tunnel, degrees.
fn end_deg(model: &str, tension_n: f64, dt_ms: f64) -> f64 {
    let (geometry, hu) = foam();
    let mut simulation = Simulation::new(&tunnel(model, dt_ms), Some(CtView { geometry, hu: &hu })).unwrap();
    let dt_s = dt_ms * 1e-3;
    for tick in 0..(RUN_S / dt_s) as u64 {
        simulation.step(&latched(tick, dt_s, tension_n)).unwrap();
    }
    simulation.state().bend_rad.to_degrees()
}
