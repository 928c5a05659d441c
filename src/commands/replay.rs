//! `trabecula replay LOG`: steps the physics through a log's latched commands again.

use std::path::PathBuf;
use std::time::Instant;

use clap::Args;
use foreign_text::counted;
use recorder_proc::exit_code::exit_code;
use run_log::Verdict;
use run_log::hash_text;
use run_log::segments::{SegmentOptions, SegmentReport, SkippedGap, keyframe_before, verify_segments};
use run_log::verify::ReplayReport;
use serde_json::json;

use ipc_types::messages::{Tick, TickRange};
use ipc_types::process::EXIT_GAP;

use crate::commands::{in_order, log_name};
use crate::failure::Failure;
use crate::feasibility::is_program;
use crate::launcher::volume_source::VolumeFiles;
use crate::replay::{
    ComparedFrames, LivePlan, OpenedLog, Overrides, ReplayRecording, record, run_live, step, verify_frames,
};
use crate::say::{Figures, path_text};

/// Arguments of `replay`.
#[derive(Debug, Args)]
pub struct ReplayArguments {
    /// `run.mcap`, or the folder of a run; `latest` is the newest run in `out`.
    #[arg(value_parser = log_name())]
    log: PathBuf,
    /// Compare hash, state and removed voxels at every tick, and all keyframes; report the first difference
    /// and exit with code 1.
    #[arg(long)]
    verify: bool,
    /// First tick, or seconds such as `1.5s`. Stepping starts at the last keyframe before it.
    #[arg(long, value_parser = Moment::parse)]
    from: Option<Moment>,
    /// Last tick, or seconds.
    #[arg(long, value_parser = Moment::parse)]
    to: Option<Moment>,
    /// Number of threads; default: one per core.
    #[arg(long, value_parser = clap::value_parser!(u16).range(1..=256))]
    threads: Option<u16>,
    /// Re-render the X-ray frames and compare them.
    #[arg(long)]
    frames: bool,
    /// Record the replay to `run.mcap` in this folder and compare it with the original file.
    #[arg(short, long, value_name = "FOLDER", conflicts_with_all = ["from", "to"])]
    output: Option<PathBuf>,
    /// Run this program as one of the scene's controllers, feed it the logged states and compare its
    /// commands. May be repeated.
    #[arg(long, value_name = "[NAME=]COMMAND", conflicts_with_all = ["verify", "from", "frames", "output"])]
    controller: Vec<String>,
    /// With `--controller`: step the physics with the program's commands, in lockstep.
    #[arg(long, requires = "controller")]
    closed_loop: bool,
    /// Current path of the log's CT file; its content must be the same.
    #[arg(long, value_name = "PATH")]
    volume: Option<PathBuf>,
    /// Replay the commands in this scene; if it differs from the log's, `--allow-mismatch` is needed.
    #[arg(long, value_name = "FILE")]
    scene: Option<PathBuf>,
    /// Replay even if the log's build, layout, scene or volume differs; the result is marked accordingly.
    #[arg(long)]
    allow_mismatch: bool,
    #[command(flatten)]
    volume_files: VolumeFiles,
    #[command(flatten)]
    figures: Figures,
}

/// A tick, or simulated time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Moment {
    /// `State.tick`.
    Tick(u64),
    /// Seconds.
    Seconds(f64),
}

impl Moment {
    fn parse(text: &str) -> Result<Moment, String> {
        let seconds = text.strip_suffix('s').and_then(|number| number.trim().parse::<f64>().ok());
        match (seconds, text.parse()) {
            (Some(seconds), _) if (0.0..=1e9).contains(&seconds) => Ok(Moment::Seconds(seconds)),
            (None, Ok(tick)) => Ok(Moment::Tick(tick)),
            _ => Err("expected a tick such as 1500, or seconds such as 1.5s".to_owned()),
        }
    }

