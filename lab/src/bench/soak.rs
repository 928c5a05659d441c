//! A long real-time run with frames, and its checks: misses, losses, log, memory, replay.

use std::path::Path;
use std::time::Instant;

use ipc_types::messages::{Part as HubPart, Phase};
use ipc_types::process::{EndRequest, Role, prioritise};
use ipc_types::scene::{Mode, Policy, Scene};
use recorder_proc::log_file::LogFile;
use run_log::{MessageStream, ReadOptions, frames};
use serde_json::json;

use super::failed;
use super::growth::Growth;
use crate::sheet::Sheet;
use trabecula::failure::{EXIT_INTERRUPTED, Failure};
use trabecula::launcher::part::Memory;
use trabecula::launcher::run::{Outcome, RunPlan, RunResult, RunSnapshot, run as run_scene};
use trabecula::launcher::volume_source::VolumeFiles;
use trabecula::machine::Machine;
use trabecula::output::{refuse_existing, within};
use trabecula::replay::timed_verification;
use trabecula::report::{self, Summary};
use trabecula::scenes::SceneSource;

/// Bytes of a mebibyte.
const MEBIBYTE: f64 = 1_048_576.0;
/// The logs of a run.
const LANES: [&str; 2] = ["run.mcap", "timing.mcap"];
/// Memory samples over the run, and how many of them are printed.
const SAMPLES: f64 = 120.0;
const SAMPLES_PER_LINE: usize = 4;
/// Fraction of the run that a slowed feed takes.
const FEED_SHARE: f64 = 0.9;
/// Minimum feed of a scene.
const SLOWEST_MM_PER_S: f64 = 0.01;
/// Smallest growth over the whole run, from its slope, that counts as growth; an allocator that returns and
/// reclaims memory causes less.
const FLAT_BYTES: f64 = MEBIBYTE;

/// Runs the scene in real time for `minutes`, with its feed slowed so that it drills throughout. Then checks
/// that the log is complete, no message was lost, every tick replays to the same hash, every frame is
/// present, and no process's memory has grown. Ctrl-C ends the run early; the part that ran is still checked.
///
/// # Errors
/// An invalid scene (2); a run that fails; an incomplete log, lost messages, or a replay that differs; Ctrl-C
/// (130).
pub fn run(
    scene: &SceneSource,
    minutes: f64,
    policy: Option<Policy>,
    output: Option<&Path>,
    sheet: &mut Sheet,
) -> Result<(), Failure> {
    let mut scene = scene.load()?;
    if let Some(folder) = output {
        refuse_existing(&within(folder, &["run.mcap", "timing.mcap", "summary.json"]))?;
    }
    scene.run.mode = Mode::Realtime;
    scene.run.duration_s = minutes * 60.0;
    scene.run.policy = policy.unwrap_or(scene.run.policy);
    let slowed = slow_down(&mut scene);
    let end = EndRequest::install().map_err(failed)?;
    let own = tempfile::tempdir().map_err(failed)?;
    let folder = output.unwrap_or(own.path());
    output_file::create_folder(folder).map_err(failed)?;
    // Checked now, so that a soak of hours does not end with its log refused.
    if let Some(there) = LANES.iter().map(|lane| folder.join(lane)).find(|path| path.exists()) {
        return Err(Failure::bad_input(format!(
            "{}: already exists; choose another folder",
            there.display()
        )));
    }
    let machine = Machine::watch();
    let plan =
        RunPlan { scene, output: Some(folder.to_owned()), view: None, volume_files: VolumeFiles::default() };
    let mut watch = Watch::new(minutes, plan.scene.run.policy);
    let result = run_scene(&plan, &end, |snapshot| watch.observe(snapshot)).map_err(failed)?;
    let facts = result.facts(String::new());
    let report::Report { summary, missing } = report::write(folder, &facts)?;
    let (name, outcome) = (&plan.scene.name, &facts.outcome);
    sheet.line(&format!("scene {name}, {minutes} minutes in real time, recorded; {outcome}"));
    slowed.iter().for_each(|line| sheet.line(line));
    sheet.line("");
    tell_run(&result, &summary, sheet);
    sheet.set("outcome", json!(outcome));
    sheet.set("summary", json!(summary));
    let grown = tell_memory(&watch.growth, sheet);
    sheet.machine(&machine);
    let mut problems = check(&plan.scene, folder, &result, sheet)?;
    problems.extend(missing.iter().map(ToString::to_string));
    sheet.set("problems", json!(problems.iter().chain(&grown).collect::<Vec<_>>()));
    match (&result.outcome, problems.first().or(grown.first())) {
        (_, Some(problem)) => Err(Failure::failed(problem)),
        (Outcome::Interrupted, None) => {
            let message =
                format!("interrupted after {:.1} of {minutes} minutes", result.running.as_secs_f64() / 60.0);
            Err(Failure { message, code: EXIT_INTERRUPTED })
        }
        (_, None) => Ok(()),
    }
}

