//! `trabecula-lab chart stability`: every method over stiffness, mass, step and nine hard cases.

pub mod bone;
mod bone_cases;
mod cases;
mod figure;
pub mod random;
pub mod survey;
pub mod tools;
mod watch;

use crate::effort::Effort;
use std::fmt::Write as _;
use std::path::Path;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use ipc_types::process::EndRequest;
use nalgebra::Vector3;
use rayon::prelude::*;
use simulation::manipulator::{Integrator, ManipulatorError, ManipulatorParameters, Rung};

use crate::charts::method::Method;
use cases::{Case, Ending, Setup};
use trabecula::failure::{EXIT_INTERRUPTED, Failure};
use trabecula::output::{refuse_existing, within};
use trabecula::report::ReportError;

/// Factors applied to all stiffnesses.
pub const STIFFNESS: [f64; 4] = [1.0, 10.0, 100.0, 1000.0];
/// Factors applied to all masses.
pub const MASS: [f64; 3] = [1.0, 0.1, 0.01];
/// Steps, ms.
pub const DT_MS: [f64; 5] = [0.5, 1.0, 2.0, 5.0, 10.0];
/// A tip within this distance of the converged one counts as converged, m.
const TOLERANCE_M: f64 = 0.2e-3;
/// Largest step of the converged solutions, ms.
const REFERENCE_DT_MS: f64 = 0.25;
/// One radian of the tool's first mode (26 Hz), ms.
const FIRST_MODE_MS: f64 = 6.0;

/// Interval between progress lines.
const PROGRESS_PERIOD: Duration = Duration::from_secs(5);

/// Result of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// At rest at the position of the converged solution.
    Converged,
    /// At rest elsewhere, or not at rest.
    Wrong,
    /// Not finite, or beyond the tool's reach.
    Blown,
}

/// A cell of the map.
#[derive(Debug, Clone, Copy)]
pub struct Cell {
    /// Method measured.
    pub method: Method,
    /// Case measured.
    pub case: Case,
    /// Factor of the stiffnesses.
    pub stiffness: f64,
    /// Factor of the masses.
    pub mass: f64,
    /// Step, ms.
    pub dt_ms: f64,
    /// Result of the run.
    pub verdict: Verdict,
    /// Distance of the tip from the converged one, m.
    pub off_m: f64,
    /// Whether energy grew after the last change of load.
    pub energy_grew: bool,
}

/// Measures, writes `stability.svg`, `.png` and `.csv` into the folder, and prints the counts.
///
/// # Errors
/// A file that cannot be written.
pub fn run(folder: &Path, effort: Effort) -> Result<(), Failure> {
    let files = within(folder, &["stability.csv", "stability.png", "stability.svg"]);
    refuse_existing(&files)?;
    output_file::create_folder(folder).map_err(Failure::folder(folder))?;
    let end = EndRequest::install()
        .map_err(|cause| Failure::failed(format!("cannot install signal handlers: {cause}")))?;
    let cells = measure(effort, &end).map_err(|cause| Failure::failed(cause.to_string()))?;
    print_counts(&cells);
    let [png, svg] = figure::draw(&cells)
        .and_then(|figure| figure.files(folder, "stability"))
        .map_err(ReportError::from)?;
    output_file::write_all(&[(folder.join("stability.csv"), csv(&cells).into_bytes()), png, svg])?;
    if end.is_set() {
        let message = format!("interrupted; {} finished runs are in {}", cells.len(), folder.display());
        return Err(Failure { message, code: EXIT_INTERRUPTED });
    }
    Ok(())
}

/// The scenes' tool, frictionless on its walls, with its stops out of reach because Rapier's tool has none.
fn tool(stiffness: f64, mass: f64) -> ManipulatorParameters {
    let mut p = ManipulatorParameters::jhu_27();
    p.joint_stiffness_nm_per_rad.iter_mut().for_each(|k| *k *= stiffness);
    p.linear_density_kg_per_m *= mass;
    p.burr_mass_kg *= mass;
    p.shaft_mass_kg *= mass;
    p.joint_limit_rad = 1.0;
    p.damping_ratio = 0.1;
    p.contact.friction_coefficient = 0.0;
    p
}

