//! `trabecula bench`: what the hub costs on this machine.

use std::path::PathBuf;

use clap::Subcommand;

use crate::bench::ping_pong::Wait;
use crate::bench::{overhead, ping_pong};
use crate::failure::Failure;

/// What to measure.
#[derive(Debug, Subcommand)]
pub enum BenchCommand {
    /// The hub's own time of a lockstep tick over processes, beside a bare ping-pong.
    Overhead {
        /// Scene; it runs in lockstep and is not recorded.
        #[arg(default_value = "configs/free_space.toml")]
        scene: PathBuf,
        /// Ticks of a round, 100 to 1000000.
        #[arg(long, default_value_t = 20_000, value_parser = clap::value_parser!(u64).range(100..=1_000_000))]
        ticks: u64,
        /// Rounds, 1 to 1000.
        #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u64).range(1..=1000))]
        rounds: u64,
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
/// A scene that is not one (2); a run that fails (1).
pub fn run(command: &BenchCommand) -> Result<(), Failure> {
    match command {
        BenchCommand::Overhead { scene, ticks, rounds } => overhead::run(scene, *ticks, *rounds as usize),
        BenchCommand::Pong { session, wait, rounds } => ping_pong::answer(session, *wait, *rounds),
    }
}
