//! A small deterministic simulation, and the messages of a run of it.
#![allow(
    clippy::unwrap_used,
    clippy::panic,
    missing_docs,
    dead_code,
    reason = "each test file uses a part of this"
)]

use fastrand::Rng;
use std::collections::BTreeMap;
use std::path::Path;

use messages::*;
use run_log::segments::{SegmentOptions, verify_segments};
use run_log::verify::ReplayReport;
use run_log::*;
use zerocopy::{FromBytes, IntoBytes};

/// Replays a log in one pass, up to a tick.
pub fn verify<S: Plant>(
    reader: &mut LogReader,
    make: impl Fn() -> S + Sync,
    to_tick: Option<Tick>,
) -> ReplayReport {
    let options = SegmentOptions { start: None, to_tick, threads: 1 };
    verify_segments(reader, &|| Ok(make()), &options).replay
}

pub fn header() -> LogHeader {
    LogHeader {
        scene_toml: "name = \"toy\"\n# µ-scene\n".to_string(),
        calibration_json: Some("{\"columns\": 32}".to_string()),
        scene_name: "toy".to_string(),
        volume_sha256: Some([7; 32]),
        volume_dimensions: [512, 400, 3],
        dt_ns: 1_000_000,
        mode: RunMode::RealTime,
        controllers: vec!["a".to_string(), "b-2".to_string()],
        build: BuildInfo {
            version: "0.1.0+0123456789ab".to_string(),
            target: "test".to_string(),
            rustc: None,
        },
        first_tick: Tick::START,
    }
}

/// The command of a tick: an arbitrary function of the tick.
pub fn latched(tick: u64) -> Latched {
    let mut message = Latched::zeroed();
    message.tick = tick;
    message.controller_count = 2;
    message.commands[0].source = SOURCE_FRESH;
    message.commands[0].command.sequence = tick + 1;
    message.commands[0].command.tendon_force_n = [tick as f64 * 0.1, 2.0, 0.0, 0.0];
    message
}

/// Voxels that are missing from the start, enough for two messages.
pub const PREDRILLED: [u32; 4] = [4_000_000_000, 2, 9, 1];

/// A simulation that only feeds commands back into the state, so that one wrong bit changes everything after
/// it.
pub struct Toy {
    pub state: State,
    pub removed: Vec<u32>,
    /// Tick at which a link pose is off by one unit in the last place.
    pub fault_tick: Option<u64>,
    /// Tick at which a voxel is not removed.
    pub forget_tick: Option<u64>,
    /// Tick at which the simulation fails.
    pub fail_tick: Option<u64>,
}

impl Toy {
    pub fn new() -> Toy {
        let mut state = State::zeroed();
        state.joint_count = 27;
        state.hash = [11, 22];
        state.removed_total = PREDRILLED.len() as u64;
        state.t_world_tip = Pose::IDENTITY;
        Toy { state, removed: Vec::new(), fault_tick: None, forget_tick: None, fail_tick: None }
    }
}

impl Plant for Toy {
    type Error = String;

