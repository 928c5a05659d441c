//! `trabecula stress`: the timing of a scene on limited cores, beside neighbours, with every late tick explained.
//!
//! Each combination is a `trabecula run` of its own, confined with its neighbours to the same cores. Its logs are read,
//! replayed and removed; the report is written anew after each, so whatever ends the test keeps what is done.

pub mod confine;
mod figures;
pub mod load;
pub mod machine;
mod measure;
mod page;
pub mod plan;
pub mod report;

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use fastrand::Rng;
use ipc_types::process::EndRequest;
use ipc_types::scene::Scene;

use crate::bench::machine::Machine;
use crate::failure::Failure;
use crate::launcher::part::Part;
use crate::launcher::volume_source::VolumeFiles;
use confine::Confinement;
use load::Loads;
use plan::{Combination, policy_name, wait_name};
use report::{StressReport, Tested};

const LOOK_TIME: Duration = Duration::from_millis(20);
/// How long a run that is asked to end may take; its recorder is never cut short.
const END_LIMIT: Duration = Duration::from_secs(140);
/// How long beyond its own time a run may take, at most: a start on one core beside neighbours is slow.
const RUN_LIMIT: Duration = Duration::from_secs(600);

/// What is to be run.
#[derive(Debug, Clone)]
pub struct StressPlan {
    /// Scene file.
    pub scene: PathBuf,
    /// Combinations, in order.
    pub combinations: Vec<Combination>,
    /// Seconds of each run.
    pub seconds: f64,
    /// Seed of the loads.
    pub seed: u64,
    /// CPU quota of a run with its neighbours, percent of one core.
    pub quota_percent: Option<u64>,
    /// Folder of the report.
    pub output: PathBuf,
    /// Whether the runs' folders stay there.
    pub keep_logs: bool,
    /// Which files the volume may name.
    pub volume_files: VolumeFiles,
    /// An older test to compare with.
    pub compare: Option<StressReport>,
}

/// Runs the combinations; the report's files are in the output folder. The flag says whether it was interrupted.
///
/// # Errors
/// A scene that is not one (2); a report that cannot be written. A run that fails is in the report.
pub fn run(plan: &StressPlan, end: &EndRequest) -> Result<(StressReport, bool), Failure> {
    let scene = Scene::load(&plan.scene).map_err(Failure::bad_input)?;
    let watched = Machine::watch();
    let mut report = StressReport {
        trabecula: env!("CARGO_PKG_VERSION").to_owned(),
        scene: scene.name.clone(),
        seconds: plan.seconds,
        seed: plan.seed,
        quota_percent: plan.quota_percent,
        began: jiff::Zoned::now().strftime("%Y-%m-%d %H:%M").to_string(),
        machine: machine::facts(&watched),
        planned: plan.combinations.len(),
        tested: Vec::new(),
    };
    let (began, total) = (Instant::now(), plan.combinations.len());
    for (index, combination) in plan.combinations.iter().enumerate() {
        let left = estimate(began.elapsed(), index, total, plan.seconds);
        tell!("[{}/{total}] {combination}; about {left} left", index + 1);
        let Some(tested) = test(plan, &scene, combination, index, end)? else { break };
        report.tested.push(tested);
        report.machine = machine::facts(&watched);
        write(&report, plan)?;
    }
    let interrupted = report.tested.len() < total;
    write(&report, plan)?;
    Ok((report, interrupted))
}

fn write(report: &StressReport, plan: &StressPlan) -> Result<(), Failure> {
    let map = figures::map(&report.tested).map_err(|error| Failure::failed(error.to_string()))?;
    figures::write(&map, &plan.output.join("map.svg")).map_err(|error| Failure::failed(error.to_string()))?;
    report.write(&plan.output)?;
    page::write(report, plan.compare.as_ref(), &plan.output)
}

/// Time that is left, by the combinations that are done; before the first is, by their length.
fn estimate(elapsed: Duration, done: usize, total: usize, seconds: f64) -> String {
    let each_s = if done > 0 { elapsed.as_secs_f64() / done as f64 } else { seconds + 10.0 };
    let left_s = each_s * (total - done) as f64;
    if left_s < 90.0 { format!("{left_s:.0} s") } else { format!("{:.0} min", left_s / 60.0) }
}

