//! Time of a tick while a tunnel is drilled: 6 N on the tendon, a pilot hole in foam, 1 mm/s, steps of 1 ms.
//!
//! `cargo run --release -p simulation --example drilling_step_time [-- TENSION_N TICKS SHIFT_MM]`; 6 N, 5000 ticks, and a CT that is shifted
//! by 0.1 mm along y if absent (with 0 the tool lies on a border of voxels, and is searched for again whenever it crosses it). Where the
//! instructions go: `valgrind --tool=callgrind target/release/examples/drilling_step_time 6 2500`, all of which drill after the
//! first 1000.

#![allow(clippy::unwrap_used, reason = "the scene is shared with the tests, and cannot be wrong")]

use std::time::Instant;

use simulation::{CtView, Simulation};

#[path = "../tests/physics/common/tunnel.rs"]
mod tunnel;

const DT_MS: f64 = 1.0;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let given: Vec<f64> = std::env::args().skip(1).map(|text| text.parse()).collect::<Result<_, _>>()?;
    let tension_n = given.first().copied().unwrap_or(6.0);
    let ticks = given.get(1).copied().unwrap_or(tunnel::RUN_S / (DT_MS * 1e-3)) as u64;
    let (mut geometry, hu) = tunnel::foam();
    geometry.origin_world_m.y += given.get(2).copied().unwrap_or(0.1) * 1e-3;
    let mut simulation =
        Simulation::new(&tunnel::tunnel("planar", DT_MS), Some(CtView { geometry, hu: &hu }))?;
    let (mut times_us, mut planes) = (Vec::new(), 0);
    for tick in 0..ticks {
        let latched = tunnel::latched(tick, DT_MS * 1e-3, tension_n);
        let start = Instant::now();
        simulation.step(&latched)?;
        times_us.push(start.elapsed().as_secs_f64() * 1e6);
        planes += u64::from(simulation.state().contact_total);
    }
    times_us.sort_by(f64::total_cmp);
    let at = |share: usize| times_us.get(times_us.len() * share / 100).copied().unwrap_or_default();
    let state = simulation.state();
    println!(
        "{tension_n} N, {ticks} ticks of {DT_MS} ms: {:.2} us median, {:.2} us p99, {:.1} contacts a tick, tip at {:.4?} mm",
        at(50),
        at(99),
        planes as f64 / ticks.max(1) as f64,
        state.t_world_tip.position_m.map(|x| x * 1e3)
    );
    Ok(())
}
