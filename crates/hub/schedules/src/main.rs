//! Plays seeded schedules against the hub.

use std::process::ExitCode;
use std::time::Instant;

use clap::Parser;
use hub_schedules::{SchedulePlan, ScheduleStats, play, run, shrink};

/// Plays seeded schedules against the hub; a failing seed is printed with its smallest failing plan.
#[derive(Debug, Parser)]
struct Arguments {
    /// First seed.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Number of seeds.
    #[arg(long, default_value_t = 1_000_000)]
    count: u64,
    /// Number of threads.
    #[arg(long, default_value_t = 2)]
    threads: u64,
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let began = Instant::now();
    let summary = play(arguments.seed, arguments.count, arguments.threads);
    let Some((seed, _)) = summary.failure else {
        let wall_s = began.elapsed().as_secs_f64();
        let (schedules, ScheduleStats { ticks, frames, frames_refused, frames_seen, .. }) =
            (summary.schedules, summary.played);
        let ScheduleStats { watched, dropped, ended, logs_cut, .. } = summary.played;
        let rate = schedules as f64 / wall_s;
        println!(
            "{schedules} schedules, {ticks} ticks, {frames} frames ({frames_refused} refused, {frames_seen} \
             seen by controllers), {watched} messages to viewers ({dropped} missed), {ended} completed, \
             {logs_cut} logs cut; {wall_s:.1} s, {rate:.0} schedules a second"
        );
        return ExitCode::SUCCESS;
    };
    let plan = SchedulePlan::of(seed);
    println!("seed {seed} fails: {}", run(&plan).err().unwrap_or_default());
    let (least, cause) = shrink(&plan);
    println!("shrunk: {cause}\n{least:#?}");
    ExitCode::FAILURE
}
