//! Measures a part of the table of a scene's own tool.
//!
//! A unit of work is a case at one time step: the reference is run once for it, and every setting next to it.
//! Units are independent, so the number of threads does not affect any result.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::channel;

use ipc_types::scene::Scene;
use nalgebra::Vector3;
use simulation::manipulator::Rung;

use super::candidates;
use super::cases::{Case, CaseGroup, cases};
use super::tool::OwnTool;
use crate::failure::Failure;
use crate::plan::measure::against::{ComparisonError, References, Run, against_reference, distance_mm};
use crate::plan::measure::block::Block;
use crate::plan::measure::trials::{block, larger};
use crate::plan::table::{Row, Settings};

/// Largest number of threads: each holds a block of bone.
const MOST_THREADS: usize = 16;
/// Samples of the burr in the last tenth of a second, in which a tool at rest no longer moves.
const LAST_SAMPLES: usize = 10;
/// Largest fraction of its travel that a tool at rest still moves then.
const SWINGING_SHARE: f64 = 0.1;
/// Motion below this counts as rest, mm.
const STILL_MM: f64 = 0.05;

/// A unit of work.
struct Piece<'a> {
    case: &'a Case,
    number: usize,
    settings: Vec<Settings>,
}

/// Errors of the settings of a unit; NaN where the tool was lost.
struct Found {
    number: usize,
    off: Vec<(Settings, Off)>,
    /// Why the reference gave no result.
    lost: Option<String>,
}

struct Off {
    path_mm: f64,
    end_mm: f64,
    burr_m: Vec<Vector3<f64>>,
}

/// Measures a part for these settings, and calls `tell` with the numbers of finished and of all units.
///
/// # Errors
/// Bad input: the reference refuses or loses the tool, or the tool does not come to rest.
pub fn measure(
    tool: &OwnTool,
    part: CaseGroup,
    settings: &[Settings],
    mut tell: impl FnMut(usize, usize),
) -> Result<Vec<Row>, Failure> {
    let (cases, flexures) = (cases(tool, part)?, tool.flexures()?);
    let pieces = pieces(&cases, settings, flexures);
    let (mut all, mut failed) = (Vec::new(), None);
    tell(0, pieces.len());
    in_threads(tool, &pieces, |found| {
        match found {
            Ok(found) => all.push(found),
            Err(cause) => failed = failed.take().or(Some(cause)),
        }
        tell(all.len(), pieces.len());
    });
    if let Some(cause) = failed {
        return Err(cause);
    }
    // The result must not depend on the order in which threads end.
    all.sort_by_key(|found| found.number);
    let rows: Vec<Row> = settings.iter().map(|settings| row(settings, part, &cases, &all)).collect();
    let path_mm = |row: &Row| if part == CaseGroup::Bone { row.drilled_path_mm } else { row.free_path_mm };
    if part != CaseGroup::Hard && rows.iter().all(|row| !path_mm(row).is_finite()) {
        let lost = all.iter().find_map(|found| found.lost.clone());
        return Err(refusal(tool, &lost.unwrap_or_else(|| "all settings lose it".to_owned())));
    }
    Ok(rows)
}

fn refusal(tool: &OwnTool, cause: &str) -> Failure {
    Failure::bad_input(format!(
        "tool `{}`: its errors cannot be measured: {cause} (remove `tolerance.tip_mm` and \
         `tolerance.path_mm`, and set `model`, `links`, `integrator` and `dt_ms` instead)",
        tool.name
    ))
}

/// Every case at every time step, the smallest steps first: they take longest.
fn pieces<'a>(cases: &'a [Case], settings: &[Settings], flexures: usize) -> Vec<Piece<'a>> {
    let mut steps: Vec<f64> = settings.iter().map(|settings| settings.dt_ms).collect();
    steps.sort_by(f64::total_cmp);
    steps.dedup();
    let mut pieces = Vec::new();
    for dt_ms in steps {
        for (number, case) in cases.iter().enumerate() {
            let is_for = |settings: &&Settings| {
                settings.dt_ms == dt_ms
                    && (!case.is_across || settings.rung >= Rung::Spatial)
                    && (case.place.is_none() || candidates::is_drilled(settings, flexures))
            };
            let settings: Vec<Settings> = settings.iter().filter(is_for).copied().collect();
            if !settings.is_empty() {
                pieces.push(Piece { case, number, settings });
            }
        }
    }
    pieces
}

fn in_threads(tool: &OwnTool, pieces: &[Piece], mut each: impl FnMut(Result<Found, Failure>)) {
    let threads = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
    let (next, (send, found)) = (AtomicUsize::new(0), channel());
    std::thread::scope(|scope| {
        for number in 0..threads.min(MOST_THREADS).min(pieces.len()) {
            let (of_thread, next) = (send.clone(), &next);
            let work = move || {
                while let Some(piece) = pieces.get(next.fetch_add(1, Ordering::Relaxed)) {
                    let found = compared(tool, piece);
                    if found.is_err() {
                        next.store(pieces.len(), Ordering::Relaxed);
                    }
                    if of_thread.send(found).is_err() {
                        return;
                    }
                }
            };
            let thread = std::thread::Builder::new().name(format!("plan-{number}"));
            if let Err(cause) = thread.spawn_scoped(scope, work) {
                // Fewer threads take longer, and find the same.
                if number == 0 {
                    each(Err(Failure::failed(format!("no thread can be started: {cause}"))));
                }
                break;
            }
        }
        drop(send);
        found.iter().for_each(&mut each);
    });
}

