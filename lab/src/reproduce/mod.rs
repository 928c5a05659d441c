//! `trabecula-lab reproduce`: reproduces the published behaviours from low-level rules alone, as tables and
//! figures.

mod deviation;
mod j_shape;
mod output;
mod planar_burr;
pub mod rig;
mod skiving;
mod tension;
mod thrust;
mod tunnel;

pub use output::Plan;

use trabecula::failure::Failure;
use trabecula::output::{refuse_existing, within};

/// A part: its title, its function, and the files it writes.
type Part = (&'static str, fn(&Plan) -> Result<(), Failure>, &'static [&'static str]);

/// The parts, in numeric order.
const PARTS: [Part; 6] = [
    (
        "Tunnel: curved drilling in homogeneous material",
        tunnel::run,
        &["reproduce-1-tunnel.csv", "reproduce-1-tunnel.png", "reproduce-1-tunnel.svg"],
    ),
    (
        "Skiving off denser material",
        skiving::run,
        &[
            "reproduce-2-skiving.csv",
            "reproduce-2-skiving.png",
            "reproduce-2-skiving.svg",
            "reproduce-2-edge.csv",
            "reproduce-2-rules.csv",
            "reproduce-2-planar-burr.csv",
            "reproduce-2-planar-burr.png",
            "reproduce-2-planar-burr.svg",
        ],
    ),
    (
        "Tip deviation: the reference rung, and perturbed parameters",
        deviation::run,
        &["reproduce-3-deviation.csv"],
    ),
    (
        "Bend against tension",
        tension::run,
        &["reproduce-4-tension.csv", "reproduce-4-tension.png", "reproduce-4-tension.svg"],
    ),
    ("Thrust and torque of twist drills", thrust::run, &["reproduce-5-thrust.csv", "reproduce-5-slopes.csv"]),
    ("J-shaped tunnels of a pre-curved tube", j_shape::run, &["reproduce-6-j-shape.csv"]),
];

/// Runs all parts, or one by its number, from 1.
///
/// # Errors
/// A file that cannot be written, or a case that is refused.
pub fn run(plan: &Plan, only: Option<usize>) -> Result<(), Failure> {
    let chosen = |number: usize| only.is_none_or(|only| only == number);
    for (_, (_, _, files)) in (1..).zip(PARTS).filter(|(number, _)| chosen(*number)) {
        refuse_existing(&within(&plan.out, files))?;
    }
    output_file::create_folder(&plan.out).map_err(Failure::folder(&plan.out))?;
    for (number, (title, part, _)) in (1..).zip(PARTS) {
        if chosen(number) {
            let began = std::time::Instant::now();
            say!("{number}. {title}\n");
            part(plan)?;
            say!("\n({:.0} s)\n", began.elapsed().as_secs_f64());
        }
    }
    Ok(())
}
