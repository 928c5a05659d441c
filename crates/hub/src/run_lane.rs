//! One tick of the run lane: its step, and the order of publication.
//!
//! ```text
//! publish u_k
//! x_{k+1} := step(x_k, u_k)
//! publish the voxels that it removed, the sensors' readings that arrive with x_{k+1}, then x_{k+1}
//! if due, publish the keyframe of x_{k+1}
//! ```
//!
//! Real processes, replays and the hub's schedules all publish through [`RunLane`], so a log and its replay
//! agree byte for byte.

use messages::services::{KEYFRAME_PART_BYTES, MAX_KEYFRAME_BYTES, MAX_REMOVED_PER_MESSAGE};
use messages::{Keyframe, Latched, Plant, Removed, Reset, Restores, State, Tick};
use thiserror::Error;

use crate::environment::Outputs;

/// Why a tick of the run lane failed.
#[derive(Debug, Error)]
pub enum LaneError<O, P> {
    /// The plant rejected it.
    #[error("{0}")]
    Plant(P),
    /// A message could not be sent.
    #[error("{0}")]
    Output(O),
}

/// Result of a lane with these outputs and this plant.
type Outcome<O, P> = Result<(), LaneError<<O as Outputs>::Error, <P as Plant>::Error>>;

/// When each phase of a tick ended, on the outputs' clock.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct TickMarks {
    /// u_k was published.
    pub latched_ns: u64,
    /// The plant had stepped.
    pub stepped_ns: u64,
    /// Everything was published.
    pub published_ns: u64,
}

/// Voxels that a tick removed, for one message.
struct RemovedInTick<'v> {
    tick: Tick,
    /// Voxels drilled since the start or the last reset, these included.
    total: u64,
    restores: Restores,
    /// Linear indices.
    voxels: &'v [u32],
}

/// The run lane of one run: its sequence numbers and when keyframes are due.
#[derive(Debug)]
pub struct RunLane {
    removed_messages: u64,
    keyframe_parts: u64,
    keyframe_period_ticks: Option<u64>,
    /// Empty if the lane has no keyframes.
    buffer: Vec<u8>,
}

impl RunLane {
    /// Creates a lane with a keyframe every `keyframe_period_ticks` ticks, or without keyframes.
    pub fn new(keyframe_period_ticks: Option<u64>) -> RunLane {
        let buffer = vec![0; if keyframe_period_ticks.is_some() { MAX_KEYFRAME_BYTES } else { 0 }];
        RunLane { removed_messages: 0, keyframe_parts: 0, keyframe_period_ticks, buffer }
    }

    /// Creates a lane whose caller decides when a keyframe is due: a replay follows its log.
    pub fn with_keyframes_on_demand() -> RunLane {
        RunLane { buffer: vec![0; MAX_KEYFRAME_BYTES], ..RunLane::new(None) }
    }

    /// Returns the number of `Removed` messages sent so far.
    pub fn removed_messages(&self) -> u64 {
        self.removed_messages
    }

    /// Publishes x_0 and the predrilled voxels, in as many messages of tick 0 as they need.
    ///
    /// # Errors
    /// [`LaneError::Output`].
    pub fn begin<P: Plant, O: Outputs>(&mut self, plant: &P, out: &mut O) -> Outcome<O, P> {
        for voxels in plant.predrilled().chunks(MAX_REMOVED_PER_MESSAGE) {
            let since = RemovedInTick { tick: Tick::START, total: 0, restores: Restores::Nothing, voxels };
            self.send_removed(since, out).map_err(LaneError::Output)?;
        }
        self.send_with_readings(plant, out).map_err(LaneError::Output)
    }