fn compared(tool: &OwnTool, piece: &Piece) -> Result<Found, Failure> {
    let case = piece.case;
    let hole_mm = tool.hole_mm();
    let bone = case.place.map(|place| block(place, hole_mm));
    let mut found = Found { number: piece.number, off: Vec::new(), lost: None };
    let mut references = References::default();
    for settings in &piece.settings {
        let scene = scene(tool, case, settings)?;
        let ct = bone.as_ref().map(Block::ct);
        let run = Run { scene: &scene, ct, tensions_n: case.trial.tensions_n };
        let off = match against_reference(&run, &mut references) {
            Ok(compared) => {
                if case.is_held && !comes_to_rest(&compared.reference_m) {
                    return Err(refusal(
                        tool,
                        &format!("it still swings after {} s", round(case.trial.seconds)),
                    ));
                }
                Off { path_mm: compared.worst_path_mm, end_mm: compared.end_mm, burr_m: compared.burr_m }
            }
            Err(cause) => {
                if let ComparisonError::Reference(cause) = cause {
                    found.lost = Some(cause);
                }
                Off { path_mm: f64::NAN, end_mm: f64::NAN, burr_m: Vec::new() }
            }
        };
        found.off.push((*settings, off));
    }
    Ok(found)
}

fn round(seconds: f64) -> f64 {
    (10.0 * seconds).round() / 10.0
}

fn scene(tool: &OwnTool, case: &Case, settings: &Settings) -> Result<Scene, Failure> {
    let mut scene = tool.scene(&case.trial, case.place.is_some())?;
    scene.gravity_m_per_s2 = case.gravity_m_per_s2;
    scene.body.extend(case.wall.map(|wall| wall.body(tool.burr_radius_mm())));
    settings.write_into(&mut scene);
    Ok(scene)
}

/// Whether the reference's burr has come to rest. Only then do the measured errors hold for runs longer than
/// the trials.
fn comes_to_rest(burr_m: &[Vector3<f64>]) -> bool {
    let [first, .., last] = burr_m else { return false };
    let farthest_mm = |from: &Vector3<f64>, places: &[Vector3<f64>]| {
        places.iter().map(|place| 1e3 * (place - from).norm()).fold(0.0, f64::max)
    };
    let tail = &burr_m[burr_m.len().saturating_sub(LAST_SAMPLES)..];
    farthest_mm(last, tail) <= (SWINGING_SHARE * farthest_mm(first, burr_m)).max(STILL_MM)
}

fn row(settings: &Settings, part: CaseGroup, cases: &[Case], all: &[Found]) -> Row {
    let of: Vec<(&Case, &Off)> = all
        .iter()
        .flat_map(|found| found.off.iter().map(|(settings, off)| (&cases[found.number], settings, off)))
        .filter(|(_, measured, _)| *measured == settings)
        .map(|(case, _, off)| (case, off))
        .collect();
    let worst = |error: fn(&Off) -> f64| match &of[..] {
        [] => f64::NAN,
        of => of.iter().fold(0.0, |worst, (_, off)| larger(worst, error(off))),
    };
    let (path_mm, end_mm) = (worst(|off| off.path_mm), worst(|off| off.end_mm));
    let row = Row::unmeasured(*settings);
    match part {
        CaseGroup::Gentle | CaseGroup::Bodies => Row { rest_mm: end_mm, free_path_mm: path_mm, ..row },
        CaseGroup::Hard => Row { hard_rest_mm: end_mm, hard_path_mm: path_mm, ..row },
        CaseGroup::Bone => Row { drilled_path_mm: path_mm, grid_path_mm: grid_mm(&of), ..row },
    }
}

/// Path difference of a tunnel between voxel grid offsets: the worst pair, r.m.s., mm.
fn grid_mm(of: &[(&Case, &Off)]) -> f64 {
    let mut worst = if of.is_empty() { f64::NAN } else { 0.0 };
    for (number, (case, one)) in of.iter().enumerate() {
        for (_, other) in of[..number].iter().filter(|(other, _)| other.trial == case.trial) {
            worst = larger(worst, distance_mm(&one.burr_m, &other.burr_m));
        }
    }
    worst
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tool_rests_when_its_last_tenth_of_a_second_moves_little_beside_its_way() {
        let swing = |decay: f64| -> Vec<Vector3<f64>> {
            (0..80)
                .map(|i| Vector3::x() * 1e-2 * (1.0 - (-decay * f64::from(i)).exp() * f64::from(i).cos()))
                .collect()
        };
        assert!(comes_to_rest(&swing(0.05)) && !comes_to_rest(&swing(0.005)));
        assert!(!comes_to_rest(&[]) && comes_to_rest(&[Vector3::x(); 2]));
    }
}
