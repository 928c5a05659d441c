//! `trabecula run SCENE`: runs a scene from start to finish.

use std::net::Ipv4Addr;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use clap::Args;
use figures::FigureError;
use ipc_types::messages::services::RECORDER_QUEUE_TICKS;
use ipc_types::process::{EXIT_CAUTION, EXIT_GAP, Role, prioritise};
use ipc_types::scene::{Images, LONGEST_RUN_S, Mode, Policy, Scene, Wait};
use output_file::OutputError;
use voxel_grid::Ct;

use super::{Choice, choice};
use crate::failure::{EXIT_INTERRUPTED, Failure};
use crate::feasibility;
use crate::fmu_controller;
use crate::launcher::hub::{Recording, View, refuse_scarce_memory, session_plan};
use crate::launcher::interrupt::{Interrupts, remove_empty};
use crate::launcher::part::{self, PartProcess};
use crate::launcher::progress::{Display, ProgressStyle};
use crate::launcher::run::{Outcome, RunPlan, RunResult, output_folder, run_with};
use crate::launcher::volume_source::{self, VolumeFiles};
use crate::plan;
use crate::printer;
use crate::redirect_file;
use crate::report;
use crate::say::path_text;
use crate::scenes::{BuiltIn, SceneSource};

/// Interval at which the end of the viewer is polled.
const VIEWER_LOOK: Duration = Duration::from_millis(100);

/// Arguments of `run`.
#[derive(Debug, Args)]
pub struct RunArguments {
    /// Scene file; default: the built-in femur.
    scene: Option<PathBuf>,
    /// Override a key of the scene, such as `run.duration_s=2` or `controller.0.optional=true` (may be
    /// repeated).
    #[arg(long = "set", value_name = "KEY=VALUE")]
    settings: Vec<String>,
    /// Lockstep or real time; overrides the scene.
    #[arg(long, value_parser = choice(&MODES))]
    mode: Option<Mode>,
    /// Simulated seconds; overrides the scene.
    #[arg(long)]
    duration_s: Option<f64>,
    /// Parent of the run's folder.
    #[arg(short, long, default_value = "out")]
    output: PathBuf,
    /// Do not record.
    #[arg(long, conflicts_with_all = ["output", "images", "image_every"])]
    no_record: bool,
    /// What to record of each X-ray frame; overrides the scene.
    #[arg(long, value_parser = choice(&IMAGES))]
    images: Option<Images>,
    /// Record the image of every Nth frame and only the hash of the others; needs `--images full`.
    #[arg(long, value_name = "N")]
    image_every: Option<u64>,
    /// How physics and controllers wait; overrides the scene.
    #[arg(long, value_parser = choice(&WAITS))]
    wait: Option<Wait>,
    /// Scheduling policy of physics and controllers; overrides the scene.
    #[arg(long, value_parser = choice(&POLICIES))]
    policy: Option<Policy>,
    /// Show the run in the browser, on this port if given.
    #[arg(long, value_name = "PORT", num_args = 0..=1, require_equals = true, default_missing_value = "8765")]
    view: Option<u16>,
    /// With `--view`: let anyone who can reach the port watch without the token.
    #[arg(long, requires = "view")]
    watch_by_anyone: bool,
    #[command(flatten)]
    volume_files: VolumeFiles,
    /// Exit with code 4 if the finished run has cautions: a missed target, a breach of the bone, forces, and
    /// whatever else the table at its end lists.
    #[arg(long, value_parser = choice(&FAIL_ON), conflicts_with = "no_record")]
    fail_on: Option<FailOn>,
    /// Hide the progress line.
    #[arg(long)]
    quiet: bool,
    /// Print JSON lines on standard output, for scripts, instead of the progress line and the summary table.
    #[arg(long, conflicts_with = "quiet")]
    json: bool,
}

impl RunArguments {
    fn style(&self) -> ProgressStyle {
        match (self.quiet, self.json) {
            (true, _) => ProgressStyle::Quiet,
            (false, true) => ProgressStyle::Json,
            (false, false) => ProgressStyle::Text,
        }
    }
}