    fn state(&self) -> &State {
        &self.state
    }
    fn step(&mut self, latched: &Latched) -> Result<(), String> {
        if self.fail_tick == Some(latched.tick + 1) {
            return Err("the toy is broken".to_string());
        }
        if latched.reset != 0 {
            let (tick, hash) = (self.state.tick, self.state.hash);
            self.state = Toy::new().state;
            (self.state.tick, self.state.hash) = (tick, hash);
        }
        let s = &mut self.state;
        s.tick += 1;
        s.sim_time_s = s.tick as f64 * 1e-3;
        let force = latched.commands[0].command.tendon_force_n[0];
        for i in 0..27 {
            s.joint_position_rad[i] = 0.99 * s.joint_position_rad[i] + 1e-3 * force * (i as f64 + 1.0);
            s.t_world_link[i].position_m = [s.joint_position_rad[i], 0.25, -(i as f64)];
        }
        if self.fault_tick == Some(s.tick) {
            let x = &mut s.t_world_link[7].position_m[2];
            *x = f64::from_bits(x.to_bits() + 1);
        }
        self.removed.clear();
        if s.tick % 7 == 3 {
            let count = if self.forget_tick == Some(s.tick) { 4 } else { 5 };
            self.removed.extend((0..count).map(|i| (s.tick * 100 + i) as u32));
        }
        s.removed_in_tick = self.removed.len() as u32;
        s.removed_total += u64::from(s.removed_in_tick);
        s.hash = [0; 2];
        let mut h = self.state.hash[0] ^ 0xcbf2_9ce4_8422_2325;
        for byte in latched.as_bytes().iter().chain(self.state.as_bytes()).chain(self.removed.as_bytes()) {
            h = (h ^ u64::from(*byte)).wrapping_mul(0x100_0000_01b3);
        }
        self.state.hash = [h, h.rotate_left(17)];
        Ok(())
    }
    fn removed(&self) -> &[u32] {
        &self.removed
    }
    fn predrilled(&self) -> &[u32] {
        &PREDRILLED
    }
    fn refusals(&self) -> &[Refusal] {
        &[]
    }
    fn write_keyframe(&self, buffer: &mut [u8]) -> Result<usize, String> {
        let bytes = self.state.as_bytes();
        buffer[..bytes.len()].copy_from_slice(bytes);
        Ok(bytes.len())
    }
    fn restore_keyframe(&mut self, keyframe: &[u8]) -> Result<(), String> {
        assert!(!keyframe.starts_with(b"panic"), "somebody altered this keyframe");
        self.state = State::read_from_bytes(keyframe).map_err(|_| "no state".to_string())?;
        Ok(())
    }
}

const PART: usize = 1000;

/// The keyframe messages of a state, after `sequence` earlier ones.
pub fn keyframe_parts(state: &State, sequence: u64, bytes: &[u8]) -> Vec<Vec<u8>> {
    let part = |(index, part): (usize, &[u8])| {
        let head = Keyframe {
            tick: state.tick,
            hash: state.hash,
            sequence: sequence + index as u64 + 1,
            total_bytes: bytes.len() as u32,
            offset_bytes: (index * PART) as u32,
            reserved: 0,
            data_length: part.len() as u32,
        };
        [head.as_bytes(), part].concat()
    };
    bytes.chunks(PART).enumerate().map(part).collect()
}

pub fn removed_bytes(tick: u64, sequence: u64, total: u64, voxels: &[u32]) -> Vec<u8> {
    let mut message = Removed::zeroed();
    message.tick = tick;
    message.sequence = sequence;
    message.removed_total = total;
    message.voxel_index_length = voxels.len() as u32;
    [message.as_bytes(), voxels.as_bytes()].concat()
}

pub fn frame_bytes(sequence: u64, tick: u64, columns: u32, rows: u32) -> Vec<u8> {
    let mut frame = Frame::zeroed();
    frame.sequence = sequence;
    frame.tick = tick;
    frame.sim_time_s = tick as f64 * 1e-3;
    frame.geometry.columns = columns;
    frame.geometry.rows = rows;
    let mut random = Rng::with_seed(sequence);
    let pixels: Vec<u8> = (0..columns * rows * 2).map(|_| random.u8(..)).collect();
    let prefix = ImagePrefix::mono16(columns, rows, frame.sim_time_s);
    [frame.as_bytes(), prefix.as_bytes(), &pixels].concat()
}

/// One message for the writer.
#[derive(Clone)]
pub enum Step {
    Latched(Box<Latched>),
    Removed(Vec<u8>),
    State(Box<State>),
    Reply(Box<DrrReply>),
    Frame(Vec<u8>),
}