    fn tick(self, dt_ns: u64) -> Tick {
        match self {
            Moment::Tick(tick) => Tick(tick),
            Moment::Seconds(seconds) => Tick((seconds * 1e9 / dt_ns as f64 + 0.5) as u64),
        }
    }
}

/// Replays a log.
///
/// # Errors
/// Bad input (2): not a log, or a different build, layout, scene or volume. A difference, or a damaged log
/// (1). Everything in the log is identical, but it has a gap, is truncated or was not ended (3).
pub fn run(arguments: &ReplayArguments) -> Result<(), Failure> {
    let overrides = Overrides {
        volume: arguments.volume.clone(),
        scene: arguments.scene.clone(),
        allow_mismatch: arguments.allow_mismatch,
        volume_files: arguments.volume_files,
    };
    let log = OpenedLog::open(&arguments.log, &overrides)?;
    let (dt_ns, begin) = {
        let reader = log.reader()?;
        (reader.header().dt_ns, reader.header().first_tick)
    };
    let first = arguments.from.map_or(Tick::START, |moment| moment.tick(dt_ns));
    let last = arguments.to.map(|moment| moment.tick(dt_ns));
    let ticks = in_order(TickRange { first, last })?;
    for (option, tick) in [("--from", arguments.from.map(|_| first)), ("--to", last)] {
        if let Some(tick) = tick.filter(|tick| *tick < begin) {
            let why = format!("{option} is tick {tick}, but the log begins at tick {begin}");
            return Err(Failure::bad_input(why));
        }
    }
    if !arguments.controller.is_empty() {
        return live(arguments, &log, last.unwrap_or(Tick(u64::MAX)));
    }
    if let Some(folder) = &arguments.output {
        let threads = arguments.frames.then(|| arguments.threads());
        return tell_recorded(&record(&log, folder, threads)?, &log, arguments.figures);
    }
    let (code, mut figures) = replay(arguments, &log, ticks)?;
    if arguments.frames {
        let of_frames = replay_frames(arguments, &log, ticks)?;
        figures["frames"] = of_frames;
    }
    if arguments.figures.json {
        say!("{figures}");
    }
    match code {
        0 => Ok(()),
        code => Err(Failure {
            message: "all readable ticks were replayed, but the log is not intact: see above".to_owned(),
            code,
        }),
    }
}

impl ReplayArguments {
    fn threads(&self) -> usize {
        let cores = || std::thread::available_parallelism().map_or(1, usize::from);
        self.threads.map_or_else(cores, usize::from)
    }
}

/// Re-renders the frames of a range, compares them, and prints the result or returns it for `--json`.
fn replay_frames(
    arguments: &ReplayArguments,
    log: &OpenedLog,
    ticks: TickRange,
) -> Result<serde_json::Value, Failure> {
    let began = Instant::now();
    let threads = arguments.threads();
    let ComparedFrames { identical, in_gaps, without_request } = verify_frames(log, ticks, threads)?;
    let wall_s = began.elapsed().as_secs_f64();
    if !arguments.figures.json {
        let label = log.label();
        let (frames, threads) = (counted(identical, "frame"), counted(threads, "thread"));
        say!("re-rendered {frames} on {threads}, all identical{label}, in {wall_s:.3} s");
        if in_gaps > 0 {
            say!("skipped {} in a gap of the log", counted(in_gaps, "frame"));
        }
        if without_request > 0 {
            say!(
                "{without_request} on-demand frames have no request in timing.mcap, so their C-arm pose was \
                 not compared"
            );
        }
    }
    Ok(json!({
        "identical": identical, "in_gaps": in_gaps, "without_request": without_request, "wall_s": wall_s,
    }))
}

