//! `trabecula reproduce`: the published behaviours from low-level rules alone, as tables and pictures.

mod deviation;
mod output;
mod planar_burr;
mod rig;
mod skiving;
mod tension;
mod thrust;
mod tunnel;

pub use output::Plan;

use crate::failure::Failure;

/// A part: what it shows, and what makes it.
type Part = (&'static str, fn(&Plan) -> Result<(), Failure>);

/// The parts, in the order of their numbers.
const PARTS: [Part; 5] = [
    ("Tunnel: curved drilling in homogeneous material", tunnel::run),
    ("Skiving off denser material", skiving::run),
    ("Tip deviation: the reference rung, and perturbed parameters", deviation::run),
    ("Bend against tension", tension::run),
    ("Thrust with one set of constants", thrust::run),
];

/// Makes all parts, or the one of a number from 1 on.
///
/// # Errors
/// A file that cannot be written, or a case that is refused.
pub fn run(plan: &Plan, only: Option<usize>) -> Result<(), Failure> {
    output_file::create_folder(&plan.out)
        .map_err(|cause| Failure::failed(format!("{}: cannot be made: {cause}", plan.out.display())))?;
    for (number, (title, part)) in (1..).zip(PARTS) {
        if only.is_none_or(|only| only == number) {
            let began = std::time::Instant::now();
            say!("{number}. {title}\n");
            part(plan)?;
            say!("\n({:.0} s)\n", began.elapsed().as_secs_f64());
        }
    }
    Ok(())
}
