//! The removed voxels of a log.

use crate::failure::Failure;
use inputs::log::OpenedLog;
use run_log::{SavedState, Verdict};

/// The voxels removed by a tick, including pilot holes.
#[derive(Debug)]
pub struct RemovedBone {
    /// The requested tick, or the log's last.
    pub tick: u64,
    /// The voxels.
    pub voxels: Vec<u32>,
    /// The log's verdict; intact if the requested tick was reached.
    pub verdict: Verdict,
}

impl RemovedBone {
    /// Reads the removed voxels from a log, up to a tick.
    ///
    /// # Errors
    /// The log ends before the tick (2), or cannot be read that far.
    pub fn of(log: &OpenedLog, tick: Option<u64>) -> Result<RemovedBone, Failure> {
        let mut reader = log.reader()?;
        let wanted = tick.unwrap_or(u64::MAX);
        let first = reader.initial().tick;
        if wanted < first {
            return Err(Failure::bad_input(format!("tick {wanted} is before the log's first, {first}")));
        }
        let voxels = match reader.beginning() {
            None => reader.predrilled().to_vec(),
            Some(keyframe) => gone_at(log, keyframe)?.1,
        };
        let mut gone = RemovedBone { tick: first, voxels, verdict: Verdict::default() };
        for record in reader.by_ref() {
            let record = record.map_err(Failure::failed)?;
            if record.state.tick > wanted {
                break;
            }
            if let Some(restored) = record.restored {
                gone.voxels = restored;
            }
            gone.voxels.extend(record.removed);
            gone.tick = record.state.tick;
        }
        let last = gone.tick;
        if tick.is_some_and(|tick| tick > last) {
            return Err(Failure::bad_input(format!(
                "tick {wanted} is past the end of the log at tick {last}"
            )));
        }
        if tick.is_none() {
            gone.verdict = reader.stream().verdict();
        }
        Ok(gone)
    }
}

/// Returns the predrilled voxels, and all voxels removed by the time of a keyframe.
pub(super) fn gone_at(log: &OpenedLog, keyframe: &SavedState) -> Result<(Vec<u32>, Vec<u32>), Failure> {
    let mut simulation = log.simulation().map_err(Failure::failed)?;
    let predrilled = simulation.predrilled().to_vec();
    simulation.restore_keyframe(&keyframe.bytes).map_err(Failure::failed)?;
    Ok((predrilled, simulation.gone()))
}