/// What counts as a failure of a finished run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum FailOn {
    Caution,
}

/// Values of `--fail-on`.
const FAIL_ON: [Choice<FailOn>; 1] = [("caution", "Any caution", FailOn::Caution)];

/// Values of `--mode`.
const MODES: [Choice<Mode>; 2] = [
    ("lockstep", "As fast as the parts allow", Mode::Lockstep),
    ("realtime", "In step with the wall clock", Mode::Realtime),
];

/// Values of `--images`.
const IMAGES: [Choice<Images>; 3] = [
    ("full", "The whole image", Images::Full),
    ("hash-only", "Only geometry and hash", Images::HashOnly),
    ("none", "Nothing", Images::None),
];

/// Values of `--wait`.
pub const WAITS: [Choice<Wait>; 3] = [
    ("spin", "Busy-wait, as long as there are more cores than spinning parts", Wait::Spin),
    ("event", "Sleep at once", Wait::Event),
    ("hybrid", "Poll briefly while no other process needs the core, then sleep", Wait::Hybrid),
];

/// Values of `--policy`.
pub const POLICIES: [Choice<Policy>; 2] = [
    ("other", "`SCHED_OTHER` with a higher weight (a negative nice value)", Policy::Other),
    ("fifo", "`SCHED_FIFO`: ahead of all ordinary programs", Policy::Fifo),
];

/// Runs a scene.
///
/// # Errors
/// Bad input (exit code 2); a part that died, a log that disappeared, an incomplete report, an unwritable
/// output (1); a log with a gap (3); cautions, where they count (4); Ctrl-C (130).
pub fn run(arguments: &RunArguments) -> Result<(), Failure> {
    printer::start().map_err(|cause| Failure::failed(format!("cannot write to standard output: {cause}")))?;
    let interrupts = Interrupts::install().map_err(Failure::signals)?;
    let source = SceneSource::new(arguments.scene.as_deref(), BuiltIn::Femur).with(&arguments.settings)?;
    let scene = scene_of(arguments, &source)?;
    if let Some(choice) = xray::from_scene::tolerance_text(&scene).filter(|_| !arguments.json) {
        say!("{choice}");
    }
    volume_source::refuse_missing(&source, &scene)?;
    refuse_taken_port(arguments)?;
    // The volume's size is known only when it is loaded; the session checks again with it.
    let recording = if arguments.no_record { Recording::Off } else { Recording::On };
    refuse_scarce_memory(&session_plan(&scene, None, recording)).map_err(|error| match scene.volume {
        Some(_) => Failure::bad_input(format!("{error}; its CT, which is not loaded yet, needs more")),
        None => error.into(),
    })?;
    let output = match arguments.no_record {
        true => None,
        false => {
            let made = interrupts.make_folder(&arguments.output, |parent| output_folder(parent, &scene));
            Some(made.map_err(|cause| {
                let output = &arguments.output;
                let why = match output.is_file() {
                    true => "is a file; expected a folder".to_owned(),
                    false => format!("cannot be created ({cause})"),
                };
                Failure::bad_input(format!("--output {}: {why}", output.display()))
            })?)
        }
    };
    redirect_file::sweep(&redirect_file::folder());
    let view = arguments.view.map(|port| View { port, watch_by_anyone: arguments.watch_by_anyone });
    if view.is_none() {
        part::adopt();
    }
    let plan = RunPlan { scene, output, view, volume_files: arguments.volume_files };
    let mut display = Display::new(arguments.style())?;
    let began = Instant::now();
    let volume = volume_of(&plan, &source);
    let empty = interrupts.run_begins();
    let mut shown = false;
    let result = volume.and_then(|volume| {
        let ran = run_with(&plan, volume, began, &interrupts.end, |snapshot| {
            // The parts have started. Everything from here on only serves the display and must not compete
            // with them.
            if !std::mem::replace(&mut shown, true) && plan.scene.run.mode == Mode::Realtime {
                prioritise(Role::Viewer, plan.scene.run.policy);
            }
            display.show(snapshot);
        });
        ran.map_err(Failure::from)
    });
    display.end();
    interrupts.report_begins();
    // If nothing was recorded, remove the folders that this run created.
    remove_empty(&empty);
    let mut result = result?;
    let is_to_report = match result.outcome {
        Outcome::LogGone(_) => false,
        _ => !interrupts.end.is_urgent(),
    };
    let output = plan.output.as_deref().filter(|output| is_to_report && output.exists());
    let written = match output {
        Some(output) => write_report(&result, output, arguments),
        None => {
            tell_outcome(&result, arguments.json);
            Ok(())
        }
    };
    let judged = judge(&result).and(written);
    if let Some(viewer) = result.viewer.take() {
        interrupts.showing_begins(judged.as_ref().map_or_else(|failure| failure.code, |()| 0));
        show_on(viewer, arguments);
    }
    judged
}

