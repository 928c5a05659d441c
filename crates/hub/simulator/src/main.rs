//! Plays seeded schedules against the hub.

use std::process::ExitCode;
use std::time::Instant;

use clap::Parser;
use hub_simulator::{Plan, play, run, shrink};

/// Plays seeded schedules against the hub; a seed that fails is printed with the least plan that fails.
#[derive(Debug, Parser)]
struct Arguments {
    /// First seed.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// How many seeds.
    #[arg(long, default_value_t = 1_000_000)]
    count: u64,
    /// Threads.
    #[arg(long, default_value_t = 2)]
    threads: u64,
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let began = Instant::now();
    let summary = play(arguments.seed, arguments.count, arguments.threads);
    let Some((seed, _)) = summary.failure else {
        let wall_s = began.elapsed().as_secs_f64();
        println!(
            "{} schedules, {} ticks, {} frames ({} refused, {} seen by controllers), {} messages to viewers ({} missed), {} came to their end, {} logs cut; {wall_s:.1} s, {:.0} schedules a second",
            summary.schedules,
            summary.ticks,
            summary.frames,
            summary.frames_refused,
            summary.frames_seen,
            summary.watched,
            summary.dropped,
            summary.ended,
            summary.logs_cut,
            summary.schedules as f64 / wall_s
        );
        return ExitCode::SUCCESS;
    };
    let plan = Plan::of(seed);
    println!("seed {seed} fails: {}", run(&plan).err().unwrap_or_default());
    let (least, cause) = shrink(&plan);
    println!("shrunk: {cause}\n{least:#?}");
    ExitCode::FAILURE
}
