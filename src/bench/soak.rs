//! A long run in real time with frames, and what is left of it: misses, losses, log, memory, replay.

use std::path::Path;
use std::time::Instant;

use ipc_types::process::EndRequest;
use ipc_types::scene::{Mode, Scene};
use recorder_proc::{MessageStream, ReadOptions, frames};

use super::machine::Machine;
use super::{complete_run, failed, log, row};
use crate::failure::Failure;
use crate::launcher::part::Memory;
use crate::launcher::run::RunPlan;

/// Bytes of a mebibyte.
const MEBIBYTE: f64 = 1_048_576.0;

/// Runs the scene in real time for `minutes` and verifies its log: whole, nothing lost, every tick replayed to the same
/// hash, every frame there.
///
/// # Errors
/// A scene that is not one (2); a run that fails; a log that is not whole, or lost messages, or replays differently.
pub fn run(scene: &Path, minutes: f64, output: Option<&Path>) -> Result<(), Failure> {
    let mut scene = Scene::load(scene).map_err(Failure::bad_input)?;
    scene.run.mode = Mode::Realtime;
    scene.run.duration_s = minutes * 60.0;
    let end = EndRequest::install().map_err(failed)?;
    let own = tempfile::tempdir().map_err(failed)?;
    let folder = output.unwrap_or(own.path());
    std::fs::create_dir_all(folder).map_err(failed)?;
    let machine = Machine::watch();
    let plan = RunPlan { scene, output: Some(folder.to_owned()), view: None };
    let (mut status, mut early, began) = (None, Memory::default(), Instant::now());
    let result = complete_run(&plan, &end, |glance| {
        status = glance.status.copied().or(status);
        // The launcher's own memory after a tenth of the run, beside its peak at the end.
        if began.elapsed().as_secs_f64() < minutes * 6.0 {
            early.measure("self");
        }
    })?;
    say!("scene {}, {minutes} minutes in real time, recorded\n", plan.scene.name);
    let ticks = plan.scene.tick_count();
    let missed = status.map_or(0, |status| status.missed_ticks);
    let share = 100.0 * missed as f64 / ticks.max(1) as f64;
    row("run", &format!("{:.2} s wall, {ticks} ticks", result.running.as_secs_f64()));
    row("ticks missed", &format!("{missed} ({share:.3} %)"));
    for (name, memory) in &result.memory {
        let [resident, private] =
            [memory.peak_resident, memory.peak_private].map(|bytes| bytes as f64 / MEBIBYTE);
        row(&format!("{name}: peak resident, its own"), &format!("{resident:.1} MiB, {private:.1} MiB"));
    }
    row(
        "launcher after a tenth of the run, its own",
        &format!("{:.1} MiB", early.peak_private as f64 / MEBIBYTE),
    );
    for lane in ["run.mcap", "timing.mcap"] {
        verify_lane(&folder.join(lane), lane, plan.scene.run.duration_s)?;
    }
    let shown = frames(&folder.join("run.mcap"), ReadOptions::default()).map_err(failed)?;
    let mut count = 0_u64;
    for frame in shown {
        frame.map_err(failed)?;
        count += 1;
    }
    row("frames", &format!("{count}, none missing"));
    let replay_s = log::replay(&plan.scene, &folder.join("run.mcap"))?;
    let speed = plan.scene.run.duration_s / replay_s;
    row("replay", &format!("every hash the same; {replay_s:.1} s, {speed:.1} times real time"));
    machine.print();
    Ok(())
}

/// Reads a lane to its end: it must have its end marker and have lost nothing.
fn verify_lane(path: &Path, lane: &str, simulated_s: f64) -> Result<(), Failure> {
    let mut stream = MessageStream::open(path, ReadOptions::default()).map_err(failed)?;
    let mut messages = 0_u64;
    while stream.next_message().map_err(failed)?.is_some() {
        messages += 1;
    }
    let ending = stream.ending();
    let lost = ending.marker.as_ref().map_or(0, |marker| marker.lost.values().sum::<u64>());
    if !ending.is_complete() || lost > 0 {
        return Err(Failure::failed(format!("{}: {}", path.display(), ending.describe())));
    }
    let megabytes = std::fs::metadata(path).map_err(failed)?.len() as f64 * 1e-6;
    let rate = megabytes / simulated_s;
    row(lane, &format!("{megabytes:.1} MB, {rate:.2} MB/s, {messages} messages, none lost"));
    Ok(())
}
