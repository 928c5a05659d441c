//! A synthetic run with the shape of a real one: wait, advance along an arc with the burr on, hold.

use std::collections::BTreeMap;
use std::path::Path;

use fastrand::Rng;
use ipc_types::messages::*;
use recorder_proc::build_info;
use recorder_proc::log_file::{create_run, create_timing};
use run_log::{EndReason, LogHeader, RunMode, Topic};
use zerocopy::IntoBytes;

/// The scene's text; the burr ends 2.5 mm from its target.
pub const SCENE: &str = r#"
name = "synthetic"
[run]
mode = "realtime"
duration_s = 5.0
[tolerance]
target_mm = 3.0
path_deviation_mm = 5.0
[volume]
phantom = "femur"
spacing_mm = 0.5
[tool]
burr_start_mm = [0.0, 0.0, 0.0]
direction = [0.0, 0.0, 1.0]
bend_toward = [1.0, 0.0, 0.0]
[drr]
rate_hz = 10.0
isocentre_mm = [0.0, 0.0, 0.0]
columns = 64
rows = 48
pixel_pitch_mm = 1.0
[[controller]]
name = "guide"
drives = ["tendon", "arm", "burr"]
[controller.curved_drilling]
feed_mm_per_s = 8.0
insertion_mm = 32.0
tension_n = 12.0
ramp_end_mm = 32.0
burr_speed_rpm = 30000.0
target_mm = [12.0, 0.0, 27.0]
"#;

/// Number of flexures.
const JOINTS: usize = 27;
const PITCH_M: f64 = 1.3e-3;
const SHAFT_M: f64 = 0.1;
/// Radius of the burr.
const BURR_RADIUS_M: f64 = 3e-3;
/// Ticks between frames.
const FRAME_TICKS: u64 = 100;

/// Header of both lanes, in real time.
pub fn header() -> LogHeader {
    LogHeader {
        scene_toml: SCENE.to_string(),
        calibration_json: None,
        scene_name: "synthetic".to_string(),
        volume_sha256: Some([7; 32]),
        volume_dimensions: [200, 200, 200],
        dt_ns: 1_000_000,
        mode: RunMode::RealTime,
        controllers: vec!["guide".to_string(), "watch".to_string()],
        build: build_info::current(),
        first_tick: ipc_types::messages::Tick::START,
    }
}

/// Returns the state after `tick` of `ticks` ticks. The bend grows to 0.8 rad, the tension to 12 N.
pub fn state(tick: u64, ticks: u64, random: &mut Rng) -> State {
    let mut s = State::zeroed();
    let progress = ((tick as f64 / ticks.max(1) as f64 - 0.1) / 0.8).clamp(0.0, 1.0);
    let drilling = progress > 0.0 && progress < 1.0;
    (s.tick, s.sim_time_s) = (tick, tick as f64 * 1e-3);
    s.hash = [tick, !tick];
    (s.joint_count, s.tendon_count, s.controller_count) = (JOINTS as u32, 1, 2);
    s.bend_rad = 0.8 * progress;
    s.burr_speed_rad_per_s = 3000.0;
    s.tendon_tension_n[0] = 12.0 * progress * progress;
    let noise = random.f64() - 0.5;
    s.burr_force_n = if drilling { 3.0 + (9.0 * progress).sin() + 2.0 * noise } else { 0.0 };
    s.contact_total = if drilling { 1 + (3.0 * random.f64()) as u32 } else { 0 };
    s.contact_count = s.contact_total;
    s.contacts[0].normal_force_n = 2.0 * s.burr_force_n;
    s.removed_total = (4000.0 * progress) as u64;
    s.cutting_energy_j = 25.0 * progress;
    let advance = 0.032 * progress;
    let base = advance - SHAFT_M - JOINTS as f64 * PITCH_M - BURR_RADIUS_M;
    s.t_world_base = Pose { position_m: [0.0, 0.0, base], ..Pose::IDENTITY };
    let (mut x, mut z, mut angle) = (0.0, base + SHAFT_M, 0.0f64);
    for i in 0..JOINTS {
        angle += s.bend_rad / JOINTS as f64;
        s.joint_position_rad[i] = s.bend_rad / JOINTS as f64;
        s.t_world_link[i] = Pose { position_m: [x, 0.0, z], ..Pose::IDENTITY };
        (x, z) = (x + PITCH_M * angle.sin(), z + PITCH_M * angle.cos());
    }
    s.t_world_burr = Pose { position_m: [x, 0.0, z], ..Pose::IDENTITY };
    let tip = [x + BURR_RADIUS_M * angle.sin(), 0.0, z + BURR_RADIUS_M * angle.cos()];
    s.t_world_tip = Pose { position_m: tip, ..Pose::IDENTITY };
    s
}

