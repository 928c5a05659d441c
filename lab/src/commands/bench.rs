//! `trabecula-lab bench`: measures the hub's overhead on this machine.

use std::path::{Path, PathBuf};

use clap::{Args, Subcommand};
use ipc_types::scene::Policy;

use crate::bench::ping_pong::Wait;
use crate::bench::start::CacheState;
use crate::bench::{
    bridge, drr, drr_batch, drr_poses, instructions, latency, lateness, log, memory, overhead, ping_pong,
    readings, recorder, soak, start, step, tools, viewer, xray,
};
use crate::sheet::Sheet;
use trabecula::commands::choice;
use trabecula::commands::run::POLICIES;
use trabecula::commands::stress::refuse_cores;
use trabecula::failure::Failure;
use trabecula::machine::allowed;
use trabecula::say::Figures;
use trabecula::scenes::{BuiltIn, SceneSource};
use trabecula::stress::plan::Load;
/// Real-time runs of a scene, alternating without and with the measured part.
#[derive(Debug, Args)]
pub struct InTurn {
    /// Scene file; default: the built-in femur.
    scene: Option<PathBuf>,
    /// Length of each run in seconds, 1 to 3600.
    #[arg(long, default_value_t = 10.0)]
    seconds: f64,
    /// Number of rounds, 1 to 1000.
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=1000))]
    rounds: u64,
    #[command(flatten)]
    figures: Figures,
}

impl InTurn {
    /// Returns the three arguments, validated.
    fn checked(&self) -> Result<(SceneSource, f64, usize), Failure> {
        in_range("--seconds", self.seconds, 1.0, 3600.0)?;
        Ok((femur_or(self.scene.as_deref()), self.seconds, self.rounds as usize))
    }
}

/// Arguments of `lateness`.
#[derive(Debug, Args)]
pub struct LatenessArguments {
    /// Scene file, run unrecorded; default: the built-in free-space scene.
    scene: Option<PathBuf>,
    /// Numbers of cores; the hub and the competing load share them. Default: all, then 1.
    #[arg(long, value_delimiter = ',')]
    cores: Vec<usize>,
    /// Competing load: none, spin, memory, disk or fork; spin:2 starts two.
    #[arg(long, value_delimiter = ',', default_value = "none,spin:2")]
    load: Vec<Load>,
    /// Scheduling policy of the physics and of `cyclictest`.
    #[arg(long, value_parser = choice(&POLICIES), default_value = "fifo")]
    policy: Policy,
    /// Length of each run in seconds, 1 to 3600.
    #[arg(long, default_value_t = 5.0)]
    seconds: f64,
    /// Number of rounds, 1 to 1000.
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=1000))]
    rounds: u64,
    /// Seed for the load.
    #[arg(long, default_value_t = 7)]
    seed: u64,
    #[command(flatten)]
    figures: Figures,
}

impl LatenessArguments {
    fn plan(&self) -> Result<lateness::Plan, Failure> {
        in_range("--seconds", self.seconds, 1.0, 3600.0)?;
        let most = allowed().map_or(1, |cores| cores.len());
        let cores = match self.cores.as_slice() {
            [] if most > 1 => vec![most, 1],
            [] => vec![1],
            given => given.to_vec(),
        };
        refuse_cores(&cores, most)?;
        Ok(lateness::Plan {
            scene: SceneSource::new(self.scene.as_deref(), BuiltIn::FreeSpace),
            cores,
            loads: self.load.clone(),
            policy: self.policy,
            seconds: self.seconds,
            rounds: self.rounds as usize,
            seed: self.seed,
        })
    }
}