/// Runs one combination; none if it was interrupted.
fn test(
    plan: &StressPlan,
    scene: &Scene,
    combination: &Combination,
    index: usize,
    end: &EndRequest,
) -> Result<Option<Tested>, Failure> {
    let io = |cause: std::io::Error| Failure::failed(format!("{combination}: {cause}"));
    let logs = plan.output.join(format!("run-{:02}", index + 1));
    output_file::create_folder(&logs).map_err(io)?;
    let machine = Machine::watch();
    let mut not_permitted = Vec::new();
    let failure = {
        let confined = Confinement::enter(combination.cores, plan.quota_percent).map_err(io)?;
        not_permitted.extend(confined.remark.clone());
        let limit = RUN_LIMIT + Duration::from_secs_f64(plan.seconds);
        let seed = Rng::with_seed(plan.seed.wrapping_add(index as u64)).u64(..);
        let _loads = Loads::start(combination.load, seed, &plan.output, limit).map_err(io)?;
        let mut command = command(plan, combination, &logs).map_err(io)?;
        let mut part = Part::start("run", &mut command, false).map_err(io)?;
        let began = Instant::now();
        loop {
            if end.is_set() {
                part.ask_to_end();
                part.wait(END_LIMIT);
                remove(&logs, plan.keep_logs);
                return Ok(None);
            }
            match part.ended() {
                Some(status) if status.success() => break None,
                Some(status) => break Some(format!("{status}: {}", said(&part.last_words()))),
                None if began.elapsed() > limit => break Some("the run did not end".to_owned()),
                None => std::thread::sleep(LOOK_TIME),
            }
        }
    };
    let (busy_percent, stolen_percent) = machine.shares_percent();
    let folder = std::fs::read_dir(&logs).map_err(io)?.flatten().map(|entry| entry.path()).next();
    let expected = Scene {
        run: ipc_types::scene::Run { duration_s: plan.seconds, ..scene.run.clone() },
        ..scene.clone()
    };
    let (measured, curves) = measure::measure(folder.as_deref().unwrap_or(&logs), expected.tick_count())?;
    not_permitted.extend(folder.as_deref().map(refused_priority).unwrap_or_default());
    let name = format!("combination_{:02}.svg", index + 1);
    let figure = figures::combination(combination, &measured, &curves);
    let written = figure.and_then(|figure| figures::write(&figure, &plan.output.join(&name)));
    written.map_err(|error| Failure::failed(error.to_string()))?;
    remove(&logs, plan.keep_logs);
    Ok(Some(Tested {
        combination: *combination,
        measured,
        busy_percent,
        stolen_percent,
        failure,
        not_permitted,
        figure: name,
    }))
}

fn command(plan: &StressPlan, combination: &Combination, logs: &Path) -> std::io::Result<Command> {
    let mut command = Command::new(std::env::current_exe()?);
    command.arg("run").arg(&plan.scene).args(["--mode", "realtime", "--quiet"]);
    command.arg("--duration-s").arg(plan.seconds.to_string()).arg("--output").arg(logs);
    if plan.volume_files.allow_elsewhere {
        command.arg("--allow-elsewhere");
    }
    command.arg("--wait").arg(wait_name(combination.wait));
    command.arg("--policy").arg(policy_name(combination.policy));
    Ok(command)
}

/// What a run said when it failed, without the table before it.
fn said(last_words: &[String]) -> String {
    let failure = last_words.iter().skip_while(|line| !line.starts_with("trabecula: "));
    failure.map(|line| line.trim()).collect::<Vec<_>>().join(" ")
}

/// What the physics said of a priority that it did not get.
fn refused_priority(folder: &Path) -> Vec<String> {
    let mut said = Vec::new();
    let Ok(mut stream) = recorder_proc::MessageStream::open(
        &folder.join("timing.mcap"),
        recorder_proc::ReadOptions::default(),
    ) else {
        return said;
    };
    while let Ok(Some(message)) = stream.next_message() {
        if message.topic == recorder_proc::topics::EVENT {
            let text = String::from_utf8_lossy(message.body);
            if let Some(at) = text.find("priority: ") {
                said.push(text[at..].trim_end_matches('\0').to_owned());
            }
        }
    }
    said
}

fn remove(logs: &Path, keep: bool) {
    if !keep {
        // What cannot be removed lies in the user's own output folder, and is named after what it is.
        let _ = std::fs::remove_dir_all(logs);
    }
}