/// Slows each feed that would end before most of the run is over; returns a description of each.
fn slow_down(scene: &mut Scene) -> Vec<String> {
    let feed_s = FEED_SHARE * scene.run.duration_s;
    let mut said = Vec::new();
    for controller in &mut scene.controller {
        let (length_mm, feed_mm_per_s) = match (&mut controller.curved_drilling, &mut controller.skiving) {
            (Some(plan), _) => (plan.insertion_mm, &mut plan.feed_mm_per_s),
            (None, Some(plan)) => (plan.depth_mm, &mut plan.feed_mm_per_s),
            (None, None) => continue,
        };
        let slow_mm_per_s = (length_mm / feed_s).max(SLOWEST_MM_PER_S);
        if slow_mm_per_s < *feed_mm_per_s {
            *feed_mm_per_s = slow_mm_per_s;
            let drills_min = length_mm / slow_mm_per_s / 60.0;
            said.push(format!(
                "`{}` feeds at {slow_mm_per_s:.4} mm/s, so that it drills for {drills_min:.1} minutes",
                controller.name
            ));
        }
    }
    said
}

/// Observations during the run.
struct Watch {
    minutes: f64,
    policy: Policy,
    /// Time of the first tick.
    began: Option<Instant>,
    samples: usize,
    growth: Growth,
}

impl Watch {
    fn new(minutes: f64, policy: Policy) -> Watch {
        Watch { minutes, policy, began: None, samples: 0, growth: Growth::default() }
    }

    fn observe(&mut self, snapshot: &RunSnapshot) {
        if self.began.is_none() {
            if snapshot.status.is_none_or(|status| status.phase().is_ok_and(|phase| phase < Phase::Running)) {
                return;
            }
            // The parts have started. This thread only serves the display and must not compete with them.
            prioritise(Role::Viewer, self.policy);
        }
        let at = self.began.get_or_insert_with(Instant::now).elapsed();
        let due_s = self.samples as f64 * self.minutes * 60.0 / SAMPLES;
        if at.as_secs_f64() < due_s || snapshot.parts.is_empty() {
            return;
        }
        // A process that has ended has no private memory.
        for part in snapshot.parts.iter().filter(|part| part.is_running()) {
            self.growth.add(&part.name, at, part.memory.private);
        }
        let mut own = Memory::default();
        own.measure("self");
        self.growth.add(HubPart::Host.name(), at, own.private);
        if self.samples.is_multiple_of(SAMPLES_PER_LINE) {
            let done_min = at.as_secs_f64() / 60.0;
            let missed = snapshot.status.map_or(0, |status| status.missed_ticks);
            let left_min = (self.minutes - done_min).max(0.0);
            tell!(
                "{done_min:.1} min, {missed} ticks missed, {} frames; about {left_min:.1} min left",
                snapshot.frames
            );
        }
        self.samples += 1;
    }
}

fn tell_run(result: &RunResult, summary: &Summary, sheet: &Sheet) {
    let row = |name: &str, text: &str| sheet.line(&format!("{name:<46} {text}"));
    let share = 100.0 * summary.timing.missed_ticks as f64 / summary.ticks.max(1) as f64;
    row("run", &format!("{:.2} s wall, {} ticks", result.running.as_secs_f64(), summary.ticks));
    row("ticks missed", &format!("{} ({share:.3} %)", summary.timing.missed_ticks));
    let misses = &summary.timing.misses;
    for (cause, count) in &misses.by_cause {
        let lost_ms = misses.lost_ms.get(cause).copied().unwrap_or(0.0);
        row(&format!("  cause: {cause}"), &format!("{count} ({lost_ms:.1} ms lost)"));
    }
    if misses.not_recorded > 0 {
        row("  not recorded", &misses.not_recorded.to_string());
    }
    if let Some(confirmed) = misses.confirmed_share {
        let stolen_ms = misses.lost_ms.get("stolen").copied().unwrap_or(0.0);
        let counter_ms = misses.steal_counter_ms;
        row("  with a cause confirmed by readings", &format!("{:.1} % of the lost time", 100.0 * confirmed));
        let text = format!("{stolen_ms:.1} ms; the machine's counter {counter_ms:.0} ms at these ticks");
        row("  stolen", &text);
    }
    row("ticks with a late command", &misses.late_controller_ticks.to_string());
    if let Some(late) = summary.timing.lateness_us {
        let text = format!(
            "p50 {:.1}  p99 {:.1}  p99.9 {:.1}  max {:.1} us",
            late.p50, late.p99, late.p99_9, late.max
        );
        row("lateness of ticks", &text);
    }
    if let Some(drr) = &summary.drr {
        let rate = drr.frames_per_wall_s.map_or(String::new(), |rate| format!(", {rate:.2} per second"));
        row("frames", &format!("{}{rate}", drr.frames));
    }
    if let Some(drilling) = &summary.drilling {
        let text = format!(
            "{} voxels, contact in {:.1} % of ticks",
            drilling.removed_voxels,
            100.0 * drilling.contact_share
        );
        row("drilled", &text);
    }
    let dropped: u64 = summary.logs.lost_messages.values().sum();
    row("messages missed by a reader", &dropped.to_string());
    for (name, memory) in &result.memory {
        let [resident, private] =
            [memory.peak_resident, memory.peak_private].map(|bytes| bytes as f64 / MEBIBYTE);
        row(&format!("{name}: peak resident, private"), &format!("{resident:.1} MiB, {private:.1} MiB"));
    }
}

