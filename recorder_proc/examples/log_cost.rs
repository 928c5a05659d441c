//! What logging costs: bytes and processor time per simulated second, and how fast a log is read back.
//!
//! `cargo run --release -p recorder_proc --example log_cost [seconds] [folder]`
//!
//! The states are as full as those of a drilling scene: 27 flexures, 10 contacts, 2 controllers, values with random
//! mantissas. The images are noise, 512 × 512 at 15 Hz, the worst case for a compressor.
#![allow(clippy::expect_used, clippy::print_stdout, reason = "a measurement, not a part of the product")]

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Instant;

use ipc_types::messages::*;
use recorder_proc::{BuildInfo, EndReason, LogHeader, LogReader, RunLog, RunMode, frames};
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
        let ticks = LogReader::open(&path).expect("the log opens").filter(Result::is_ok).count();
        let read_s = began.elapsed().as_secs_f64();
        assert_eq!(ticks as u64, seconds * 1000);
        if with_images {
            let images =
                frames(&path, Default::default()).expect("the log opens").filter(Result::is_ok).count();
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
        build: BuildInfo::current(),
    };
    let mut log = RunLog::create_file(path, &header).expect("the folder is writable");
    let mut random = Random(1);
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

/// SplitMix64 (Steele, Lea, Flood 2014).
struct Random(u64);

impl Random {
    fn word(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// A number below 0.1 m, rad or N with a random mantissa.
    fn fill(&mut self, values: &mut [f64]) {
        values.iter_mut().for_each(|value| *value = (self.word() >> 11) as f64 * (0.1 / (1u64 << 53) as f64));
    }
}

fn messages(tick: u64, random: &mut Random) -> (Latched, State) {
    let mut state = State::zeroed();
    (state.tick, state.joint_count, state.contact_count) = (tick, 27, 10);
    state.hash = [random.word(), random.word()];
    random.fill(&mut state.joint_position_rad[..27]);
    random.fill(&mut state.joint_velocity_rad_per_s[..27]);
    for pose in &mut state.t_world_link[..27] {
        random.fill(&mut pose.position_m);
        random.fill(&mut pose.orientation_xyzw);
    }
    for contact in &mut state.contacts[..10] {
        random.fill(&mut contact.point_m);
        random.fill(&mut contact.normal);
        random.fill(&mut contact.friction_force_n);
    }
    let mut latched = Latched::zeroed();
    (latched.tick, latched.controller_count) = (tick.saturating_sub(1), 2);
    for entry in &mut latched.commands[..2] {
        entry.command.sequence = tick;
        random.fill(&mut entry.command.tendon_force_n[..2]);
        random.fill(&mut entry.command.arm_joint_position_rad);
    }
    (latched, state)
}

fn frame(tick: u64, random: &mut Random) -> Vec<u8> {
    let mut frame = Frame::zeroed();
    (frame.sequence, frame.tick) = (tick / TICKS_PER_FRAME + 1, tick);
    let prefix = ImagePrefix::mono16(SIDE, SIDE, tick as f64 * 1e-3);
    let pixels: Vec<u64> = (0..SIDE * SIDE / 4).map(|_| random.word() & 0x0fff_0fff_0fff_0fff).collect();
    [frame.as_bytes(), prefix.as_bytes(), pixels.as_bytes()].concat()
}