/// Steps the physics from the last keyframe before the range (or the start) to its last tick (or the end).
/// Returns the exit code, and the figures for `--json`.
fn replay(
    arguments: &ReplayArguments,
    log: &OpenedLog,
    ticks: TickRange,
) -> Result<(u8, serde_json::Value), Failure> {
    let TickRange { first: from, last: to } = ticks;
    let began = Instant::now();
    let start = if from > Tick::START { keyframe_before(log.reader()?, from) } else { None };
    let options = SegmentOptions { start, to_tick: to, threads: arguments.threads() };
    let (found, verdict) = if arguments.verify {
        let mut reader = log.reader()?;
        let found = verify_segments(&mut reader, &|| log.simulation(), &options);
        (found, reader.stream().verdict())
    } else {
        step(log, options)?
    };
    let report = &found.replay;
    // A replay that stopped early on request has not read how the log ends.
    let at_end = to.is_none_or(|to| report.last_tick < to) && report.is_identical();
    let verdict = at_end.then_some(verdict);
    let wall_s = began.elapsed().as_secs_f64();
    let ended_early = report.log_error.is_none() && report.simulation_error.is_none();
    if ended_early && report.divergence.is_none() && from > Tick::START {
        let last = report.last_tick;
        if from > last {
            return Err(Failure::bad_input(format!(
                "--from is tick {from}, but the log ends at tick {last}"
            )));
        }
        if report.identical_ticks == 0 {
            return Err(Failure::bad_input(format!(
                "--from is tick {from}, but the log has no complete tick after it"
            )));
        }
    }
    refuse_differences(report, &log.label())?;
    if !arguments.figures.json {
        tell(arguments, &found, verdict.as_ref(), &log.label(), wall_s);
    }
    let of_gaps = if found.gaps.is_empty() { 0 } else { EXIT_GAP };
    let code = verdict.as_ref().map_or(of_gaps, |verdict| exit_code(verdict).max(of_gaps));
    let ticks = |gap: &SkippedGap| [gap.after, gap.resumed].map(|tick| tick.map(|tick| tick.0));
    let figures = json!({
        "verified": arguments.verify,
        "first_tick": found.first_tick.0,
        "ticks": report.identical_ticks,
        "last_tick": report.last_tick.0,
        "hash": hash_text(report.hash),
        "simulated_s": report.simulated_ns as f64 * 1e-9,
        "wall_s": wall_s,
        "identical_keyframes": found.identical_keyframes,
        "simulation_failed": report.failure,
        "gaps_after_and_resumed": found.gaps.iter().map(ticks).collect::<Vec<_>>(),
        "intact": verdict.as_ref().map(Verdict::is_intact),
    });
    Ok((code, figures))
}

/// Fails if the replay differs from the log, or if either could not continue.
fn refuse_differences(report: &ReplayReport, label: &str) -> Result<(), Failure> {
    if let Some(error) = &report.log_error {
        let last = report.last_tick;
        return Err(Failure::failed(format!("the log cannot be read beyond tick {last}: {error}")));
    }
    if let Some((tick, cause)) = &report.simulation_error {
        return Err(Failure::failed(format!("the simulation fails at tick {tick}: {cause}{label}")));
    }
    match &report.divergence {
        Some(divergence) => Err(Failure::failed(format!("{divergence}{label}"))),
        None => Ok(()),
    }
}

/// Maximum number of gaps listed individually.
const MAX_GAPS_LISTED: usize = 64;

/// Prints the result of a replay without differences; `verdict` is the log's, if it was read to its end.
fn tell(
    arguments: &ReplayArguments,
    found: &SegmentReport,
    verdict: Option<&Verdict>,
    label: &str,
    wall_s: f64,
) {
    let report = &found.replay;
    let simulated_s = report.simulated_ns as f64 * 1e-9;
    let from = match found.first_tick > Tick::START {
        true => format!(" from the keyframe of tick {}", found.first_tick),
        false => String::new(),
    };
    say!(
        "replayed {}{from}{}{label}; last tick {}, hash {}; {simulated_s:.3} s simulated in \
         {wall_s:.3} s, {:.1} times real time",
        counted(report.identical_ticks, "tick"),
        if arguments.verify { ", all identical" } else { "" },
        report.last_tick,
        hash_text(report.hash),
        simulated_s / wall_s.max(1e-9)
    );
    if arguments.verify {
        say!("{}, all identical", counted(found.identical_keyframes, "keyframe"));
    }
    if let Some(failure) = &report.failure {
        say!("then the simulation fails as in the run: {failure}");
    }
    found.gaps.iter().take(MAX_GAPS_LISTED).for_each(|gap| say!("{gap}"));
    if let Some(more) = found.gaps.len().checked_sub(MAX_GAPS_LISTED).filter(|more| *more > 0) {
        say!("and {more} more gaps");
    }
    if let Some(verdict) = verdict {
        say!("{}", report.ending.describe());
        if !verdict.is_intact() {
            say!("{verdict}");
        }
    }
}

