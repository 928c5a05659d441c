//! Errors of the standard tool on the trials of a plan.

use ipc_types::scene::Scene;

use trabecula::failure::Failure;
use trabecula::plan::measure::against::{References, Run, against_reference, distance_mm, path};
use trabecula::plan::measure::trials::{HOLE_MM, PLACES, Trial, block, larger, pulls, tunnels};
use trabecula::plan::{Pull, Settings};

/// Errors and cost of pulls in free space.
pub struct Free {
    /// R.m.s. path error of the worst pull, at its worst end.
    pub worst_path_mm: f64,
    /// Distance at the end of the worst pull.
    pub end_mm: f64,
    /// Minimum over the trials of the median step time divided by the step length, µs per simulated
    /// millisecond.
    pub us_per_ms: f64,
}

fn with(settings: &Settings, trial: &Trial, is_in_bone: bool) -> Result<Scene, Failure> {
    let (mut scene, _) = trial.scene("", is_in_bone)?;
    settings.write_into(&mut scene);
    Ok(scene)
}

/// Returns the worst path error and the worst final error of the pulls, and the median cost.
///
/// # Errors
/// The physics refuses the settings.
pub fn free(settings: &Settings, pull: Pull, references: &mut References) -> Result<Free, Failure> {
    let mut worst = Free { worst_path_mm: 0.0, end_mm: 0.0, us_per_ms: f64::INFINITY };
    for trial in pulls(pull) {
        let own = against_reference(&Run::new(&with(settings, &trial, false)?, None), references)?;
        worst.worst_path_mm = larger(worst.worst_path_mm, own.worst_path_mm);
        worst.end_mm = larger(worst.end_mm, own.end_mm);
        worst.us_per_ms = worst.us_per_ms.min(own.us_per_ms);
    }
    Ok(worst)
}

/// The references of the tunnels, for each position of the voxels.
#[derive(Default)]
pub struct TunnelReferences([References; PLACES.len()]);

/// Returns the path error of the worst tunnel, r.m.s. over the positions of the voxels, mm. A single position
/// is not conclusive: by chance it can hide the error of one setting and add to that of another.
///
/// # Errors
/// The physics refuses the settings.
pub fn drilled_mm(settings: &Settings, references: &mut TunnelReferences) -> Result<f64, Failure> {
    let mut squares = tunnels().map(|_| 0.0);
    for (place, references) in PLACES.into_iter().zip(&mut references.0) {
        let block = block(place, HOLE_MM);
        for (trial, squares) in tunnels().iter().zip(&mut squares) {
            let scene = with(settings, trial, true)?;
            let own = against_reference(&Run::new(&scene, Some(block.ct())), references)?;
            *squares += own.worst_path_mm * own.worst_path_mm;
        }
    }
    Ok(squares.into_iter().fold(0.0, |worst, squares| larger(worst, (squares / PLACES.len() as f64).sqrt())))
}

/// Returns the change of a tunnel's path with the position of the voxels: the worst pair of positions,
/// r.m.s., mm.
///
/// # Errors
/// The physics refuses the settings.
pub fn grid_mm(settings: &Settings) -> Result<f64, Failure> {
    let mut worst = 0.0;
    for trial in tunnels() {
        let mut paths = Vec::new();
        for place in PLACES {
            let block = block(place, HOLE_MM);
            let scene = with(settings, &trial, true)?;
            paths.push(path(&Run::new(&scene, Some(block.ct())))?.0);
        }
        for (i, one) in paths.iter().enumerate() {
            for other in &paths[..i] {
                worst = larger(worst, distance_mm(one, other));
            }
        }
    }
    Ok(worst)
}
