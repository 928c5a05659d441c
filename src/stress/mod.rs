//! `trabecula stress`: measures the timing of a scene on limited cores under competing load, and explains
//! every late tick.
//!
//! Each combination is a separate `trabecula run`, confined to the same cores as the competing load. Its logs
//! are read, replayed and removed. The report is rewritten after each combination, so finished results
//! survive an early end.

mod figures;
pub mod load;
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
use output_file::SavedFile;
use recorder_proc::ring_files::{LANES, OPEN_PREFIX, SAVED_PREFIX};

use crate::failure::Failure;
use crate::launcher::part::{PartProcess, ProgramOutput};
use crate::launcher::volume_source::VolumeFiles;
use crate::machine::Confinement;
use crate::machine::Machine;
use crate::report::ReportError;
use crate::scenes::SceneSource;
use load::Loads;
use plan::{Combination, policy_name, wait_name};
use report::{CombinationResult, StressReport};

const POLL_PERIOD: Duration = Duration::from_millis(20);
/// Timeout for a run that is asked to end; its recorder always finishes.
const END_LIMIT: Duration = Duration::from_secs(140);
/// Maximum time of a run beyond its own duration; startup on one core under load is slow.
const RUN_LIMIT: Duration = Duration::from_secs(600);

/// Configuration of a stress test.
#[derive(Debug, Clone)]
pub struct StressPlan {
    /// The scene.
    pub scene: SceneSource,
    /// Combinations, in order.
    pub combinations: Vec<Combination>,
    /// Seconds of each run.
    pub seconds: f64,
    /// Seed of the loads.
    pub seed: u64,
    /// CPU quota of a run with its competing load, percent of one core.
    pub quota_percent: Option<u64>,
    /// Folder of the report.
    pub output: PathBuf,
    /// Whether to keep the runs' folders.
    pub keeps_logs: bool,
    /// Which files the volume can refer to.
    pub volume_files: VolumeFiles,
    /// An earlier test to compare with.
    pub compare: Option<StressReport>,
}

/// Runs the combinations and writes the report to the output folder. The flag is true if it was interrupted.
///
/// # Errors
/// An invalid scene (2); a report that cannot be written. A failed run is part of the report.
pub fn run(plan: &StressPlan, end: &EndRequest) -> Result<(StressReport, bool), Failure> {
    let scene = plan.scene.load()?;
    let watched = Machine::watch();
    let mut report = StressReport {
        trabecula: env!("CARGO_PKG_VERSION").to_owned(),
        scene: scene.name.clone(),
        seconds: plan.seconds,
        seed: plan.seed,
        quota_percent: plan.quota_percent,
        began: jiff::Zoned::now().strftime("%Y-%m-%d %H:%M").to_string(),
        machine: crate::machine::facts(&watched),
        planned: plan.combinations.len(),
        tested: Vec::new(),
    };
    let mut written = ReportFiles::create(&plan.output)?;
    let (began, total) = (Instant::now(), plan.combinations.len());
    for (index, combination) in plan.combinations.iter().enumerate() {
        let left = estimate(began.elapsed(), index, total, plan.seconds);
        tell!("[{}/{total}] {combination}; about {left} left", index + 1);
        let Some(tested) = test(plan, &scene, combination, index, end)? else { break };
        report.tested.push(tested);
        report.machine = crate::machine::facts(&watched);
        written.save(&report, plan)?;
    }
    let interrupted = report.tested.len() < total;
    written.save(&report, plan)?;
    Ok((report, interrupted))
}

/// The report's files, rewritten after every combination.
struct ReportFiles {
    map: SavedFile,
    json: SavedFile,
    csv: SavedFile,
    page: SavedFile,
}

impl ReportFiles {
    fn create(folder: &Path) -> Result<ReportFiles, Failure> {
        let file = |name: &str| SavedFile::create(&folder.join(name));
        let (map, json) = (file("map.svg")?, file("stress.json")?);
        Ok(ReportFiles { map, json, csv: file("stress.csv")?, page: file("index.html")? })
    }

    fn save(&mut self, report: &StressReport, plan: &StressPlan) -> Result<(), Failure> {
        let map = figures::map(&report.tested).and_then(|map| map.svg(&plan.output.join("map.svg")));
        self.map.save(map.map_err(ReportError::from)?)?;
        self.json.save(report.json()?)?;
        self.csv.save(report.csv())?;
        // The page embeds the map from the folder.
        let page = page::html(report, plan.compare.as_ref(), &plan.output).map_err(Failure::failed)?;
        Ok(self.page.save(page)?)
    }
}

/// Estimates the remaining time from the finished combinations, or before the first from the duration.
fn estimate(elapsed: Duration, done: usize, total: usize, seconds: f64) -> String {
    let each_s = if done > 0 { elapsed.as_secs_f64() / done as f64 } else { seconds + 10.0 };
    let left_s = each_s * (total - done) as f64;
    if left_s < 90.0 { format!("{left_s:.0} s") } else { format!("{:.0} min", left_s / 60.0) }
}