/// Checks early that the viewer can listen on its port; otherwise the run would continue without its page.
fn refuse_taken_port(arguments: &RunArguments) -> Result<(), Failure> {
    let Some(port) = arguments.view else { return Ok(()) };
    match std::net::TcpListener::bind((Ipv4Addr::LOCALHOST, port)) {
        Ok(_) => Ok(()),
        Err(cause) => Err(Failure::bad_input(format!(
            "--view={port}: cannot listen on the port ({cause}); choose a free one"
        ))),
    }
}

/// Keeps the viewer open on the run's log until the page is closed.
fn show_on(mut viewer: PartProcess, arguments: &RunArguments) {
    if arguments.style() == ProgressStyle::Text {
        say!("the page now shows the log; this command ends when the page is closed, or on Ctrl-C");
    }
    while viewer.ended().is_none() {
        std::thread::sleep(VIEWER_LOOK);
    }
}

/// Loads the scene's volume, checks that the scene is feasible, and prints the notes and warnings.
fn volume_of(plan: &RunPlan, source: &SceneSource) -> Result<Option<Ct>, Failure> {
    let loaded =
        volume_source::load_with_notes(&plan.scene, plan.volume_files).map_err(Failure::bad_input)?;
    loaded.iter().flat_map(|loaded| &loaded.notes).for_each(|note| tell!("{note}"));
    let ct = loaded.map(|loaded| loaded.ct);
    let warnings = feasibility::check(&plan.scene, source, ct.as_ref().map(|ct| &ct.volume))?;
    fmu_controller::check(&plan.scene, source)?;
    warnings.iter().for_each(|warning| tell!("{warning}"));
    Ok(ct)
}

fn scene_of(arguments: &RunArguments, source: &SceneSource) -> Result<Scene, Failure> {
    let (mut scene, choice) = plan::load_scene(source)?;
    if let Some(choice) = choice.filter(|_| !arguments.json) {
        say!("{choice}");
    }
    scene.run.mode = arguments.mode.unwrap_or(scene.run.mode);
    scene.recording.images = arguments.images.unwrap_or(scene.recording.images);
    scene.run.wait = arguments.wait.unwrap_or(scene.run.wait);
    scene.run.policy = arguments.policy.unwrap_or(scene.run.policy);
    if arguments.no_record && scene.recording.ring_s > 0.0 {
        let keys = "`--no-record` and `recording.ring_s` are mutually exclusive; use only one";
        return Err(Failure::bad_input(keys));
    }
    if let Some(every) = arguments.image_every {
        if !(1..=1_000_000).contains(&every) || scene.recording.images != Images::Full {
            return Err(Failure::bad_input(format!(
                "--image-every is {every}; allowed: 1 to 1000000, with --images full"
            )));
        }
        scene.recording.image_every = every;
    }
    if let Some(duration_s) = arguments.duration_s {
        if !(0.001..=LONGEST_RUN_S).contains(&duration_s) {
            return Err(Failure::bad_input(format!(
                "--duration-s is {duration_s}; allowed: 0.001 to {LONGEST_RUN_S}"
            )));
        }
        scene.run.duration_s = duration_s;
    }
    Ok(scene)
}

