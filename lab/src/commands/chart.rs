//! `trabecula-lab chart`: measured figures as SVG, PNG and CSV.

use crate::effort::Effort;
use std::path::PathBuf;

use clap::{Args, Subcommand};

use crate::charts::stability::random::Ranges;
use crate::charts::{coverage, drr, flexure, physics, stability};
use crate::sheet::Sheet;
use trabecula::failure::Failure;
use trabecula::plan::OwnTool;
use trabecula::say::Figures;
use trabecula::tool::source::ToolSource;

/// What to measure.
#[derive(Debug, Subcommand)]
pub enum ChartCommand {
    /// X-ray frames: error against time for every projector, at three poses and three resolutions.
    Drr(DrrChartArguments),
    /// Physics: error against computing time for every model, integrator and baseline.
    Physics(PhysicsChartArguments),
    /// Physics: stiffness of a flexure, compared with finite elements of the notched tube.
    Flexure(FlexureChartArguments),
    /// Physics: random scenes with a tolerance, planned and run; counts those that exceed it.
    Promise(PromiseArguments),
    /// Identification: how often 95 % intervals hold random true values.
    Coverage(CoverageArguments),
    /// Physics: the step sizes at which each method converges, is inaccurate or diverges.
    Stability(StabilityArguments),
}
/// Arguments of `chart drr`.
#[derive(Debug, Args)]
pub struct DrrChartArguments {
    /// Output folder.
    #[arg(short, long, default_value = "out/charts")]
    output: PathBuf,
    /// Finish in seconds: an eighth of the resolution, 128 x 128 pixels.
    #[arg(long)]
    quick: bool,
    /// Also run other projectors on the same volume and poses, with this folder's scripts; each creates its
    /// own Python environment.
    #[arg(long, value_name = "FOLDER", num_args = 0..=1, default_missing_value = "lab/peers")]
    peers: Option<PathBuf>,
    /// Timed frames per point, 1 to 100.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=100))]
    rounds: u32,
    /// Instead of a chart, write the table that `tolerance.drr_rel` chooses from
    /// (`crates/xray/src/rungs.csv`).
    #[arg(long, value_name = "FILE", conflicts_with_all = ["quick", "peers"])]
    rungs: Option<PathBuf>,
}
/// Arguments of `chart stability`.
#[derive(Debug, Args)]
pub struct StabilityArguments {
    /// Output folder and effort of the map.
    #[command(flatten)]
    common: ChartArguments,
    /// Instead of the map, run the hard cases in bone at every rung and step size.
    #[arg(long, conflicts_with_all = ["quick", "random", "tools"])]
    bone: bool,
    /// Instead of the map, check this many random scenes at the ends of the documented ranges, 1 to 100000.
    #[arg(long, value_name = "SCENES", conflicts_with = "quick",
        value_parser = clap::value_parser!(u64).range(1..=100_000))]
    random: Option<u64>,
    /// Draw the random scenes within the ranges for which the simulation is validated, steps of 0.1 to 5 ms.
    #[arg(long, requires = "random")]
    validated: bool,
    /// Seed of the first random scene; the others follow.
    #[arg(long, default_value_t = 1, requires = "random",
        value_parser = clap::value_parser!(u64).range(0..=1_000_000_000))]
    seed: u64,
    /// Instead of the map, run its cases with these scene or tool files, unchanged; without a file, with the
    /// shipped tools.
    #[arg(long, value_name = "FILE", num_args = 0.., conflicts_with = "random")]
    tools: Option<Vec<PathBuf>>,
    /// Output format of the figures of random scenes, of tools or of the cases in bone.
    #[command(flatten)]
    figures: Figures,
}

/// Output folder and effort.
#[derive(Debug, Args)]
pub struct ChartArguments {
    /// Output folder.
    #[arg(short, long, default_value = "out/charts")]
    output: PathBuf,
    /// Finish in seconds, with only a few points.
    #[arg(long)]
    quick: bool,
}
/// Arguments of `chart physics`.
#[derive(Debug, Args)]
pub struct PhysicsChartArguments {
    /// Output folder and effort.
    #[command(flatten)]
    common: ChartArguments,
    /// Also run other simulators on the same beam, with this folder's scripts; each creates its own Python
    /// environment.
    #[arg(long, value_name = "FOLDER", num_args = 0..=1, default_missing_value = "lab/peers/physics")]
    peers: Option<PathBuf>,
    /// Measure only the settings that `trabecula plan` chooses from, and the drilled path.
    #[arg(long, conflicts_with = "peers")]
    plan_only: bool,
    /// Measure only the contact problem, with the other simulators.
    #[arg(long, requires = "peers")]
    contact_only: bool,
}

/// Output folder, script and mesh size.
#[derive(Debug, Args)]
pub struct FlexureChartArguments {
    /// Folder of the Python environment.
    #[arg(short, long, default_value = "out/charts")]
    output: PathBuf,
    /// Folder of the script, which creates its own Python environment.
    #[arg(long, value_name = "FOLDER", default_value = "lab/peers/flexure")]
    peers: PathBuf,
    /// Mesh size at the webs, 0.05 to 0.5 mm.
    #[arg(long, default_value_t = 0.15)]
    size_mm: f64,
    /// Output format of the figures.
    #[command(flatten)]
    figures: Figures,
}

