//! Makes a long log from a short one, to see how the viewer opens and scrubs it: the last state again and again, with a bend and a force
//! that change, and the ticks' times beside it.
//!
//! `cargo run --release -p viewer_proc --example long_log -- FROM SECONDS FOLDER`, where `FROM` is a run's `run.mcap`.

use std::collections::BTreeMap;
use std::error::Error;
use std::path::PathBuf;

use ipc_types::messages::{Latched, State, Tick, TickTiming};
use recorder_proc::log_file::{LogFile, create_run, create_timing};
use run_log::{EndReason, LogReader, MessageStream, ReadOptions, Topic};
use zerocopy::{FromZeros, IntoBytes};

fn main() -> Result<(), Box<dyn Error>> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let [from, seconds, folder] = words.as_slice() else {
        return Err("expected: FROM SECONDS FOLDER".into());
    };
    let from = LogFile::at(from);
    let mut header = MessageStream::open(&from, ReadOptions::default())?.header().clone();
    let first = LogReader::open(&from)?.next().ok_or("the log has no tick")??;
    header.scene_name = format!("{} for {seconds} s", header.scene_name);
    let ticks = (seconds.parse::<f64>()? * 1e9 / header.dt_ns as f64) as u64;
    let folder = PathBuf::from(folder);
    std::fs::create_dir_all(&folder)?;
    let mut run = create_run(&folder.join("run.mcap"), &header)?;
    let mut timing = create_timing(&folder.join("timing.mcap"), &header)?;
    for tick in 0..ticks {
        let time_s = tick as f64 * header.dt_ns as f64 * 1e-9;
        let mut state: State = first.state;
        state.tick = tick;
        state.bend_rad = 0.5 * (time_s * 0.01).sin() + 0.05 * (time_s * 7.0).sin();
        // A peak of one tick each minute: no zoom may lose it.
        state.burr_force_n = if tick % 60_000 == 30_000 { 20.0 } else { time_s.sin().abs() };
        if tick > 0 {
            run.latched(&Latched { tick: tick - 1, ..Latched::new_zeroed() })?;
        }
        run.state(&state)?;
        let missed = u32::from(tick % 100_003 == 5);
        let wake_lateness_ns = i64::from(missed) * 1_500_000;
        let took = TickTiming { tick, step_ns: 40_000, missed, wake_lateness_ns, ..TickTiming::new_zeroed() };
        timing.message(Topic::TickTiming, Tick(tick), took.as_bytes())?;
    }
    run.finish(EndReason::Completed, &BTreeMap::new())?;
    timing.finish(EndReason::Completed, &BTreeMap::new())?;
    Ok(())
}
