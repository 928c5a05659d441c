//! `trabecula-lab reproduce`: reproduces the published behaviours from low-level rules alone.

use crate::effort::Effort;
use std::path::PathBuf;

use clap::Args;

use crate::reproduce::{self, Plan};
use trabecula::failure::Failure;
/// Arguments of `reproduce`.
#[derive(Debug, Args)]
pub struct ReproduceArguments {
    /// Run one experiment: 1 tunnel, 2 skiving, 3 tip deviation, 4 bend against tension, 5 thrust, 6
    /// J-shaped tunnels.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(1..=6))]
    only: Option<u8>,
    /// Finish in seconds, with fewer cases, coarser voxels and faster feeds.
    #[arg(long)]
    quick: bool,
    /// Output folder.
    #[arg(short, long, default_value = "out/reproduce")]
    output: PathBuf,
}

/// Runs the command.
///
/// # Errors
/// A file that cannot be written (1).
pub fn run(arguments: &ReproduceArguments) -> Result<(), Failure> {
    let plan = Plan { out: arguments.output.clone(), effort: Effort::of_option(arguments.quick) };
    reproduce::run(&plan, arguments.only.map(usize::from))
}