/// What to measure.
#[derive(Debug, Subcommand)]
pub enum BenchCommand {
    /// Measure the hub's share of a lockstep tick across processes, next to a bare ping-pong.
    Overhead {
        /// Scene file; runs in lockstep, unrecorded. Default: the built-in free-space scene.
        scene: Option<PathBuf>,
        /// Ticks per round, 100 to 1000000.
        #[arg(long, default_value_t = 20_000, value_parser = clap::value_parser!(u64).range(100..=1_000_000))]
        ticks: u64,
        /// Number of rounds, 1 to 1000.
        #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u64).range(1..=1000))]
        rounds: u64,
        #[command(flatten)]
        figures: Figures,
    },
    /// Time the physics step and the DRR in one process, then the log size and replay speed of a recorded
    /// lockstep run.
    Step {
        /// Scene file with built-in controllers only; default: the built-in femur.
        scene: Option<PathBuf>,
        /// Maximum number of ticks.
        #[arg(long, value_parser = clap::value_parser!(u64).range(1..))]
        ticks: Option<u64>,
        /// Count the instructions of a step with valgrind instead (takes minutes).
        #[arg(long)]
        instructions: bool,
        /// Skip the recorded run.
        #[arg(long)]
        in_process: bool,
        /// Rounds in one process, 1 to 100; the minimum time of each tick is printed too.
        #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=100))]
        rounds: u64,
        #[command(flatten)]
        figures: Figures,
    },
    /// Time a step of each tool on each model at three step sizes, alternating with the standard tool on the
    /// planar model at 1 ms.
    Tools {
        /// Scene or tool files; default: the shipped tools.
        files: Vec<PathBuf>,
        /// Number of rounds, 1 to 1000.
        #[arg(long, default_value_t = 9, value_parser = clap::value_parser!(u64).range(1..=1000))]
        rounds: u64,
        /// Also count the instructions of a step with valgrind (takes a minute).
        #[arg(long)]
        instructions: bool,
        #[command(flatten)]
        figures: Figures,
    },
    /// Time a run from exec to its first tick and from its last to its exit, phase by phase.
    Start {
        /// Scene file; default: the built-in femur.
        scene: Option<PathBuf>,
        /// Number of rounds, 1 to 1000.
        #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u64).range(1..=1000))]
        rounds: u64,
        /// Begin each round with an empty cache.
        #[arg(long)]
        empty_cache: bool,
        #[command(flatten)]
        figures: Figures,
    },
    /// Measure the memory of each process with a large volume.
    Memory {
        /// Scene file; its volume is resampled to `--dimensions`. Default: the built-in femur.
        scene: Option<PathBuf>,
        /// Voxels along i, j, k.
        #[arg(long, default_value = "512x512x400", value_parser = memory::parse_dimensions)]
        dimensions: [usize; 3],
        /// Length of the run in ticks.
        #[arg(long, default_value_t = 500, value_parser = clap::value_parser!(u64).range(10..=100_000))]
        ticks: u64,
        #[command(flatten)]
        figures: Figures,
    },
    /// Measure X-ray projectors: time, error and updates after voxel removal, compared with the memory
    /// bandwidth.
    Drr {
        /// Voxels along i, j, k.
        #[arg(long, default_value = "512x512x400", value_parser = memory::parse_dimensions)]
        dimensions: [usize; 3],
        /// Number of rounds, 1 to 1000.
        #[arg(long, default_value_t = 9, value_parser = clap::value_parser!(u64).range(1..=1000))]
        rounds: u64,
        /// Instead, time this many poses about a field of 500 mm, alternating with the frontal one, 4 to
        /// 10000.
        #[arg(long, value_parser = clap::value_parser!(u64).range(4..=10_000))]
        poses: Option<u64>,
        /// Instead, render this many poses one by one and as one batch, alternating, 2 to 10000.
        #[arg(long, conflicts_with = "poses", value_parser = clap::value_parser!(u64).range(2..=10_000))]
        batch: Option<u64>,
        #[command(flatten)]
        figures: Figures,
    },
    /// Measure the state-to-command round trip by language and wait strategy, compared with plain iceoryx2
    /// and sockets.
    Latency {
        /// Round trips per turn, 10 to 1000000.
        #[arg(long, default_value_t = 3000, value_parser = clap::value_parser!(u64).range(10..=1_000_000))]
        rounds: u64,
        /// Number of turns, 1 to 1000.
        #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=1000))]
        turns: u64,
        /// Python interpreter that has NumPy.
        #[arg(long, default_value = "python3")]
        python: PathBuf,
        #[command(flatten)]
        figures: Figures,
    },
    /// The answering side of a latency measurement.
    #[command(hide = true)]
    Echo {
        /// Peer to act as.
        #[arg(long, value_enum)]
        peer: latency::Peer,
        /// How both sides wait.
        #[arg(long, value_enum)]
        wait: Wait,
        /// Round trips.
        #[arg(long)]
        rounds: usize,
        /// Address of the other side's socket.
        #[arg(long)]
        address: String,
    },
    /// Measure the cost of the counters that explain late ticks.
    Readings {
        /// Number of ticks, 100 to 1000000.
        #[arg(long, default_value_t = 5000, value_parser = clap::value_parser!(u64).range(100..=1_000_000))]
        ticks: u64,
        #[command(flatten)]
        figures: Figures,
    },
    /// Measure how late real-time ticks start, alternating with `cyclictest` at the same period and priority
    /// on the same cores.
    Lateness(LatenessArguments),
    /// Measure how much the recorder slows the physics: real-time runs, alternating without and with it.
    Recorder(InTurn),
    /// Measure how much the viewer slows the physics: real-time runs, alternating without and with it.
    Viewer(InTurn),
    /// Measure how much a bridge slows the physics: real-time runs, alternating without and with the bridge
    /// and a peer that receives all its messages.
    Bridge {
        #[command(flatten)]
        in_turn: InTurn,
        /// The bridge.
        #[arg(long, default_value = "igtl", value_parser = bridge::names())]
        kind: String,
    },
    /// Measure how much X-ray frames slow the physics: real-time runs, alternating without and with them.
    Xray {
        #[command(flatten)]
        in_turn: InTurn,
        /// Frame rate, 1 to 200 Hz; overrides the scene.
        #[arg(long)]
        rate_hz: Option<f64>,
        /// Request every frame from a different angle, so that each is computed completely.
        #[arg(long)]
        turning: bool,
    },
    /// Run in real time for a long time: missed ticks by cause, memory of each process over time, and a
    /// replay that verifies the log.
    Soak {
        /// Scene file; its feed is slowed so that it drills the whole time. Default: the built-in femur.
        scene: Option<PathBuf>,
        /// Length in minutes, up to 60.
        #[arg(long, default_value_t = 10.0)]
        minutes: f64,
        /// Scheduling policy of physics and controllers; overrides the scene.
        #[arg(long, value_parser = choice(&POLICIES))]
        policy: Option<Policy>,
        /// Keep the logs in this folder; default: remove them.
        #[arg(short, long)]
        output: Option<PathBuf>,
        #[command(flatten)]
        figures: Figures,
    },
    /// The answering side of a ping-pong.
    #[command(hide = true)]
    Pong {
        /// Folder of the session.
        #[arg(long, env = "TRABECULA_SESSION")]
        session: PathBuf,
        /// How both sides wait.
        #[arg(long, value_enum)]
        wait: Wait,
        /// Round trips.
        #[arg(long)]
        rounds: usize,
    },
}

