//! `trabecula chart`: measured figures as SVG, PNG and CSV.

use std::path::PathBuf;

use clap::{Args, Subcommand};

use crate::charts::{physics, stability};
use crate::failure::Failure;

/// What to measure.
#[derive(Debug, Subcommand)]
pub enum ChartCommand {
    /// Physics: error against cost for every rung, integrator and baseline.
    Physics(ChartArguments),
    /// Where each method converges, is wrong or blows up.
    Stability(ChartArguments),
}

/// Where to, and how much.
#[derive(Debug, Args)]
pub struct ChartArguments {
    /// Folder of the files.
    #[arg(long, default_value = "out/charts")]
    out: PathBuf,
    /// A few points only, in seconds.
    #[arg(long)]
    quick: bool,
}

/// Runs the command.
///
/// # Errors
/// A file that cannot be written (1).
pub fn run(command: &ChartCommand) -> Result<(), Failure> {
    match command {
        ChartCommand::Physics(arguments) => {
            let effort = if arguments.quick { physics::Effort::Quick } else { physics::Effort::Full };
            physics::run(&arguments.out, effort)
        }
        ChartCommand::Stability(arguments) => stability::run(&arguments.out, arguments.quick),
    }
}