/// A rung is compared with its own converged solution, a baseline with that of the planar rung.
fn reference_of(method: Method) -> Method {
    match method {
        Method::Rung(rung, _) => Method::Rung(rung, Integrator::LinearlyImplicitEuler),
        _ => Method::Rung(Rung::Planar, Integrator::LinearlyImplicitEuler),
    }
}

/// Within one radian of the first mode, whose frequency scales with the square root of stiffness over mass.
fn reference_dt_ms(stiffness: f64, mass: f64) -> f64 {
    REFERENCE_DT_MS.min(FIRST_MODE_MS / (stiffness / mass).sqrt())
}

/// One run: method, case, stiffness factor, mass factor, step in ms.
type Job = (Method, Case, f64, f64, f64);

/// Reports the number of finished runs on standard error every few seconds.
struct Progress {
    done: AtomicUsize,
    all: usize,
    began: Instant,
    said: Mutex<Instant>,
}

impl Progress {
    fn new(all: usize) -> Progress {
        Progress { done: AtomicUsize::new(0), all, began: Instant::now(), said: Mutex::new(Instant::now()) }
    }

    fn tick(&self) {
        let done = self.done.fetch_add(1, Ordering::Relaxed) + 1;
        let Ok(mut said) = self.said.try_lock() else { return };
        if said.elapsed() > PROGRESS_PERIOD {
            *said = Instant::now();
            let rest = self.began.elapsed().as_secs_f64() * (self.all - done) as f64 / done as f64;
            tell!("stability: {done} of {} runs, about {rest:.0} s left", self.all);
        }
    }
}

/// Runs all jobs on all cores. If the process is asked to end, returns the finished ones.
fn measure(effort: Effort, end: &EndRequest) -> Result<Vec<Cell>, ManipulatorError> {
    let pick =
        |all: &[f64]| if effort == Effort::Quick { vec![all[0], all[all.len() - 1]] } else { all.to_vec() };
    let (mut jobs, mut references): (Vec<Job>, Vec<Job>) = (Vec::new(), Vec::new());
    for method in Method::WITH_PROXIES {
        for case in Case::ALL {
            for &stiffness in &pick(&STIFFNESS) {
                for &mass in &pick(&MASS) {
                    let own = (reference_of(method), case, stiffness, mass, reference_dt_ms(stiffness, mass));
                    if !references.contains(&own) {
                        references.push(own);
                    }
                    jobs.extend(pick(&DT_MS).into_iter().map(|dt_ms| (method, case, stiffness, mass, dt_ms)));
                }
            }
        }
    }
    let progress = Progress::new(jobs.len() + references.len());
    let play = |(method, case, stiffness, mass, dt_ms): Job| -> Option<Result<Ending, ManipulatorError>> {
        if end.is_set() {
            return None;
        }
        let ending = case.play(method, &tool(stiffness, mass), &Setup::STANDARD, stiffness, dt_ms);
        progress.tick();
        Some(ending)
    };
    let converged: Vec<(Job, Vector3<f64>)> = references
        .par_iter()
        .filter_map(|job| play(*job).map(|ending| ending.map(|ending| (*job, ending.tip_m))))
        .collect::<Result<_, _>>()?;
    jobs.par_iter()
        .filter_map(|job| {
            let (method, case, stiffness, mass, dt_ms) = *job;
            let own = (reference_of(method), case, stiffness, mass, reference_dt_ms(stiffness, mass));
            let (_, converged) = converged.iter().find(|(other, _)| *other == own)?;
            let cell = |ending: Ending| {
                let off_m = (ending.tip_m - converged).norm();
                let (verdict, energy_grew) = (verdict(&ending, off_m), ending.energy_grew);
                Cell { method, case, stiffness, mass, dt_ms, verdict, off_m, energy_grew }
            };
            play(*job).map(|ending| ending.map(cell))
        })
        .collect()
}

