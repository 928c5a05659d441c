//! The recorder's log of a schedule, in memory; the log is then cut at any byte, as by a crash, and read
//! back.

use std::collections::{BTreeMap, VecDeque};

use fastrand::Rng;
use messages::{Keyframe, Latched, Removed, SensorReading, State, Tick};
use run_log::{
    BuildInfo, EndReason, LogBytes, LogError, LogHeader, LogReader, MessageStream, ReadOptions, RunLog,
    RunMode, TickRecord, Topic,
};
use scene::Mode;
use zerocopy::IntoBytes;

use crate::plan::SchedulePlan;

/// Simulated time of a tick: a chunk of 100 ms holds four of them, so that a short run has several.
const DT_NS: u64 = 25_000_000;
/// Bytes of an MCAP file before its first record, and of a record before its body; the opcode of a chunk.
const MAGIC_BYTES: usize = 8;
const RECORD_HEADER_BYTES: usize = 9;
const CHUNK_OPCODE: u8 = 6;
/// More voxels than any schedule removes in a tick.
const VOXELS: [u32; 3] = [64, 64, 64];

/// A recorder of a run.
pub struct Recording {
    log: RunLog<Vec<u8>>,
    random: Rng,
    /// The recorder's queues.
    latched: VecDeque<Latched>,
    keyframes: VecDeque<Vec<u8>>,
    removed: VecDeque<Vec<u8>>,
    readings: VecDeque<SensorReading>,
    states: VecDeque<State>,
    /// Everything that the hub published.
    published: Vec<TickRecord>,
    input: Option<Latched>,
    voxels: Vec<u32>,
    measured: Vec<SensorReading>,
    cut: u64,
}

impl std::fmt::Debug for Recording {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "a recording of {} ticks", self.published.len())
    }
}

impl Recording {
    /// Begins the log of a plan that cuts it; `cut` seeds the position of the cut.
    ///
    /// # Errors
    /// Errors of the log.
    pub fn begin(plan: &SchedulePlan, cut: u64) -> Result<Recording, LogError> {
        let header = LogHeader {
            scene_toml: String::new(),
            calibration_json: None,
            scene_name: "schedule".to_owned(),
            volume_sha256: None,
            volume_dimensions: VOXELS,
            dt_ns: DT_NS,
            mode: if plan.mode == Mode::Lockstep { RunMode::Lockstep } else { RunMode::RealTime },
            controllers: Vec::new(),
            build: BuildInfo { version: String::new(), target: String::new(), rustc: None },
            first_tick: Tick::START,
        };
        Ok(Recording {
            log: RunLog::create(Vec::new(), &header)?,
            random: Rng::with_seed(cut),
            latched: VecDeque::new(),
            keyframes: VecDeque::new(),
            removed: VecDeque::new(),
            readings: VecDeque::new(),
            states: VecDeque::new(),
            published: Vec::new(),
            input: None,
            voxels: Vec::new(),
            measured: Vec::new(),
            cut,
        })
    }

    /// Records that the hub publishes u_k.
    pub fn latch(&mut self, latched: &Latched) {
        self.input = Some(*latched);
        self.latched.push_back(*latched);
    }

    /// Records that the hub publishes removed voxels.
    pub fn removed(&mut self, removed: &Removed, voxels: &[u32]) {
        self.voxels.extend_from_slice(voxels);
        self.removed.push_back([removed.as_bytes(), voxels.as_bytes()].concat());
    }

    /// Records that the hub publishes a reading.
    pub fn reading(&mut self, reading: &SensorReading) {
        self.measured.push(*reading);
        self.readings.push_back(*reading);
    }

    /// Records that the hub publishes x_k; the recorder may process its queues.
    ///
    /// # Errors
    /// Errors of the log.
    pub fn state(&mut self, state: &State) -> Result<(), LogError> {
        let removed = std::mem::take(&mut self.voxels);
        let readings = std::mem::take(&mut self.measured);
        if let Some(latched) = self.input.take() {
            let restored = (latched.reset != 0).then(Vec::new);
            self.published.push(TickRecord { latched, state: *state, removed, restored, readings });
        }
        self.states.push_back(*state);
        let taken = self.random.usize(..=self.states.len());
        if self.random.u8(..4) == 0 { self.take(taken) } else { Ok(()) }
    }