/// Prints the table of private memory; returns the processes that have grown.
fn tell_memory(growth: &Growth, sheet: &mut Sheet) -> Vec<String> {
    let head = ["private memory", "start", "middle", "end", "growth/min"];
    let columns = |cells: [&str; 5]| {
        let [name, start, middle, end, rate] = cells;
        format!("{name:<22} {start:>12} {middle:>12} {end:>12} {rate:>16}")
    };
    sheet.line(&format!("\n{}", columns(head)));
    let mut grown = Vec::new();
    for (name, curve) in growth.curves() {
        let [start, middle, end] = curve.bytes.map(|bytes| format!("{:.2} MiB", bytes as f64 / MEBIBYTE));
        let rate = format!("{:.1} KiB", curve.bytes_per_minute / 1024.0);
        sheet.line(&columns([name, &start, &middle, &end, &rate]));
        sheet.push(
            "own_memory",
            json!({"name": name, "start_middle_end_bytes": curve.bytes,
                   "growth_bytes_per_min": curve.bytes_per_minute}),
        );
        if curve.growth_bytes() > FLAT_BYTES {
            grown.push(format!("the memory of `{name}` grows by {rate} per minute, from {start} to {end}"));
        }
    }
    sheet
        .line("start: after a tenth of the run; growth: median slope of all pairs of samples from then on\n");
    grown
}

/// Checks the logs: reads them to their ends and replays every tick. Returns the defects found.
fn check(
    scene: &Scene,
    folder: &Path,
    result: &RunResult,
    sheet: &mut Sheet,
) -> Result<Vec<String>, Failure> {
    let mut problems = Vec::new();
    if matches!(
        result.outcome,
        Outcome::PartDied { .. } | Outcome::ControllerFailed(_) | Outcome::SimulationFailed(_)
    ) {
        problems.push(result.outcome.text());
    }
    let mut simulated_s = 0.0;
    for lane in LANES {
        let path = folder.join(lane);
        match lane_end(&path) {
            Ok((messages, end_s)) => {
                simulated_s = end_s;
                let megabytes = std::fs::metadata(&path).map_err(failed)?.len() as f64 * 1e-6;
                let rate = megabytes / end_s.max(1e-3);
                let text = format!("{megabytes:.1} MB, {rate:.2} MB/s, {messages} messages, none lost");
                sheet.line(&format!("{lane:<46} {text}"));
                sheet.push("logs", json!({"file": lane, "megabytes": megabytes, "messages": messages}));
            }
            Err(problem) => problems.push(problem),
        }
    }
    let run_log = folder.join("run.mcap");
    let shown = frames(&LogFile::at(&run_log), ReadOptions::default()).map_err(failed)?;
    let missing = shown.filter_map(Result::err).next().map(|error| error.to_string());
    if scene.drr.is_some() {
        let text = missing.as_deref().unwrap_or("yes");
        sheet.row("every frame in the log", text, "has_every_frame", json!(missing.is_none()));
    }
    problems.extend(missing);
    match timed_verification(&run_log) {
        Ok((verify_s, threads)) => {
            let speed = simulated_s / verify_s;
            let text = format!("yes; {verify_s:.1} s, {speed:.1} times real time, {threads} threads");
            sheet.row("verified by replay", &text, "replays", json!(true));
        }
        Err(failure) => {
            sheet.row("verified by replay", "no", "replays", json!(false));
            problems.push(failure.message);
        }
    }
    Ok(problems)
}

/// Reads a lane to its end; returns its number of messages and the simulated time of the last one. The lane
/// must have its end marker and no losses; the error states the defect.
fn lane_end(path: &Path) -> Result<(u64, f64), String> {
    let wrong = |error: run_log::LogError| format!("{}: {error}", path.display());
    let mut stream = MessageStream::open(&LogFile::at(path), ReadOptions::default()).map_err(wrong)?;
    let (mut messages, mut end_ns) = (0_u64, 0);
    while let Some(message) = stream.next_message().map_err(wrong)? {
        messages += 1;
        end_ns = message.log_time_ns;
    }
    let verdict = stream.verdict();
    if !verdict.is_intact() {
        return Err(format!("{}: {verdict}", path.display()));
    }
    Ok((messages, end_ns as f64 * 1e-9))
}