fn tell_recorded(recorded: &ReplayRecording, log: &OpenedLog, figures: Figures) -> Result<(), Failure> {
    let ReplayRecording { path, ticks, frames, sha256, remark } = recorded;
    let [theirs, ours] = sha256;
    if figures.json {
        say!("{}", json!({"output": path_text(path), "ticks": ticks, "frames": frames, "sha256": sha256}));
    } else {
        say!("re-recorded {} and {}{}", counted(ticks, "tick"), counted(frames, "frame"), log.label());
        say!("sha256 {theirs}  {}\nsha256 {ours}  {}", log.path.display(), path.display());
        remark.iter().for_each(|remark| say!("{remark}"));
        if theirs == ours {
            say!("the files are identical");
        }
    }
    match theirs == ours {
        true => Ok(()),
        false => Err(Failure::failed(
            "all messages are identical, but the files differ: see above how the log ends",
        )),
    }
}

fn live(arguments: &ReplayArguments, log: &OpenedLog, to_tick: Tick) -> Result<(), Failure> {
    log.require_start("replayed with programs")?;
    let controllers = arguments.controller.iter().map(|text| controller(text, log));
    let plan = LivePlan {
        controllers: controllers.collect::<Result<_, _>>()?,
        closed_loop: arguments.closed_loop,
        to_tick,
    };
    let label = log.label();
    let compared = run_live(log, &plan)?;
    arguments.figures.say(
        || {
            let line = |(name, commands): &(String, u64)| {
                format!("controller `{name}`: {}, all identical{label}", counted(commands, "command"))
            };
            compared.iter().map(line).collect::<Vec<_>>().join("\n")
        },
        || {
            let of = |(name, commands): &(String, u64)| json!({"name": name, "identical_commands": commands});
            json!({"controllers": compared.iter().map(of).collect::<Vec<_>>()})
        },
    );
    Ok(())
}

/// Parses `NAME=COMMAND`, or only the command if the scene has one controller. Splits words like a shell.
fn controller(text: &str, log: &OpenedLog) -> Result<(String, Vec<String>), Failure> {
    let names = log.scene.controller_names();
    let named = text.split_once('=').filter(|(name, _)| names.iter().any(|of_scene| of_scene == name));
    let is_name = |name: &str| name.chars().all(|c| c.is_alphanumeric() || matches!(c, '_' | '-'));
    let is_misnamed = named.is_none() && text.split_once('=').is_some_and(|(name, _)| is_name(name));
    let (name, command) = match (named, names.as_slice()) {
        (Some((name, command)), _) => (name.to_owned(), command),
        (None, [only]) if !is_misnamed => (only.clone(), text),
        (None, _) => {
            let names = names.join("`, `");
            return Err(Failure::bad_input(format!(
                "--controller {text}: expected NAME=COMMAND, where NAME is a controller of the log's scene: \
                 `{names}`"
            )));
        }
    };
    let words = shlex::split(command).filter(|words| !words.is_empty());
    let words = words.ok_or_else(|| {
        Failure::bad_input(format!(
            "--controller {text}: expected a program; it is empty or has an unclosed quote"
        ))
    })?;
    if !is_program(&words[0]) {
        return Err(Failure::bad_input(format!(
            "--controller {text}: program `{}` not found; expected a path, or a name in PATH",
            words[0]
        )));
    }
    Ok((name, words))
}
