//! `trabecula chart`: measured figures as SVG, PNG and CSV.

use std::path::PathBuf;

use clap::{Args, Subcommand};

use crate::charts::{drr, physics, stability};
use trabecula::failure::Failure;

/// What to measure.
#[derive(Debug, Subcommand)]
pub enum ChartCommand {
    /// X-ray frames: error against milliseconds for every projector, three poses and three resolutions.
    Drr(DrrChartArguments),
    /// Physics: error against cost for every rung, integrator and baseline.
    Physics(PhysicsChartArguments),
    /// Where each method converges, is wrong or blows up.
    Stability(ChartArguments),
}

/// Where to, and how much.
#[derive(Debug, Args)]
pub struct DrrChartArguments {
    /// Folder of the files.
    #[arg(long, default_value = "out/charts")]
    out: PathBuf,
    /// An eighth of the resolution and a detector of 128 x 128, in seconds.
    #[arg(long)]
    quick: bool,
    /// Other projectors on the same volume and poses, by the scripts of this folder: each makes its own Python environment.
    #[arg(long, value_name = "FOLDER", num_args = 0..=1, default_missing_value = "charts/peers")]
    peers: Option<PathBuf>,
    /// Timed frames of each point, 1 to 100.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=100))]
    rounds: u32,
    /// Write the table from which `tolerance.drr_rel` chooses (`xray/src/rungs.csv`) instead of a chart.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["quick", "peers"])]
    rungs: Option<PathBuf>,
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

/// Where to, how much, and beside whom.
#[derive(Debug, Args)]
pub struct PhysicsChartArguments {
    /// Where to, and how much.
    #[command(flatten)]
    common: ChartArguments,
    /// Other simulators on the same beam, by the scripts of this folder: each makes its own Python environment.
    #[arg(long, value_name = "FOLDER", num_args = 0..=1, default_missing_value = "charts/peers/physics")]
    peers: Option<PathBuf>,
    /// Only the settings that `trabecula plan` chooses from, and the drilled path.
    #[arg(long, conflicts_with = "peers")]
    plan_only: bool,
}

/// Runs the command.
///
/// # Errors
/// A file that cannot be written (1).
pub fn run(command: &ChartCommand) -> Result<(), Failure> {
    match command {
        ChartCommand::Drr(arguments) => drr::run(&drr::Plan {
            out: arguments.out.clone(),
            quick: arguments.quick,
            peers: arguments.peers.clone(),
            rounds: arguments.rounds as usize,
            rungs: arguments.rungs.clone(),
        }),
        ChartCommand::Physics(arguments) => {
            let quick = arguments.common.quick;
            physics::run(&physics::Plan {
                out: arguments.common.out.clone(),
                effort: if quick { physics::Effort::Quick } else { physics::Effort::Full },
                peers: arguments.peers.clone(),
                settings_only: arguments.plan_only,
            })
        }
        ChartCommand::Stability(arguments) => stability::run(&arguments.out, arguments.quick),
    }
}