    /// Records that the hub publishes a part of a keyframe.
    pub fn keyframe(&mut self, keyframe: &Keyframe, part: &[u8]) {
        self.keyframes.push_back([keyframe.as_bytes(), part].concat());
    }

    /// Takes some states. Before each, like the recorder process, it takes everything that is published
    /// before states.
    fn take(&mut self, states: usize) -> Result<(), LogError> {
        for _ in 0..states {
            self.take_inputs()?;
            self.states.pop_front().map_or(Ok(()), |state| self.log.state(&state))?;
        }
        self.take_inputs()
    }

    fn take_inputs(&mut self) -> Result<(), LogError> {
        self.latched.drain(..).try_for_each(|latched| self.log.latched(&latched))?;
        self.keyframes.drain(..).try_for_each(|message| self.log.keyframe(&message))?;
        self.readings.drain(..).try_for_each(|reading| self.log.reading(&reading))?;
        self.removed.drain(..).try_for_each(|message| self.log.removed(&message))
    }

    /// Ends the log, cuts it and reads what is left: it must hold the ticks of its whole chunks as they were
    /// published, none after them, and be intact only if nothing was cut off.
    ///
    /// # Errors
    /// The violated rule.
    pub fn check_cut(mut self) -> Result<(), String> {
        let told = |error: LogError| format!("the recording: {error}");
        self.take(self.states.len()).map_err(told)?;
        let (_, bytes) = self.log.finish(EndReason::Completed, &BTreeMap::new()).map_err(told)?;
        let length = Rng::with_seed(self.cut).usize(..=bytes.len());
        let expected = last_whole_tick(&bytes, length).map_err(told)?;
        let given = ticks_of(&bytes[..length], &self.published);
        let given = given.map_err(|error| format!("cut at {length} of {} bytes: {error}", bytes.len()))?;
        let (tick, is_intact) = given.map_or((None, false), |given| (Some(given.last_tick), given.is_intact));
        if tick != expected || is_intact != (length == bytes.len() && expected.is_some()) {
            return Err(format!(
                "cut at {length} of {} bytes: last tick {tick:?}, expected {expected:?}, intact: {is_intact}",
                bytes.len()
            ));
        }
        Ok(())
    }
}

/// Contents of a log that was cut.
struct ReadBack {
    last_tick: u64,
    is_intact: bool,
}

/// Reads a log and compares its ticks with those published; `None` if it has no initial state.
fn ticks_of(bytes: &[u8], published: &[TickRecord]) -> Result<Option<ReadBack>, String> {
    let mut reader = match LogReader::open(&LogBytes::new("cut.mcap", bytes)) {
        Ok(reader) => reader,
        Err(
            LogError::NotMcap { .. }
            | LogError::NoHeader { .. }
            | LogError::NoInitialState { .. }
            | LogError::NoStates { .. },
        ) => return Ok(None),
        Err(error) => return Err(error.to_string()),
    };
    for (published, read) in published.iter().zip(reader.by_ref()) {
        let read = read.map_err(|error| error.to_string())?;
        if read != *published {
            return Err(format!("tick {} is not what was published", read.state.tick));
        }
    }
    if reader.next().is_some() {
        return Err(format!("more than the {} ticks that were published", published.len()));
    }
    Ok(Some(ReadBack {
        last_tick: reader.last_complete_tick().0,
        is_intact: reader.stream().verdict().is_intact(),
    }))
}

/// Returns the last state in the chunks of a whole log that end within its first `length` bytes.
fn last_whole_tick(bytes: &[u8], length: usize) -> Result<Option<u64>, LogError> {
    // Every record is an opcode, a length of 8 bytes and that many bytes (MCAP specification, "Records").
    let (mut at, mut chunks) = (MAGIC_BYTES, 0);
    while let Some(&[opcode, ref body @ ..]) = bytes.get(at..at + RECORD_HEADER_BYTES) {
        let body: u64 = body.iter().rev().fold(0, |sum, byte| sum << 8 | u64::from(*byte));
        at += RECORD_HEADER_BYTES + body as usize;
        if at > length {
            break;
        }
        chunks += u64::from(opcode == CHUNK_OPCODE);
    }
    let mut last = None;
    let mut stream = MessageStream::open(&LogBytes::new("whole.mcap", bytes), ReadOptions::default())?;
    while let Some(message) = stream.next_message()? {
        if message.known == Some(Topic::State) && message.chunk <= chunks {
            last = Some(message.log_time_ns / DT_NS);
        }
    }
    Ok(last)
}
