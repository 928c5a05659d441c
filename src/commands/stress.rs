//! `trabecula stress SCENE`, and the competing processes that it starts.

use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::Args;
use ipc_types::process::EndRequest;
use ipc_types::scene::{Policy, Scene, Wait};

use super::choice;
use super::run::{POLICIES, WAITS};
use crate::failure::{EXIT_INTERRUPTED, Failure};
use crate::launcher::run::output_folder;
use crate::launcher::volume_source::VolumeFiles;
use crate::machine::allowed;
use crate::say::Figures;
use crate::scenes::{BuiltIn, SceneSource};
use crate::stress::plan::{self, Load, LoadKind};
use crate::stress::report::{StressReport, comparison, table};
use crate::stress::{self, StressPlan, load};

/// Arguments of `stress`.
#[derive(Debug, Args)]
pub struct StressArguments {
    /// Scene file, run in real time; default: the built-in femur.
    scene: Option<PathBuf>,
    /// Core counts to test; hub and competing load share the cores.
    #[arg(long, value_delimiter = ',', default_value = "1,2")]
    cores: Vec<usize>,
    /// Competing load: none, spin, memory, disk or fork; spin:2 starts two.
    #[arg(long, value_delimiter = ',', default_value = "none,spin:2")]
    load: Vec<Load>,
    /// Scheduling policies of physics and controllers to test.
    #[arg(long, value_parser = choice(&POLICIES), value_delimiter = ',', default_value = "other")]
    policy: Vec<Policy>,
    /// How physics and controllers wait.
    #[arg(long, value_parser = choice(&WAITS), value_delimiter = ',', default_value = "hybrid")]
    wait: Vec<Wait>,
    /// Seconds per combination, 0.1 to 3600.
    #[arg(long, default_value_t = 20.0)]
    seconds: f64,
    /// Seed of the load and of `--subset`.
    #[arg(long, default_value_t = 7)]
    seed: u64,
    /// Run only N combinations, chosen to cover as many pairs of settings as possible.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    subset: Option<u64>,
    /// CPU quota of hub and load together, in percent of one core; needs permission to create a control
    /// group.
    #[arg(long, value_name = "PERCENT", value_parser = clap::value_parser!(u64).range(1..=100_000))]
    quota: Option<u64>,
    /// Compare with the stress.json of an earlier test.
    #[arg(long, value_name = "JSON")]
    compare: Option<PathBuf>,
    /// Parent of the test's folder.
    #[arg(short, long, default_value = "out")]
    output: PathBuf,
    /// Keep the runs' folders.
    #[arg(long)]
    keep_logs: bool,
    #[command(flatten)]
    volume_files: VolumeFiles,
    #[command(flatten)]
    figures: Figures,
}

/// Runs a stress test.
///
/// # Errors
/// Bad input (2, and nothing is written); a failed run, or a log that does not replay (1); Ctrl-C (130, and
/// the report covers the finished runs).
pub fn run(arguments: &StressArguments) -> Result<(), Failure> {
    let plan = plan_of(arguments)?;
    let end = EndRequest::install().map_err(Failure::signals)?;
    let (report, interrupted) = stress::run(&plan, &end)?;
    let page = plan.output.join("index.html");
    arguments.figures.say(
        || told(&report, plan.compare.as_ref(), &page),
        || serde_json::json!({"page": page, "report": report}),
    );
    let done = report.tested.len();
    if interrupted {
        let message = format!("interrupted after {done} of {} combinations", report.planned);
        return Err(Failure { message, code: EXIT_INTERRUPTED });
    }
    let bad = report.tested.iter().find(|tested| tested.failure.is_some() || !tested.measured.replays);
    match bad {
        None => Ok(()),
        Some(tested) => {
            let why = tested.failure.clone().unwrap_or_else(|| tested.measured.remarks.join("; "));
            Err(Failure::failed(format!("{}: {why}", tested.combination)))
        }
    }
}

/// Formats the table, the changes since an earlier test, and the path of the report.
fn told(report: &StressReport, compare: Option<&StressReport>, page: &Path) -> String {
    let mut lines = vec![table(report)];
    if let Some(old) = compare {
        lines.push(format!("since {}: late p50, late p99, step p50, round trip p50, missed", old.began));
        lines.extend(comparison(old, report).iter().map(|row| format!("  {}", row.join(" | "))));
    }
    lines.extend(report.explained().map(|share| share.to_string()));
    lines.push(format!("report       {}", page.display()));
    lines.join("\n")
}

/// Rejects core counts outside 1 to `most`.
///
/// # Errors
/// A count out of range (2).
pub fn refuse_cores(given: &[usize], most: usize) -> Result<(), Failure> {
    match given.iter().find(|cores| !(1..=most).contains(*cores)) {
        None => Ok(()),
        Some(cores) => {
            Err(Failure::bad_input(format!("--cores is {cores}; allowed on this machine: 1 to {most}")))
        }
    }
}

fn plan_of(arguments: &StressArguments) -> Result<StressPlan, Failure> {
    let source = SceneSource::new(arguments.scene.as_deref(), BuiltIn::Femur);
    let scene = source.load()?;
    refuse_cores(&arguments.cores, allowed().map_or(1, |cores| cores.len()))?;
    if !(0.1..=3600.0).contains(&arguments.seconds) {
        return Err(Failure::bad_input(format!("--seconds is {}; allowed: 0.1 to 3600", arguments.seconds)));
    }
    if let Some(controller) =
        scene.controller.iter().find(|controller| controller.external && !controller.optional)
    {
        return Err(Failure::bad_input(format!(
            "controller `{}` is external, and a stress test cannot start it; give it a `command` in the \
             scene",
            controller.name
        )));
    }
    let compare = arguments.compare.as_deref().map(StressReport::read).transpose()?;
    let mut combinations = plan::all(&arguments.cores, &arguments.load, &arguments.policy, &arguments.wait);
    if let Some(count) = arguments.subset {
        combinations = plan::subset(&combinations, count as usize, arguments.seed);
    }
    let named = Scene { name: format!("stress-{}", scene.name), ..scene };
    let output = output_folder(&arguments.output, &named).map_err(|cause| {
        Failure::bad_input(format!("--output {}: cannot be created ({cause})", arguments.output.display()))
    })?;
    Ok(StressPlan {
        scene: source,
        combinations,
        seconds: arguments.seconds,
        seed: arguments.seed,
        quota_percent: arguments.quota,
        output,
        keeps_logs: arguments.keep_logs,
        volume_files: arguments.volume_files,
        compare,
    })
}

/// Arguments of a competing load.
#[derive(Debug, Args)]
pub struct LoadArguments {
    /// Kind of load.
    #[arg(value_enum)]
    kind: LoadKind,
    /// Seed.
    #[arg(long)]
    seed: u64,
    /// Folder for a disk load.
    #[arg(long)]
    folder: PathBuf,
    /// Seconds after which the load ends on its own.
    #[arg(long)]
    limit_s: u64,
}
/// Runs the load until killed.
pub fn disturb(arguments: &LoadArguments) -> Result<(), Failure> {
    let limit = Duration::from_secs(arguments.limit_s);
    load::disturb(arguments.kind, arguments.seed, &arguments.folder, limit)
}
