//! Measures the actual error of a run by re-running its commands with the [`Reference`]; the tip is compared
//! at sampled ticks.

use std::path::Path;
use std::time::Instant;

use ipc_types::scene::Scene;
use simulation::CtView;

use super::reference::Reference;
use crate::failure::Failure;
use crate::log::{OpenedLog, Overrides};

/// Result of the check.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelErrorCheck {
    /// Ticks compared.
    pub samples: usize,
    /// Last tick re-run.
    pub last_tick: u64,
    /// Root mean square of the tip distance, mm.
    pub rms_mm: f64,
    /// Largest tip distance, mm, and its tick.
    pub largest: (f64, u64),
    /// Tip distance at the last tick, mm.
    pub end_mm: f64,
    /// Wall time, s.
    pub wall_s: f64,
}

/// Re-runs a log up to tick `to` and compares the tip at about `samples` ticks.
///
/// # Errors
/// Bad input (2): a log that this build cannot replay, or without ticks, or that begins later than its run.
/// The reference refuses the scene (1).
pub fn check(
    log: &Path,
    overrides: &Overrides,
    samples: u64,
    to: u64,
) -> Result<(Scene, ModelErrorCheck), Failure> {
    let log = OpenedLog::open(log, overrides)?;
    log.require_start("compared")?;
    let ct = log.ct.as_ref().map(|ct| CtView::from(&ct.volume));
    let failed = Failure::failed;
    let mut reference = Reference::new(&log.scene, ct).map_err(failed)?;
    let every = log.scene.tick_count().min(to).div_ceil(samples.max(1)).max(1);
    let mut found = ModelErrorCheck {
        samples: 0,
        last_tick: 0,
        rms_mm: 0.0,
        largest: (0.0, 0),
        end_mm: 0.0,
        wall_s: 0.0,
    };
    let (began, mut squares) = (Instant::now(), 0.0);
    for record in log.reader()? {
        let record = record.map_err(Failure::failed)?;
        let tick = record.latched.tick + 1;
        if tick > to {
            break;
        }
        reference.step(&record.latched).map_err(failed)?;
        found.last_tick = tick;
        found.end_mm = reference.distance_mm(&record.state);
        if tick.is_multiple_of(every) {
            squares += found.end_mm * found.end_mm;
            found.samples += 1;
            if found.end_mm > found.largest.0 {
                found.largest = (found.end_mm, tick);
            }
        }
    }
    if found.samples == 0 {
        return Err(Failure::bad_input(format!("{}: has no complete tick to compare", log.path.display())));
    }
    found.rms_mm = (squares / found.samples as f64).sqrt();
    found.wall_s = began.elapsed().as_secs_f64();
    Ok((log.scene, found))
}