    /// Executes a tick and publishes everything except its keyframe. `now_ns` reads the caller's clock, for
    /// the tick's timing.
    ///
    /// # Errors
    /// Any [`LaneError`]; the tick is then lost and the plant unusable.
    pub fn tick<P: Plant, O: Outputs>(
        &mut self,
        plant: &mut P,
        latched: &Latched,
        out: &mut O,
        now_ns: impl Fn(&O) -> u64,
    ) -> Result<TickMarks, LaneError<O::Error, P::Error>> {
        out.send_latched(latched).map_err(LaneError::Output)?;
        let latched_ns = now_ns(out);
        plant.step(latched).map_err(LaneError::Plant)?;
        let stepped_ns = now_ns(out);
        let (state, removed) = (plant.state(), plant.removed());
        self.send_tick_removals(latched, state, removed, out).map_err(LaneError::Output)?;
        self.send_with_readings(plant, out).map_err(LaneError::Output)?;
        Ok(TickMarks { latched_ns, stepped_ns, published_ns: now_ns(out) })
    }

    /// Publishes the keyframe of the current state if one is due.
    ///
    /// # Errors
    /// [`LaneError::Plant`] if the state does not fit into a keyframe; nothing has changed.
    pub fn keyframe_if_due<P: Plant, O: Outputs>(&mut self, plant: &P, out: &mut O) -> Outcome<O, P> {
        match self.keyframe_period_ticks {
            Some(period) if plant.state().tick.is_multiple_of(period) => self.keyframe(plant, out),
            _ => Ok(()),
        }
    }

    /// Publishes the keyframe of the current state.
    ///
    /// # Errors
    /// As [`RunLane::keyframe_if_due`].
    pub fn keyframe<P: Plant, O: Outputs>(&mut self, plant: &P, out: &mut O) -> Outcome<O, P> {
        let length = plant.write_keyframe(&mut self.buffer).map_err(LaneError::Plant)?;
        let state = plant.state();
        for (index, part) in self.buffer[..length].chunks(KEYFRAME_PART_BYTES).enumerate() {
            self.keyframe_parts += 1;
            let head = Keyframe {
                tick: state.tick,
                hash: state.hash,
                sequence: self.keyframe_parts,
                total_bytes: length as u32,
                offset_bytes: (index * KEYFRAME_PART_BYTES) as u32,
                reserved: 0,
                data_length: part.len() as u32,
            };
            out.send_keyframe(&head, part).map_err(LaneError::Output)?;
        }
        Ok(())
    }

    /// Publishes the present state, preceded by the readings and the Jacobian that belong to it, so that a
    /// reader of the state finds them.
    fn send_with_readings<P: Plant, O: Outputs>(&self, plant: &P, out: &mut O) -> Result<(), O::Error> {
        plant.readings().iter().try_for_each(|reading| out.send_reading(reading))?;
        out.send_tip_jacobian(|| plant.tip_jacobian())?;
        out.send_state(plant.state())
    }

    /// Publishes what a tick removed, in as many messages as needed; their totals rise to the state's.
    fn send_tick_removals<O: Outputs>(
        &mut self,
        latched: &Latched,
        state: &State,
        removed: &[u32],
        out: &mut O,
    ) -> Result<(), O::Error> {
        let tick = Tick(state.tick);
        let mut total = state.removed_total.saturating_sub(removed.len() as u64);
        let mut restores = Restores::Nothing;
        if latched.reset() == Reset::Yes {
            restores = Restores::Drilled;
            if removed.is_empty() {
                return self.send_removed(RemovedInTick { tick, total, restores, voxels: removed }, out);
            }
        }
        for voxels in removed.chunks(MAX_REMOVED_PER_MESSAGE) {
            total += voxels.len() as u64;
            self.send_removed(RemovedInTick { tick, total, restores, voxels }, out)?;
            restores = Restores::Nothing;
        }
        Ok(())
    }

    fn send_removed<O: Outputs>(&mut self, removed: RemovedInTick<'_>, out: &mut O) -> Result<(), O::Error> {
        self.removed_messages += 1;
        let head = Removed {
            tick: removed.tick.0,
            sequence: self.removed_messages,
            removed_total: removed.total,
            restore_first: removed.restores.code(),
            voxel_index_length: removed.voxels.len() as u32,
        };
        out.send_removed(&head, removed.voxels)
    }
}
