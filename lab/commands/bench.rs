//! `trabecula bench`: what the hub costs on this machine.

use std::path::{Path, PathBuf};

use clap::{Args, Subcommand};
use ipc_types::scene::Policy;

use crate::bench::ping_pong::Wait;
use crate::bench::{
    drr, instructions, latency, log, memory, overhead, ping_pong, readings, recorder, soak, step, viewer,
    xray,
};
use trabecula::commands::run::PolicyArgument;
use trabecula::failure::Failure;
use trabecula::scenes::{BuiltIn, SceneSource};

/// A scene in real time, without and with something in turn.
#[derive(Debug, Args)]
pub struct InTurn {
    /// Scene; without one, the femur inside the program.
    scene: Option<PathBuf>,
    /// Seconds of a run, 1 to 3600.
    #[arg(long, default_value_t = 10.0)]
    seconds: f64,
    /// Rounds, 1 to 1000.
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=1000))]
    rounds: u64,
}

impl InTurn {
    /// The three arguments, validated.
    fn checked(&self) -> Result<(SceneSource, f64, usize), Failure> {
        in_range("--seconds", self.seconds, 1.0, 3600.0)?;
        Ok((femur_or(self.scene.as_deref()), self.seconds, self.rounds as usize))
    }
}

/// What to measure.
#[derive(Debug, Subcommand)]
pub enum BenchCommand {
    /// The hub's own time of a lockstep tick over processes, beside a bare ping-pong.
    Overhead {
        /// Scene; it runs in lockstep and is not recorded. Without one, the free space inside the program.
        scene: Option<PathBuf>,
        /// Ticks of a round, 100 to 1000000.
        #[arg(long, default_value_t = 20_000, value_parser = clap::value_parser!(u64).range(100..=1_000_000))]
        ticks: u64,
        /// Rounds, 1 to 1000.
        #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u64).range(1..=1000))]
        rounds: u64,
    },
    /// Physics step and DRR in one process; then a recorded lockstep run: log size, and speed of its replay.
    Step {
        /// Scene whose controllers are all built in; without one, the femur inside the program.
        scene: Option<PathBuf>,
        /// Ticks at most.
        #[arg(long)]
        ticks: Option<u64>,
        /// Instead of the log: instructions of a step, counted by valgrind (minutes).
        #[arg(long)]
        instructions: bool,
        /// No log.
        #[arg(long)]
        in_process: bool,
        /// Rounds in one process, 1 to 100: the least time of each tick is printed too.
        #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=100))]
        rounds: u64,
    },
    /// Memory of each process with a large volume.
    Memory {
        /// Scene; its volume is resampled to the dimensions. Without one, the femur inside the program.
        scene: Option<PathBuf>,
        /// Voxels along i, j, k.
        #[arg(long, default_value = "512x512x400", value_parser = memory::parse_dimensions)]
        dimensions: [usize; 3],
        /// Ticks of the run.
        #[arg(long, default_value_t = 500, value_parser = clap::value_parser!(u64).range(10..=100_000))]
        ticks: u64,
    },
    /// X-ray line integrals: milliseconds, errors, updates after removals, beside the memory's streaming rate.
    Drr {
        /// Voxels along i, j, k.
        #[arg(long, default_value = "512x512x400", value_parser = memory::parse_dimensions)]
        dimensions: [usize; 3],
        /// Rounds, 1 to 1000.
        #[arg(long, default_value_t = 9, value_parser = clap::value_parser!(u64).range(1..=1000))]
        rounds: u64,
    },
    /// State to command and back by language and way of waiting, beside bare iceoryx2 and sockets.
    Latency {
        /// Round trips of a turn, 10 to 1000000.
        #[arg(long, default_value_t = 3000, value_parser = clap::value_parser!(u64).range(10..=1_000_000))]
        rounds: u64,
        /// Turns, 1 to 1000.
        #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=1000))]
        turns: u64,
        /// Python with NumPy.
        #[arg(long, default_value = "python3")]
        python: PathBuf,
    },
    /// The answering side of a latency measurement.
    #[command(hide = true)]
    Echo {
        /// As whom.
        #[arg(long, value_enum)]
        peer: latency::Peer,
        /// How both sides wait.
        #[arg(long, value_enum)]
        wait: Wait,
        /// Round trips.
        #[arg(long)]
        rounds: usize,
        /// Of the other side's socket.
        #[arg(long)]
        address: String,
    },
    /// What the readings cost that say why a tick was late.
    Readings {
        /// Ticks, 100 to 1000000.
        #[arg(long, default_value_t = 5000, value_parser = clap::value_parser!(u64).range(100..=1_000_000))]
        ticks: u64,
    },
    /// What the recorder costs the physics: the scene in real time without and with it, in turn.
    Recorder(InTurn),
    /// What the viewer costs the physics: the scene in real time without and with it, in turn.
    Viewer(InTurn),
    /// What X-ray frames cost the physics: the scene in real time without and with them, in turn.
    Xray {
        #[command(flatten)]
        in_turn: InTurn,
        /// Frames a second instead of the scene's, 1 to 200.
        #[arg(long)]
        rate_hz: Option<f64>,
    },
    /// A long run in real time with frames: misses by cause, memory of each process over time, log verified by replay.
    Soak {
        /// Scene; a feed is slowed so that it drills all the time. Without one, the femur inside the program.
        scene: Option<PathBuf>,
        /// Minutes, up to 60.
        #[arg(long, default_value_t = 10.0)]
        minutes: f64,
        /// How the scheduler treats physics and controllers, instead of what the scene says.
        #[arg(long, value_enum)]
        policy: Option<PolicyArgument>,
        /// Folder that keeps the logs; without it they are removed.
        #[arg(long)]
        output: Option<PathBuf>,
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

/// Runs the command.
///
/// # Errors
/// An invalid scene (2); a run that fails (1).
pub fn run(command: &BenchCommand) -> Result<(), Failure> {
    match command {
        BenchCommand::Overhead { scene, ticks, rounds } => {
            let scene = SceneSource::new(scene.as_deref(), BuiltIn::FreeSpace);
            overhead::run(&scene, *ticks, *rounds as usize)
        }
        BenchCommand::Step { scene, ticks, instructions: true, .. } => {
            instructions::run(&femur_or(scene.as_deref()), *ticks)
        }
        BenchCommand::Step { scene, ticks, in_process, rounds, .. } => {
            let scene = femur_or(scene.as_deref());
            step::run(&scene, *ticks, *rounds as usize)?;
            if *in_process {
                return Ok(());
            }
            say!();
            log::run(&scene, *ticks)
        }
        BenchCommand::Memory { scene, dimensions, ticks } => {
            memory::run(&femur_or(scene.as_deref()), *dimensions, *ticks)
        }
        BenchCommand::Drr { dimensions, rounds } => drr::run(*dimensions, *rounds as usize),
        BenchCommand::Latency { rounds, turns, python } => {
            latency::run(*rounds as usize, *turns as usize, python.clone())
        }
        BenchCommand::Echo { peer, wait, rounds, address } => latency::answer(*peer, *wait, *rounds, address),
        BenchCommand::Readings { ticks } => {
            readings::run(*ticks);
            Ok(())
        }
        BenchCommand::Recorder(plan) => {
            let (scene, seconds, rounds) = plan.checked()?;
            recorder::run(&scene, seconds, rounds)
        }
        BenchCommand::Viewer(plan) => {
            let (scene, seconds, rounds) = plan.checked()?;
            viewer::run(&scene, seconds, rounds)
        }
        BenchCommand::Xray { in_turn, rate_hz } => {
            let (scene, seconds, rounds) = in_turn.checked()?;
            if let Some(rate_hz) = rate_hz {
                in_range("--rate-hz", *rate_hz, 1.0, 200.0)?;
            }
            xray::run(&scene, seconds, rounds, *rate_hz)
        }
        BenchCommand::Soak { scene, minutes, policy, output } => {
            in_range("--minutes", *minutes, 0.05, 60.0)?;
            let scene = femur_or(scene.as_deref());
            soak::run(&scene, *minutes, policy.map(Policy::from), output.as_deref())
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
    Err(Failure::bad_input(format!("{option} is {value}, allowed is {lowest} to {highest}")))
}
