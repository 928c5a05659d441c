//! Measures the size of a recorded lockstep run and the replay speed of its log.

use std::path::Path;
use std::time::Instant;

use ipc_types::process::EndRequest;
use ipc_types::scene::Mode;
use run_log::segments::SegmentOptions;
use serde_json::json;

use super::{complete_run, cut, failed};
use crate::sheet::Sheet;
use trabecula::failure::Failure;
use trabecula::launcher::run::RunPlan;
use trabecula::launcher::volume_source::VolumeFiles;
use trabecula::machine::Machine;
use trabecula::replay::{OpenedLog, Overrides, step, timed_verification};
use trabecula::scenes::SceneSource;

/// Records the scene in lockstep to its end, or for `ticks`, and replays the log without frames.
///
/// # Errors
/// An invalid scene (2); a run that fails.
pub fn run(scene: &SceneSource, ticks: Option<u64>, sheet: &mut Sheet) -> Result<(), Failure> {
    let mut scene = scene.load()?;
    scene.run.mode = Mode::Lockstep;
    cut(&mut scene, ticks);
    let end = EndRequest::install().map_err(failed)?;
    let folder = tempfile::tempdir().map_err(failed)?;
    let machine = Machine::watch();
    let plan = RunPlan {
        scene,
        output: Some(folder.path().to_owned()),
        view: None,
        volume_files: VolumeFiles::default(),
    };
    let result = complete_run(&plan, &end, |_| {})?;
    let simulated_s = plan.scene.run.duration_s;
    let wall_s = result.running.as_secs_f64();
    sheet.line(&format!(
        "scene {}, {simulated_s} s simulated in lockstep over processes, recorded\n",
        plan.scene.name
    ));
    sheet.set("simulated_s", json!(simulated_s));
    let times = |wall_s: f64| format!("{wall_s:.2} s, {:.1} times real time", simulated_s / wall_s);
    sheet.row("run", &times(wall_s), "run_s", json!(wall_s));
    for (lane, key) in [("run.mcap", "run_mcap_bytes"), ("timing.mcap", "timing_mcap_bytes")] {
        let bytes = std::fs::metadata(folder.path().join(lane)).map_err(failed)?.len();
        let per_second_kb = bytes as f64 * 1e-3 / simulated_s;
        let text = format!("{per_second_kb:.0} kB per simulated second ({:.1} MB)", bytes as f64 * 1e-6);
        sheet.row(lane, &text, key, json!(bytes));
    }
    let (replay_s, threads) = replay(&folder.path().join("run.mcap"))?;
    sheet.row(
        &format!("replay without frames, {threads} threads"),
        &times(replay_s),
        "replay_s",
        json!(replay_s),
    );
    let (verify_s, threads) = timed_verification(&folder.path().join("run.mcap"))?;
    let figures = json!({"threads": threads, "wall_s": verify_s});
    sheet.row(&format!("replay --verify, {threads} threads"), &times(verify_s), "verify", figures);
    sheet.machine(&machine);
    Ok(())
}

/// Returns the time of a replay as in `trabecula replay`, in seconds, with one thread per core; the final
/// hash must match the log's.
///
/// # Errors
/// A log that cannot be read, or a different hash at its end.
fn replay(log: &Path) -> Result<(f64, usize), Failure> {
    let opened = OpenedLog::open(log, &Overrides::default())?;
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let began = Instant::now();
    let (report, verdict) = step(&opened, SegmentOptions { start: None, to_tick: None, threads })?;
    let wall_s = began.elapsed().as_secs_f64();
    let found = report.replay;
    if verdict.ending.marker.is_none_or(|marker| marker.hash != Some(found.hash)) {
        return Err(Failure::failed(format!(
            "the replay ends at tick {} with a different hash",
            found.last_tick
        )));
    }
    Ok((wall_s, threads))
}
