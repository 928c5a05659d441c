//! Runs a point of a sweep in this process: the physics, the scene's built-in controllers, and the X-ray
//! frames that they use.

use std::path::PathBuf;
use std::sync::Arc;

use run_log::hash_text;
use sim::{Drive, SharedScene, Sim, SimError};

use super::row::{Ending, Row};
use crate::failure::Failure;
use crate::report::anatomy::Anatomy;
use crate::report::course::Course;

/// Number of ticks between checks whether the sweep is to end.
const LOOK_TICKS: u64 = 64;

/// Result of running a point.
pub enum PointOutcome {
    /// The run has ended and has a row.
    Ended(Box<Row>),
    /// The sweep was asked to end.
    Interrupted,
}

/// Runs a scene to its end and fills the row in. `recorded` is the folder for its log.
///
/// # Errors
/// Machine errors: out of memory, no thread, an unwritable log. They yield no row, because a row must not
/// depend on the machine.
pub fn run(
    shared: &Arc<SharedScene>,
    mut row: Row,
    recorded: Option<PathBuf>,
    is_to_end: &dyn Fn() -> bool,
) -> Result<PointOutcome, Failure> {
    let mut course = Course::of(shared.scene(), shared.volume().map(|volume| volume.spacing_m));
    match follow(shared, &mut course, recorded, is_to_end) {
        Ok(true) => row.outcome = Ending::Completed,
        Ok(false) => return Ok(PointOutcome::Interrupted),
        Err(error) if error.is_of_the_machine() => {
            return Err(Failure::failed(format!("point {}: {error}", row.point)));
        }
        Err(error) => {
            row.outcome = match &error {
                SimError::Physics { .. } => Ending::SimulationFailed,
                _ => Ending::Failed,
            };
            row.reason = Some(error.to_string());
        }
    }
    row.ticks = course.ticks;
    row.simulated_s = (course.ticks * shared.scene().dt_ns()) as f64 * 1e-9;
    row.final_hash = course.last.as_ref().map(|state| hash_text(state.hash));
    (row.tool, row.drilling) = (course.tool(), course.drilling());
    row.plan = course.last.as_ref().map(|_| course.plan());
    row.breaches = course.breach_count;
    row.structures = course.clearances.summaries().to_vec();
    Ok(PointOutcome::Ended(Box::new(row)))
}

/// Steps the run; returns whether it reached its end.
fn follow(
    shared: &Arc<SharedScene>,
    course: &mut Course,
    recorded: Option<PathBuf>,
    is_to_end: &dyn Fn() -> bool,
) -> Result<bool, SimError> {
    let mut sim = Sim::new(shared, &Drive::Nothing)?;
    if let Some(folder) = recorded {
        sim.record(&folder)?;
    }
    course.add(sim.state());
    sim.readings().iter().for_each(|reading| course.clearances.add(reading));
    for tick in 0..shared.scene().tick_count() {
        if tick % LOOK_TICKS == 0 && is_to_end() {
            return Ok(false);
        }
        sim.step(&[], 1)?;
        course.add(sim.state());
        course.note_breach(sim.breach());
        sim.readings().iter().for_each(|reading| course.clearances.add(reading));
    }
    if let Some(anatomy) = Anatomy::of(shared.scene(), shared.ct().map(|ct| &ct.volume)) {
        course.note_drilled(&anatomy, sim.drilled());
    }
    sim.close_recording()?;
    Ok(true)
}
