//! A stand-in for the physics: only a chain of hashes, so that one wrong bit changes everything after it.

use std::cell::Cell;
use std::rc::Rc;

use messages::{ControllerIndex, Latched, PastStop, Plant, Refusal, SensorReading, State};
use zerocopy::IntoBytes;

/// Predrilled voxels: one more than two messages hold.
const PREDRILLED: usize = messages::services::MAX_REMOVED_PER_MESSAGE + 1;
/// `State.tick` of the ticks that run out of memory.
pub const UNCUT_TICKS: [u64; 2] = [9, 10];
/// Voxels for which these ticks have no memory.
pub const UNCUT: usize = 5;

/// From this `State.tick` on, the plant's model is invalid.
pub const INVALID_FROM: u64 = 6;

/// The schedule's effects on the plant, shared with it.
#[derive(Debug, Clone, Default)]
pub struct Handle {
    /// Clock, ns: a tick takes time.
    pub now_ns: Rc<Cell<u64>>,
    /// How much longer the next tick takes.
    pub slow_ns: Rc<Cell<u64>>,
    /// Whether the next tick's commands are refused.
    pub refuses: Rc<Cell<bool>>,
    /// Whether the next tick cannot be computed.
    pub fails: Rc<Cell<bool>>,
}

/// The stand-in plant.
#[derive(Debug)]
pub struct ChainPlant {
    state: State,
    removed: Vec<u32>,
    readings: Vec<SensorReading>,
    predrilled: Vec<u32>,
    refusals: Vec<Refusal>,
    handle: Handle,
}

impl ChainPlant {
    /// Creates the plant at tick 0.
    pub fn new(handle: Handle) -> ChainPlant {
        let mut state = State::zeroed();
        state.hash = [11, 22];
        ChainPlant {
            state,
            removed: Vec::new(),
            readings: Vec::new(),
            predrilled: (0..PREDRILLED as u32).collect(),
            refusals: Vec::new(),
            handle,
        }
    }
}

impl Default for ChainPlant {
    fn default() -> ChainPlant {
        ChainPlant::new(Handle::default())
    }
}

impl ChainPlant {
    /// Measures with two sensors, every seventh tick.
    fn measure(&mut self) {
        self.readings.clear();
        let tick = self.state.tick;
        if tick % 7 == 3 {
            let before = 2 * (tick / 7);
            self.readings.extend([0, 1].map(|sensor_index| SensorReading {
                tick,
                sample_tick: tick - 2,
                sequence: before + u64::from(sensor_index) + 1,
                sensor_index,
                ..SensorReading::zeroed()
            }));
        }
    }
}

impl Plant for ChainPlant {
    type Error = String;

    fn state(&self) -> &State {
        &self.state
    }

    fn step(&mut self, latched: &Latched) -> Result<(), String> {
        if latched.tick != self.state.tick {
            return Err(format!("tick {} behind {}", latched.tick, self.state.tick));
        }
        if self.handle.fails.take() {
            return Err("the plant failed".to_owned());
        }
        let clock = &self.handle.now_ns;
        clock.set(clock.get() + 30_000 + self.handle.slow_ns.take());
        self.state.tick += 1;
        if latched.reset != 0 {
            self.state.sim_time_s = 0.0;
            self.state.removed_total = 0;
        }
        self.state.sim_time_s += 1e-3;
        self.removed.clear();
        if self.state.tick % 5 == 2 {
            // One tick needs two messages.
            let count = if self.state.tick == 7 { PREDRILLED as u64 } else { 3 };
            self.removed.extend((0..count).map(|voxel| (self.state.tick * 10 + voxel) as u32));
        }
        self.state.removed_in_tick = self.removed.len() as u32;
        self.state.removed_total += self.removed.len() as u64;
        self.measure();
        self.refusals.clear();
        if self.handle.refuses.take() {
            self.refusals.push(Refusal {
                controller: ControllerIndex(0),
                sequence: latched.commands[0].command.sequence,
                reason: "cannot be reached".to_owned(),
                stopped_later: false,
            });
        }
        // FNV-1a over the words.
        let mut hash = self.state.hash[0] ^ 0xcbf2_9ce4_8422_2325;
        let state = [self.state.tick, self.state.sim_time_s.to_bits(), self.state.removed_total];
        for word in words(latched.as_bytes()).chain(state) {
            hash = (hash ^ word).wrapping_mul(0x100_0000_01b3);
        }
        self.state.hash = [hash, hash.rotate_left(17)];
        Ok(())
    }

    fn removed(&self) -> &[u32] {
        &self.removed
    }

    fn readings(&self) -> &[SensorReading] {
        &self.readings
    }

    fn predrilled(&self) -> &[u32] {
        &self.predrilled
    }

    fn refusals(&self) -> &[Refusal] {
        &self.refusals
    }

    fn uncut_voxels(&self) -> usize {
        if UNCUT_TICKS.contains(&self.state.tick) { UNCUT } else { 0 }
    }

    fn invalid_flexure(&self) -> Option<PastStop> {
        let past = PastStop { model: "chain", flexure: 2, excess_rad: 1e-3 };
        (self.state.tick >= INVALID_FROM).then_some(past)
    }

    fn write_keyframe(&self, buffer: &mut [u8]) -> Result<usize, String> {
        let words =
            [self.state.tick, self.state.hash[0], self.state.sim_time_s.to_bits(), self.state.removed_total];
        let bytes = words.as_bytes();
        buffer[..bytes.len()].copy_from_slice(bytes);
        Ok(bytes.len())
    }

    fn restore_keyframe(&mut self, keyframe: &[u8]) -> Result<(), String> {
        let words: Vec<u64> = words(keyframe).collect();
        let [tick, hash, time, removed_total] = words[..] else { return Err("not four words".to_owned()) };
        self.state.tick = tick;
        self.state.hash = [hash, hash.rotate_left(17)];
        self.state.sim_time_s = f64::from_bits(time);
        self.state.removed_total = removed_total;
        Ok(())
    }
}

fn words(bytes: &[u8]) -> impl Iterator<Item = u64> {
    bytes.chunks_exact(8).map(|word| word.iter().rev().fold(0, |sum, byte| sum << 8 | u64::from(*byte)))
}