/// The messages of a run in the order in which the physics sends them: a frame every 40 ticks, and a reset if
/// requested.
pub fn run_messages(ticks: u64, reset_at: Option<u64>) -> Vec<Step> {
    let mut toy = Toy::new();
    let (mut steps, mut sequence, mut frames) = (Vec::new(), 0, 0);
    let mut removal = |steps: &mut Vec<Step>, tick: u64, total: u64, voxels: &[u32], restore: bool| {
        sequence += 1;
        let mut bytes = removed_bytes(tick, sequence, total, voxels);
        bytes[24] = u8::from(restore);
        steps.push(Step::Removed(bytes));
    };
    removal(&mut steps, 0, 3, &PREDRILLED[..3], false);
    removal(&mut steps, 0, 4, &PREDRILLED[3..], false);
    steps.push(Step::State(Box::new(toy.state)));
    for k in 0..ticks {
        let tick = k + 1;
        let mut u = latched(k);
        u.reset = u32::from(reset_at == Some(k));
        toy.step(&u).unwrap();
        steps.push(Step::Latched(Box::new(u)));
        if u.reset == 1 {
            removal(&mut steps, tick, 3, &PREDRILLED[..3], true);
            removal(&mut steps, tick, 4, &PREDRILLED[3..], false);
        }
        if !toy.removed.is_empty() {
            removal(&mut steps, tick, toy.state.removed_total, &toy.removed, false);
        }
        steps.push(Step::State(Box::new(toy.state)));
        if k % 40 == 20 {
            frames += 1;
            let mut reply = DrrReply::zeroed();
            reply.frame_sequence = frames;
            reply.tick = tick;
            steps.push(Step::Reply(Box::new(reply)));
            steps.push(Step::Frame(frame_bytes(frames, tick, 32, 20)));
        }
    }
    steps
}

pub fn feed<W: std::io::Write>(log: &mut RunLog<W>, steps: &[Step]) -> Result<(), LogError> {
    for step in steps {
        match step {
            Step::Latched(m) => log.latched(m)?,
            Step::Removed(m) => log.removed(m)?,
            Step::State(m) => log.state(m)?,
            Step::Reply(m) => log.drr_reply(m)?,
            Step::Frame(m) => log.frame(m)?,
        }
    }
    Ok(())
}

pub fn write_log(steps: &[Step]) -> Vec<u8> {
    let mut log = RunLog::create(Vec::new(), &header()).unwrap();
    feed(&mut log, steps).unwrap();
    log.finish(EndReason::Completed, &BTreeMap::new()).unwrap().1
}

/// Feeds messages to a log, with a keyframe after each state for which `keyframe` returns its bytes.
pub fn feed_with_keyframes<W: std::io::Write>(
    log: &mut RunLog<W>,
    steps: &[Step],
    keyframe: impl Fn(&State) -> Option<Vec<u8>>,
) {
    let mut sequence = 0;
    for step in steps {
        feed(log, std::slice::from_ref(step)).unwrap();
        let Step::State(state) = step else { continue };
        let Some(bytes) = keyframe(state) else { continue };
        for part in keyframe_parts(state, sequence, &bytes) {
            sequence += 1;
            log.keyframe(&part).unwrap();
        }
    }
}

pub fn stream(bytes: &[u8], options: ReadOptions) -> Result<MessageStream, LogError> {
    let source = Box::new(std::io::Cursor::new(bytes.to_vec()));
    MessageStream::from_reader(source, Path::new("test.mcap"), options)
}

pub fn open_bytes(bytes: &[u8]) -> Result<LogReader, LogError> {
    LogReader::from_stream(stream(bytes, ReadOptions::default())?)
}

/// Removes the checksums inside the metadata records, as in logs of earlier builds, so that a test can edit
/// them without causing damage.
pub fn unsealed(mut bytes: Vec<u8>) -> Vec<u8> {
    let key = b"\x05\0\0\0crc32";
    let places: Vec<usize> =
        (0..bytes.len() - key.len()).filter(|at| bytes[*at..].starts_with(key)).collect();
    places.iter().for_each(|at| bytes[at + 4] = b'x');
    bytes
}

/// A named log in memory.
pub fn named(name: &str, bytes: &[u8]) -> LogBytes {
    LogBytes::new(name, bytes)
}
