//! Time of the arm's tick: idle, following a changing target, moving, on a straight line; and of its commands.
//!
//! `cargo run --release -p simulation --example arm_step_time`

use nalgebra::{Isometry3, Vector3};
use simulation::arm::{Arm, ArmCommand, ArmError, ArmParameters, COMFORTABLE_Q_RAD, place_base_for};
use std::time::Instant;

const DT_S: f64 = 1e-3;

/// Median, 99th percentile and maximum of the times of `body`, in microseconds.
fn report(
    name: &str,
    count: usize,
    mut body: impl FnMut(usize) -> Result<(), ArmError>,
) -> Result<(), ArmError> {
    let mut times_us = Vec::with_capacity(count);
    for i in 0..count {
        let start = Instant::now();
        body(i)?;
        times_us.push(start.elapsed().as_nanos() as f64 / 1e3);
    }
    times_us.sort_by(f64::total_cmp);
    let at = |share: f64| times_us[((count - 1) as f64 * share) as usize];
    println!("{name:44} {:8.2} {:8.2} {:8.2}", at(0.5), at(0.99), at(1.0));
    Ok(())
}

fn arm() -> Result<Arm, ArmError> {
    let mut parameters = ArmParameters::ur5(DT_S);
    let q = COMFORTABLE_Q_RAD;
    let base = place_base_for(&parameters.geometry, &Isometry3::identity(), &q);
    parameters.t_world_arm_base = base;
    Arm::new(parameters, &q)
}

fn insertion(length_m: f64, speed_m_s: f64) -> ArmCommand {
    ArmCommand::MoveCp {
        t_world_tool: Isometry3::translation(0.0, 0.0, length_m),
        max_speed_m_s: Some(speed_m_s),
        max_angular_speed_rad_s: None,
    }
}

fn main() -> Result<(), ArmError> {
    println!("{:44} {:>8} {:>8} {:>8}", "microseconds", "median", "p99", "max");
    let mut arm = arm()?;
    let home = arm.state().q_rad;
    report("idle tick", 20_000, |_| {
        arm.step();
        Ok(())
    })?;
    report("servo_jp, new target every tick", 20_000, |i| {
        let wave = 0.2 * (i as f64 * DT_S * 3.0).sin();
        arm.command(ArmCommand::ServoJp { q_rad: home.map(|q| q + wave), speed_fraction: 1.0 })?;
        arm.step();
        Ok(())
    })?;
    report("servo_cp, new target every tick", 20_000, |i| {
        let wave = 0.05 * (i as f64 * DT_S * 3.0).sin();
        let t_world_tool = Isometry3::new(Vector3::new(0.0, wave, wave), Vector3::zeros());
        arm.command(ArmCommand::ServoCp { t_world_tool, speed_fraction: 1.0 })?;
        arm.step();
        Ok(())
    })?;
    arm.command(ArmCommand::MoveJp { q_rad: home.map(|q| q + 1.0), speed_fraction: 0.02 })?;
    report("move_jp, under way", 10_000, |_| {
        arm.step();
        Ok(())
    })?;
    arm.command(ArmCommand::MoveJp { q_rad: home, speed_fraction: 1.0 })?;
    while !arm.step().done {}
    arm.command(insertion(0.1, 0.005))?;
    report("move_cp, under way", 10_000, |_| {
        arm.step();
        Ok(())
    })?;
    report("move_cp, goal changed along the line (command)", 200, |i| {
        arm.command(insertion(0.1, 0.004 + 1e-6 * i as f64))?;
        arm.step();
        Ok(())
    })?;
    report("snapshot and restore, on a line", 2_000, |_| {
        let snapshot = arm.snapshot();
        arm.restore(&snapshot)
    })
}
