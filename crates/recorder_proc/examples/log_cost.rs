//! Measures what logging costs: bytes and processor time per simulated second, and how fast a log is read back.
//!
//! `cargo run --release -p recorder_proc --example log_cost [seconds] [folder]`
//!
//! The states are as full as those of a drilling scene: 27 flexures, 10 contacts, 2 controllers, values with random
//! mantissas. The images are noise, 512 × 512 at 15 Hz, the worst case for a compressor.
#![allow(clippy::expect_used, clippy::print_stdout, reason = "a measurement, not a part of the product")]

use fastrand::Rng;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Instant;

use ipc_types::messages::*;
use recorder_proc::build_info;
use recorder_proc::log_file::{LogFile, create_run};
use run_log::{EndReason, LogHeader, LogReader, RunMode, frames};
use zerocopy::IntoBytes;

const SIDE: u32 = 512;
const TICKS_PER_FRAME: u64 = 66;

fn main() {
    let mut arguments = std::env::args().skip(1);
    let seconds: u64 = arguments.next().and_then(|text| text.parse().ok()).unwrap_or(10);
    let folder = arguments.next().map_or_else(std::env::temp_dir, PathBuf::from);
    println!(
        "images | MB per simulated s | write: % of a core at real time | p50, p99, max of a tick in us | read: x real time"
    );
    for with_images in [false, true] {
        let path = folder.join("log_cost.mcap");
        let (write_s, mut tick_us) = write(&path, seconds, with_images);
        let bytes = std::fs::metadata(&path).expect("the log is there").len() as f64;
        let began = Instant::now();
        let ticks =
            LogReader::open(&LogFile::at(&path)).expect("the log opens").filter(Result::is_ok).count();
        let read_s = began.elapsed().as_secs_f64();
        assert_eq!(ticks as u64, seconds * 1000);
        if with_images {
            let images = frames(&LogFile::at(&path), Default::default())
                .expect("the log opens")
                .filter(Result::is_ok)
                .count();
            assert!(images as u64 >= seconds * 1000 / TICKS_PER_FRAME);
        }
        tick_us.sort_by(f64::total_cmp);
        let at = |share: f64| tick_us[((tick_us.len() - 1) as f64 * share) as usize];
        let (rate, load) = (bytes * 1e-6 / seconds as f64, 100.0 * write_s / seconds as f64);
        let speed = seconds as f64 / read_s;
        println!(
            "{:6} | {rate:6.2} | {load:5.2} | {:.1}, {:.1}, {:.0} | {speed:.0}",
            with_images,
            at(0.5),
            at(0.99),
            at(1.0)
        );
        let _ = std::fs::remove_file(&path);
    }
}

fn write(path: &std::path::Path, seconds: u64, with_images: bool) -> (f64, Vec<f64>) {
    let header = LogHeader {
        scene_toml: String::new(),
        calibration_json: None,
        scene_name: "cost".to_string(),
        volume_sha256: None,
        volume_dimensions: [0; 3],
        dt_ns: 1_000_000,
        mode: RunMode::RealTime,
        controllers: vec!["a".to_string(), "b".to_string()],
        build: build_info::current(),
    };
    let mut log = create_run(path, &header).expect("the folder is writable");
    let mut random = Rng::with_seed(1);
    let mut total_s = 0.0;
    let mut tick_us = Vec::new();
    for tick in 0..=seconds * 1000 {
        let (latched, state) = messages(tick, &mut random);
        let image = (with_images && tick % TICKS_PER_FRAME == 1).then(|| frame(tick, &mut random));
        let began = Instant::now();
        if tick > 0 {
            log.latched(&latched).expect("there is space");
        }
        log.state(&state).expect("there is space");
        if let Some(image) = image {
            log.frame(&image).expect("there is space");
        }
        let spent = began.elapsed().as_secs_f64();
        total_s += spent;
        tick_us.push(spent * 1e6);
    }
    let began = Instant::now();
    log.finish(EndReason::Completed, &BTreeMap::new()).expect("there is space");
    (total_s + began.elapsed().as_secs_f64(), tick_us)
}

/// Numbers below 0.1 m, rad or N with random mantissas.
fn fill(values: &mut [f64], random: &mut Rng) {
    values.iter_mut().for_each(|value| *value = 0.1 * random.f64());
}

fn messages(tick: u64, random: &mut Rng) -> (Latched, State) {
    let mut state = State::zeroed();
    (state.tick, state.joint_count, state.contact_count) = (tick, 27, 10);
    state.hash = [random.u64(..), random.u64(..)];
    fill(&mut state.joint_position_rad[..27], random);
    fill(&mut state.joint_velocity_rad_per_s[..27], random);
    for pose in &mut state.t_world_link[..27] {
        fill(&mut pose.position_m, random);
        fill(&mut pose.orientation_xyzw, random);
    }
    for contact in &mut state.contacts[..10] {
        fill(&mut contact.point_m, random);
        fill(&mut contact.normal, random);
        fill(&mut contact.friction_force_n, random);
    }
    let mut latched = Latched::zeroed();
    (latched.tick, latched.controller_count) = (tick.saturating_sub(1), 2);
    for entry in &mut latched.commands[..2] {
        entry.command.sequence = tick;
        fill(&mut entry.command.tendon_force_n[..2], random);
        fill(&mut entry.command.arm_joint_position_rad, random);
    }
    (latched, state)
}

fn frame(tick: u64, random: &mut Rng) -> Vec<u8> {
    let mut frame = Frame::zeroed();
    (frame.sequence, frame.tick) = (tick / TICKS_PER_FRAME + 1, tick);
    let prefix = ImagePrefix::mono16(SIDE, SIDE, tick as f64 * 1e-3);
    let pixels: Vec<u64> = (0..SIDE * SIDE / 4).map(|_| random.u64(..) & 0x0fff_0fff_0fff_0fff).collect();
    [frame.as_bytes(), prefix.as_bytes(), pixels.as_bytes()].concat()
}