/// Runs one combination; returns `None` if it was interrupted.
fn test(
    plan: &StressPlan,
    scene: &Scene,
    combination: &Combination,
    index: usize,
    end: &EndRequest,
) -> Result<Option<CombinationResult>, Failure> {
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
        let mut part = PartProcess::start("run", &mut command, ProgramOutput::Hidden).map_err(io)?;
        let began = Instant::now();
        loop {
            if end.is_set() {
                part.ask_to_end();
                part.wait(END_LIMIT);
                remove(&logs, plan.keeps_logs);
                return Ok(None);
            }
            match part.ended() {
                Some(status) if status.success() => break None,
                Some(status) => break Some(format!("{status}: {}", said(&part.last_words()))),
                None if began.elapsed() > limit => break Some("the run did not end in time".to_owned()),
                None => std::thread::sleep(POLL_PERIOD),
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
    let path = plan.output.join(&name);
    let figure = figures::combination(combination, &measured, &curves).and_then(|figure| figure.svg(&path));
    output_file::write(&path, figure.map_err(ReportError::from)?)?;
    remove(&logs, plan.keeps_logs);
    Ok(Some(CombinationResult {
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
    // Without a scene, `run` uses the same default as `stress`.
    command.arg("run").args(plan.scene.argument()).args(["--mode", "realtime", "--quiet"]);
    command.arg("--duration-s").arg(plan.seconds.to_string()).arg("--output").arg(logs);
    if plan.volume_files.allow_elsewhere {
        command.arg("--allow-elsewhere");
    }
    command.arg("--wait").arg(wait_name(combination.wait));
    command.arg("--policy").arg(policy_name(combination.policy));
    Ok(command)
}

/// Returns the error message of a failed run without the preceding table.
fn said(last_words: &[String]) -> String {
    let failure = last_words.iter().skip_while(|line| !line.starts_with("trabecula: "));
    failure.map(|line| line.trim()).collect::<Vec<_>>().join(" ")
}

/// Returns what the physics reported about a priority that was denied.
fn refused_priority(folder: &Path) -> Vec<String> {
    let mut said = Vec::new();
    let Ok(mut stream) = run_log::MessageStream::open(
        &recorder_proc::log_file::LogFile::at(folder.join("timing.mcap")),
        run_log::ReadOptions::default(),
    ) else {
        return said;
    };
    while let Ok(Some(message)) = stream.next_message() {
        if message.known == Some(run_log::Topic::Event) {
            let text = String::from_utf8_lossy(message.body);
            if let Some(at) = text.find("priority: ") {
                said.push(text[at..].trim_end_matches('\0').to_owned());
            }
        }
    }
    said
}

/// Removes the files that runs wrote into their folders, and the folders if they are then empty.
fn remove(logs: &Path, keeps_logs: bool) {
    if keeps_logs {
        return;
    }
    // Anything that cannot be removed stays in the output folder under a recognizable name.
    for folder in std::fs::read_dir(logs).into_iter().flatten().flatten().map(|entry| entry.path()) {
        let of_ring = |log: &PathBuf| {
            let name = log.file_name().and_then(|name| name.to_str());
            name.is_some_and(|name| name.starts_with(SAVED_PREFIX) || name.starts_with(OPEN_PREFIX))
        };
        let within = std::fs::read_dir(&folder).into_iter().flatten().flatten().map(|entry| entry.path());
        for log in within.filter(of_ring) {
            LANES.iter().for_each(|name| drop(std::fs::remove_file(log.join(name))));
            let _ = std::fs::remove_dir(log);
        }
        crate::report::FILES.iter().for_each(|name| drop(std::fs::remove_file(folder.join(name))));
        let _ = std::fs::remove_dir(folder);
    }
    let _ = std::fs::remove_dir(logs);
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    /// Regression: a stress test removed its runs' folders with everything in them.
    #[test]
    fn what_others_put_beside_the_logs_of_a_stress_test_stays() {
        let logs = tempfile::tempdir().unwrap();
        let [ours, mixed] = ["ours", "mixed"].map(|name| logs.path().join(name));
        for folder in [&ours, &mixed] {
            fs::create_dir(folder).unwrap();
            crate::report::FILES.iter().for_each(|name| fs::write(folder.join(name), name).unwrap());
            fs::create_dir(folder.join("saved-1")).unwrap();
            LANES.iter().for_each(|name| fs::write(folder.join("saved-1").join(name), name).unwrap());
        }
        fs::write(mixed.join("notes.txt"), "a user's own").unwrap();
        remove(logs.path(), true);
        assert_eq!(fs::read_dir(&ours).unwrap().count(), crate::report::FILES.len() + 1);
        remove(logs.path(), false);
        assert!(!ours.exists());
        let left: Vec<_> = fs::read_dir(&mixed).unwrap().flatten().map(|entry| entry.file_name()).collect();
        assert_eq!(left, ["notes.txt"]);
    }
}