/// Number and selection of scenes.
#[derive(Debug, Args)]
pub struct PromiseArguments {
    /// Scene or tool file whose tool replaces the standard one in all scenes.
    #[arg(long, value_name = "FILE")]
    tool: Option<PathBuf>,
    /// Scenes in free space, 0 to 10000.
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u64).range(0..=10_000))]
    free: u64,
    /// Scenes in bone, 0 to 10000.
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u64).range(0..=10_000))]
    bone: u64,
    /// Seed of the first scene; the others follow.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(0..=1_000_000_000))]
    seed: u64,
    /// Output format of the figures.
    #[command(flatten)]
    figures: Figures,
}

/// Number and selection of studies.
#[derive(Debug, Args)]
pub struct CoverageArguments {
    /// Studies of each bench, 1 to 10000.
    #[arg(long, default_value_t = 200, value_parser = clap::value_parser!(u64).range(1..=10_000))]
    studies: u64,
    /// Seed of the first study; the others follow.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(0..=1_000_000_000))]
    seed: u64,
    /// Only the bench in free space.
    #[arg(long)]
    free: bool,
    /// Only the bench in bone.
    #[arg(long, conflicts_with = "free")]
    bone: bool,
    /// Output format of the figures.
    #[command(flatten)]
    figures: Figures,
}

/// Runs the command.
///
/// # Errors
/// A file that cannot be written (1).
pub fn run(command: &ChartCommand) -> Result<(), Failure> {
    match command {
        ChartCommand::Drr(arguments) => drr::run(&drr::Plan {
            out: arguments.output.clone(),
            quick: arguments.quick,
            peers: arguments.peers.clone(),
            rounds: arguments.rounds as usize,
            rungs: arguments.rungs.clone(),
        }),
        ChartCommand::Physics(arguments) => {
            let quick = arguments.common.quick;
            physics::run(&physics::Plan {
                out: arguments.common.output.clone(),
                effort: Effort::of_option(quick),
                peers: arguments.peers.clone(),
                settings_only: arguments.plan_only,
                contact_only: arguments.contact_only,
            })
        }
        ChartCommand::Flexure(arguments) => {
            let mut sheet = Sheet::new(arguments.figures);
            let done = flexure::run(&arguments.output, &arguments.peers, arguments.size_mm, &mut sheet);
            sheet.end();
            done
        }
        ChartCommand::Promise(arguments) => {
            let source = arguments.tool.as_deref().map(|file| ToolSource::load(Some(file))).transpose()?;
            let tool = source.map(|source| OwnTool::of(&source.scene));
            let PromiseArguments { free, bone, seed, .. } = *arguments;
            let plan = physics::promise::Plan { tool, free, bone, seed };
            let mut sheet = Sheet::new(arguments.figures);
            let exceeded = physics::promise::run(&plan, &mut sheet)?;
            sheet.end();
            match exceeded {
                0 => Ok(()),
                exceeded => Err(Failure::failed(format!("{exceeded} scenes exceeded their tolerance"))),
            }
        }
        ChartCommand::Coverage(arguments) => {
            let CoverageArguments { studies, seed, free, bone, .. } = *arguments;
            let mut sheet = Sheet::new(arguments.figures);
            let outside =
                coverage::run(&coverage::Plan { studies, seed, free: !bone, bone: !free }, &mut sheet)?;
            sheet.end();
            // Of few studies, no share says much.
            match outside {
                outside if outside > 0 && studies >= 100 => Err(Failure::failed(format!(
                    "the intervals of {outside} parameters hold the truth in less than 92 % or more than 98 %"
                ))),
                _ => Ok(()),
            }
        }
        ChartCommand::Stability(arguments) if arguments.bone => {
            let mut sheet = Sheet::new(arguments.figures);
            let wrong = stability::bone::run(&mut sheet)?;
            sheet.end();
            match wrong {
                0 => Ok(()),
                wrong => Err(Failure::failed(format!("{wrong} runs failed their check"))),
            }
        }
        ChartCommand::Stability(arguments) => {
            let effort = Effort::of_option(arguments.common.quick);
            if let Some(files) = &arguments.tools {
                let mut sheet = Sheet::new(arguments.figures);
                stability::tools::run(files, effort, &mut sheet)?;
                sheet.end();
                return Ok(());
            }
            let Some(count) = arguments.random else {
                return stability::run(&arguments.common.output, effort);
            };
            let mut sheet = Sheet::new(arguments.figures);
            let ranges = if arguments.validated { Ranges::Validated } else { Ranges::Documented };
            let wrong = stability::survey::run(count, arguments.seed, ranges, &mut sheet)?;
            sheet.end();
            match wrong {
                0 => Ok(()),
                wrong => Err(Failure::failed(format!("{wrong} of {count} scenes failed their check"))),
            }
        }
    }
}