impl BenchCommand {
    /// Returns how its figures are printed; default for the answering sides.
    fn figures(&self) -> Figures {
        match self {
            BenchCommand::Overhead { figures, .. }
            | BenchCommand::Step { figures, .. }
            | BenchCommand::Tools { figures, .. }
            | BenchCommand::Start { figures, .. }
            | BenchCommand::Memory { figures, .. }
            | BenchCommand::Drr { figures, .. }
            | BenchCommand::Latency { figures, .. }
            | BenchCommand::Readings { figures, .. }
            | BenchCommand::Soak { figures, .. } => *figures,
            BenchCommand::Lateness(plan) => plan.figures,
            BenchCommand::Recorder(plan)
            | BenchCommand::Viewer(plan)
            | BenchCommand::Bridge { in_turn: plan, .. }
            | BenchCommand::Xray { in_turn: plan, .. } => plan.figures,
            BenchCommand::Echo { .. } | BenchCommand::Pong { .. } => Figures::default(),
        }
    }
}

/// Runs the command.
///
/// # Errors
/// An invalid scene (2); a run that fails (1).
pub fn run(command: &BenchCommand) -> Result<(), Failure> {
    let mut sheet = Sheet::new(command.figures());
    let done = measure(command, &mut sheet);
    // A soak that fails still has figures; bad input has none.
    if done.is_ok() || sheet.has_figures() {
        sheet.end();
    }
    done
}