fn verdict(ending: &Ending, off_m: f64) -> Verdict {
    // The tool is 71 mm long: a tip farther than this from the converged one means that the tool has come
    // apart.
    if ending.lost || !off_m.is_finite() || off_m > 0.15 {
        Verdict::Blown
    } else if off_m <= TOLERANCE_M {
        Verdict::Converged
    } else {
        Verdict::Wrong
    }
}

/// Prints the claimed cases, and where the unclaimed one is correct.
fn print_counts(cells: &[Cell]) {
    let head = ["method", "converged", "wrong", "blown", "energy grew", "2.3 x Euler's load"];
    say!("{:<20} {:>9} {:>6} {:>6} {:>12}  {}", head[0], head[1], head[2], head[3], head[4], head[5]);
    for method in Method::WITH_PROXIES {
        let (own, far): (Vec<&Cell>, Vec<&Cell>) =
            cells.iter().filter(|cell| cell.method == method).partition(|cell| cell.case.is_claimed());
        let count = |verdict| own.iter().filter(|cell| cell.verdict == verdict).count();
        let grew = own.iter().filter(|cell| cell.energy_grew).count();
        say!(
            "{:<20} {:>9} {:>6} {:>6} {:>12}  {}",
            method.name(),
            count(Verdict::Converged),
            count(Verdict::Wrong),
            count(Verdict::Blown),
            grew,
            right_steps(&far)
        );
    }
}

/// Returns how many are correct, and the step, in radians of the first mode, up to which all are.
fn right_steps(cells: &[&Cell]) -> String {
    let angle = |cell: &Cell| cell.dt_ms / FIRST_MODE_MS * (cell.stiffness / cell.mass).sqrt();
    let right = cells.iter().filter(|cell| cell.verdict == Verdict::Converged).count();
    let wrong = cells.iter().filter(|cell| cell.verdict != Verdict::Converged);
    let least = wrong.map(|cell| angle(cell)).fold(f64::INFINITY, f64::min);
    // Steps equal to that one up to rounding are not below it.
    let below = cells.iter().map(|cell| angle(cell)).filter(|own| *own < 0.999 * least).fold(0.0, f64::max);
    format!("{right} of {} right, all up to {below:.1} rad a step", cells.len())
}

fn csv(cells: &[Cell]) -> String {
    let mut text = String::from("method,case,stiffness,mass,dt_ms,verdict,off_mm,energy_grew\n");
    for cell in cells {
        // Writing to a String cannot fail.
        let _ = writeln!(
            text,
            "{},{},{},{},{},{:?},{:.6},{}",
            cell.method.name(),
            cell.case.key(),
            cell.stiffness,
            cell.mass,
            cell.dt_ms,
            cell.verdict,
            cell.off_m * 1e3,
            cell.energy_grew
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn planar_euler_converges_where_the_baselines_fail() {
        let ours = Method::Rung(Rung::Planar, Integrator::LinearlyImplicitEuler);
        for (case, stiffness, mass, dt_ms) in [
            (Case::TensionStep, 1.0, 1.0, 1.0),
            (Case::StiffWall, 100.0, 0.1, 5.0),
            (Case::FarAnatomy, 1.0, 1.0, 1.0),
            (Case::Buckling, 100.0, 0.01, 10.0),
        ] {
            let p = tool(stiffness, mass);
            let play = |method, dt_ms| {
                case.play(method, &p, &Setup::STANDARD, stiffness, dt_ms).map(|e| (verdict(&e, 0.0), e.tip_m))
            };
            let (Ok((_, converged)), Ok((_, tip))) = (play(ours, REFERENCE_DT_MS), play(ours, dt_ms)) else {
                panic!("{case:?}: a tool of the map is refused");
            };
            assert!((tip - converged).norm() < TOLERANCE_M, "{case:?}: {tip} {converged}");
            let explicit = play(Method::Explicit, dt_ms).map(|(verdict, _)| verdict);
            assert_eq!(explicit, Ok(Verdict::Blown), "{case:?}");
        }
    }
}
