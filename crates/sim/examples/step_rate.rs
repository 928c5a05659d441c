//! Steps per second: the bare physics, and the same ticks with `Sim`, alternating over the same ticks of the
//! default scene.
//!
//! `cargo run --release -p sim --example step_rate [TICKS [ROUNDS]]`

#![allow(clippy::print_stdout, reason = "it prints figures")]

use std::time::Instant;

use hub::latch::Latch;
use messages::{ArmMode, BurrMode, Command, ControllerIndex, Reset, TendonMode, Tick};
use sim::{Drive, SharedScene, Sim};
use simulation::Simulation;

/// Drills the curve as the built-in controller does, without its guidance.
fn command(axis: [f64; 3], tick: u64) -> Command {
    let mut command = Command {
        tendon_mode: TendonMode::ServoJf.code(),
        arm_mode: ArmMode::Insert.code(),
        arm_axis: axis,
        arm_depth_m: 0.028,
        arm_speed_m_per_s: 0.0015,
        burr_mode: BurrMode::Speed.code(),
        burr_speed_rad_per_s: 8000.0 * core::f64::consts::TAU / 60.0,
        ..Command::zeroed()
    };
    command.tendon_force_n[0] = (8.0 * (tick as f64 * 0.0015 - 3.0) / 21.0).clamp(0.0, 8.0);
    command
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut words = std::env::args().skip(1);
    let mut number = |default| words.next().map_or(Ok(default), |word| word.parse::<u64>());
    let (ticks, rounds) = (number(20_000)?, number(3)?);
    let shared = SharedScene::load(None, &[], None)?;
    let scene = shared.scene();
    let mut sim = Sim::new(&shared, &Drive::Everything)?;
    let axis = {
        let [x, y, z, w] = sim.state().t_world_base.orientation_xyzw;
        [2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)]
    };
    let ct = shared.ct().map(|ct| simulation::CtView::from(&ct.volume));
    for _ in 0..rounds {
        let mut bare = Simulation::new(scene, ct)?;
        let mut latch = Latch::new(scene);
        let mut bare_s = 0.0;
        for tick in 0..ticks {
            let given = Command { sequence: tick + 1, state_tick: tick, ..command(axis, tick) };
            latch.offer(ControllerIndex(0), &given, Tick(tick))?;
            let latched = latch.latch(Tick(tick), Reset::No);
            let began = Instant::now();
            bare.step(&latched)?;
            bare_s += began.elapsed().as_secs_f64();
            bare.make_room();
        }
        sim.reset()?;
        let mut sim_s = 0.0;
        for tick in 0..ticks {
            let given = command(axis, tick);
            let began = Instant::now();
            sim.step(&[given], 1)?;
            sim_s += began.elapsed().as_secs_f64();
        }
        assert_eq!(bare.state().hash, sim.state().hash);
        println!(
            "{ticks} ticks: physics alone {:.0} per second, Sim {:.0} per second, {:.1} %; {} voxels drilled",
            ticks as f64 / bare_s,
            ticks as f64 / sim_s,
            100.0 * bare_s / sim_s,
            sim.state().removed_total
        );
    }
    Ok(())
}