fn measure(command: &BenchCommand, sheet: &mut Sheet) -> Result<(), Failure> {
    match command {
        BenchCommand::Overhead { scene, ticks, rounds, .. } => {
            let scene = SceneSource::new(scene.as_deref(), BuiltIn::FreeSpace);
            overhead::run(&scene, *ticks, *rounds as usize, sheet)
        }
        BenchCommand::Step { scene, ticks, instructions: true, .. } => {
            instructions::run(&femur_or(scene.as_deref()), *ticks, sheet)
        }
        BenchCommand::Step { scene, ticks, in_process, rounds, .. } => {
            let scene = femur_or(scene.as_deref());
            step::run(&scene, *ticks, *rounds as usize, sheet)?;
            if *in_process {
                return Ok(());
            }
            sheet.line("");
            sheet.within("recorded_run", |sheet| log::run(&scene, *ticks, sheet))
        }
        BenchCommand::Tools { files, rounds, instructions, .. } => {
            tools::run(files, *rounds as usize, *instructions, sheet)
        }
        BenchCommand::Start { scene, rounds, empty_cache, .. } => {
            let cache = if *empty_cache { CacheState::Empty } else { CacheState::AsItIs };
            start::run(scene.as_deref(), *rounds as usize, cache, sheet)
        }
        BenchCommand::Memory { scene, dimensions, ticks, .. } => {
            memory::run(&femur_or(scene.as_deref()), *dimensions, *ticks, sheet)
        }
        BenchCommand::Drr { dimensions, rounds, batch: Some(count), .. } => {
            drr_batch::run(*dimensions, *count as usize, *rounds as usize, sheet)
        }
        BenchCommand::Drr { dimensions, rounds, poses: None, .. } => {
            drr::run(*dimensions, *rounds as usize, sheet)
        }
        BenchCommand::Drr { dimensions, rounds, poses: Some(count), .. } => {
            drr_poses::run(*dimensions, *count as usize, *rounds as usize, sheet)
        }
        BenchCommand::Latency { rounds, turns, python, .. } => {
            latency::run(*rounds as usize, *turns as usize, python.clone(), sheet)
        }
        BenchCommand::Echo { peer, wait, rounds, address } => latency::answer(*peer, *wait, *rounds, address),
        BenchCommand::Readings { ticks, .. } => {
            readings::run(*ticks, sheet);
            Ok(())
        }
        BenchCommand::Lateness(arguments) => lateness::run(&arguments.plan()?, sheet),
        BenchCommand::Recorder(plan) => {
            let (scene, seconds, rounds) = plan.checked()?;
            recorder::run(&scene, seconds, rounds, sheet)
        }
        BenchCommand::Viewer(plan) => {
            let (scene, seconds, rounds) = plan.checked()?;
            viewer::run(&scene, seconds, rounds, sheet)
        }
        BenchCommand::Bridge { in_turn, kind } => {
            let (scene, seconds, rounds) = in_turn.checked()?;
            bridge::run(kind, &scene, seconds, rounds, sheet)
        }
        BenchCommand::Xray { in_turn, rate_hz, turning } => {
            let (scene, seconds, rounds) = in_turn.checked()?;
            if let Some(rate_hz) = rate_hz {
                in_range("--rate-hz", *rate_hz, 1.0, 200.0)?;
            }
            let c_arm = if *turning { xray::CArmMoves::Turns } else { xray::CArmMoves::Stands };
            xray::run(&scene, seconds, rounds, *rate_hz, c_arm, sheet)
        }
        BenchCommand::Soak { scene, minutes, policy, output, .. } => {
            in_range("--minutes", *minutes, 0.05, 60.0)?;
            let scene = femur_or(scene.as_deref());
            soak::run(&scene, *minutes, *policy, output.as_deref(), sheet)
        }
        BenchCommand::Pong { session, wait, rounds } => ping_pong::answer(session, *wait, *rounds),
    }
}

fn femur_or(scene: Option<&Path>) -> SceneSource {
    SceneSource::new(scene, BuiltIn::Femur)
}

fn in_range(option: &str, value: f64, lowest: f64, highest: f64) -> Result<(), Failure> {
    if (lowest..=highest).contains(&value) {
        return Ok(());
    }
    Err(Failure::bad_input(format!("{option} is {value}; allowed: {lowest} to {highest}")))
}