/// Returns the timing of a tick: usually 40 µs, occasionally long; every 997th is missed.
pub fn timing(tick: u64, random: &mut Rng) -> TickTiming {
    let mut t = TickTiming::zeroed();
    let long = if random.f64() > 0.995 { 8.0 } else { 1.0 };
    t.tick = tick;
    t.step_ns = (30e3 * long * (1.0 + random.f64() * random.f64())) as u64;
    t.wake_lateness_ns = (8e3 * long * (0.3 + random.f64())) as i64;
    t.round_trip_ns =
        [(60e3 * (1.0 + random.f64())) as u64, (15e3 * (1.0 + 2.0 * random.f64())) as u64, 0, 0];
    if tick % 997 == 996 {
        (t.missed, t.wake_lateness_ns) = (1, 2_300_000);
    }
    t
}

/// Returns a frame as sent on the wire: a gradient that gets brighter with the frame number.
pub fn frame(sequence: u64, tick: u64, columns: u32, rows: u32) -> Vec<u8> {
    let mut frame = Frame::zeroed();
    (frame.sequence, frame.tick) = (sequence, tick);
    let prefix = ImagePrefix::mono16(columns, rows, tick as f64 * 1e-3);
    let grey = |i: u32| ((i % columns) as u16).saturating_mul(256).saturating_add(sequence as u16 * 257);
    let pixels: Vec<u8> = (0..columns * rows).flat_map(|i| grey(i).to_le_bytes()).collect();
    [frame.as_bytes(), prefix.as_bytes(), &pixels].concat()
}

/// Returns an event as sent on the wire.
pub fn event(tick: u64, severity: u32, code: u32, sender: u32, text: &str) -> Vec<u8> {
    let mut event = Event::zeroed();
    (event.tick, event.severity, event.code) = (tick, severity, code);
    event.sender = sender;
    event.text_length = text.len() as u32 + 1;
    [event.as_bytes(), text.as_bytes(), b"\0"].concat()
}

/// Writes both lanes of a run of `ticks` ticks into a folder.
pub fn write_run(folder: &Path, ticks: u64) {
    write_states(folder, ticks, |_| {});
}

/// Writes a run with changed states.
pub fn write_states(folder: &Path, ticks: u64, change: impl Fn(&mut State)) {
    let changed = |tick: u64, random: &mut Rng| {
        let mut state = state(tick, ticks, random);
        change(&mut state);
        state
    };
    let mut random = Rng::with_seed(1);
    let mut run = create_run(&folder.join("run.mcap"), &header()).unwrap();
    let mut lane = create_timing(&folder.join("timing.mcap"), &header()).unwrap();
    run.state(&changed(0, &mut random)).unwrap();
    let mut frames = 0;
    for k in 0..ticks {
        let mut latched = Latched::zeroed();
        latched.tick = k;
        run.latched(&latched).unwrap();
        run.state(&changed(k + 1, &mut random)).unwrap();
        let timing = timing(k, &mut random);
        lane.message(Topic::TickTiming, Tick(k + 1), timing.as_bytes()).unwrap();
        if k % FRAME_TICKS == 0 {
            frames += 1;
            run.frame(&frame(frames, k + 1, 64, 48)).unwrap();
            let mut timing = FrameTiming::zeroed();
            (timing.frame_sequence, timing.rays) = (frames, 1000);
            (timing.render_ns, timing.full) = (5_000_000, u32::from(frames == 1));
            lane.message(Topic::FrameTiming, Tick(k + 1), timing.as_bytes()).unwrap();
        }
    }
    for i in 0..8 {
        let event = event(
            i,
            SEVERITY_WARNING,
            EVENT_COMMAND_HELD,
            SENDER_CONTROLLER + 1,
            &format!("late by {i} ticks\nagain"),
        );
        lane.message(Topic::Event, Tick(ticks), &event).unwrap();
    }
    let event = event(9, SEVERITY_INFO, EVENT_RUN, SENDER_CONTROLLER + 1, "ended");
    lane.message(Topic::Event, Tick(ticks), &event).unwrap();
    let lost = BTreeMap::from([("/event".to_string(), 3)]);
    run.finish(EndReason::Completed, &BTreeMap::new()).unwrap();
    lane.finish(EndReason::Completed, &lost).unwrap();
}