/// Writes the figures and numbers, and prints the final table.
fn write_report(result: &RunResult, output: &Path, arguments: &RunArguments) -> Result<(), Failure> {
    let replay_command = format!("{} replay {} --verify", program_name(), output.display());
    let facts = result.facts(replay_command);
    let report = report::write(output, &facts)?;
    if arguments.json {
        let (session, outcome) = (path_text(&result.session), &report.summary.outcome);
        let ended = serde_json::json!({
            "phase": "ended", "session": session, "folder": path_text(output), "outcome": outcome,
            "began_ns": result.began_ns,
            "summary": report.summary,
        });
        say!("{ended}");
    } else if result.has_started {
        say!("{}", report.summary);
        say!("\nfolder       {}", output.display());
    } else {
        // Without a tick there is nothing to summarise or replay.
        tell_outcome(result, false);
        say!("folder       {}", output.display());
    }
    complete(&report.missing)?;
    match report.summary.problems() {
        0 => Ok(()),
        _ if arguments.fail_on != Some(FailOn::Caution) => Ok(()),
        count => Err(Failure {
            message: format!(
                "the run has {count} {}, treated as a failure (--fail-on caution)",
                if count == 1 { "caution" } else { "cautions" }
            ),
            code: EXIT_CAUTION,
        }),
    }
}

/// Prints the outcome of a run without a report.
fn tell_outcome(result: &RunResult, json: bool) {
    let outcome = result.outcome.text();
    if json {
        say!(
            "{}",
            serde_json::json!({"phase": "ended", "session": path_text(&result.session), "outcome": outcome})
        );
    } else {
        say!("outcome      {outcome}");
    }
}

/// Fails if files of the report are missing, and names them.
fn complete(missing: &[FigureError]) -> Result<(), Failure> {
    for error in missing {
        match error {
            FigureError::Output(OutputError::Exists { path }) => {
                tell!(
                    "trabecula: {}: not written: {} that does not belong to this run is in the way",
                    path.display(),
                    found(path)
                );
            }
            other => tell!("trabecula: {other}"),
        }
    }
    match missing.len() {
        0 => Ok(()),
        1 => Err(Failure::failed("one file of the report could not be written: see above")),
        more => Err(Failure::failed(format!("{more} files of the report could not be written: see above"))),
    }
}

/// Describes what is at a path.
fn found(path: &Path) -> String {
    match path.symlink_metadata().map(|found| (found.file_type(), found.len())) {
        Ok((kind, _)) if kind.is_symlink() => "a link".to_owned(),
        Ok((kind, _)) if kind.is_dir() => "a folder".to_owned(),
        Ok((kind, bytes)) if kind.is_file() => format!("a file of {bytes} bytes"),
        _ => "something".to_owned(),
    }
}

/// Returns the name under which this program was started.
fn program_name() -> String {
    std::env::args().next().unwrap_or_else(|| "trabecula".to_owned())
}

fn judge(result: &RunResult) -> Result<(), Failure> {
    let early = |why: &str| Err(Failure::failed(format!("the run ended early because {why}")));
    match &result.outcome {
        Outcome::Completed | Outcome::Stopped if result.has_gap => Err(Failure {
            message: format!(
                "the run is complete, but its log has a gap: the recorder stalled and its queues \
                 ({RECORDER_QUEUE_TICKS} ticks) overflowed; to make the physics wait instead, set \
                 `recording.on_full = \"wait\"`"
            ),
            code: EXIT_GAP,
        }),
        Outcome::Completed | Outcome::Stopped => Ok(()),
        Outcome::Interrupted => Err(Failure { message: "interrupted".to_owned(), code: EXIT_INTERRUPTED }),
        // The launcher has already reported the details.
        Outcome::ControllerFailed(blame) => {
            early(&format!("of controller `{}`", blame.controller.as_deref().unwrap_or_default()))
        }
        Outcome::SimulationFailed(_) => early("the simulation failed"),
        Outcome::PartDied { name, .. } => early(&format!("`{name}` ended")),
        Outcome::LogGone(_) => early("its log was removed or moved"),
    }
}
