//! A run of a sweep as a session of its own, for scenes whose controllers are programs and for logs with
//! X-ray frames.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};

use super::in_process::Ran;
use super::row::{Ending, Row};
use crate::failure::Failure;
use crate::report::Summary;

/// How often to look whether it has ended.
const LOOK: Duration = Duration::from_millis(20);
/// How long a session that is asked to end may take to finish its log.
const ENDING_LIMIT: Duration = Duration::from_secs(30);
/// How long to wait for the last words of one that has ended.
const SAID_LIMIT: Duration = Duration::from_secs(5);

/// Runs `trabecula run` with these arguments into a folder, and fills the row in from its `summary.json`. The
/// folder keeps the log, because what a program of the user's did cannot be made again from the row.
pub fn run(
    arguments: &[String],
    mut row: Row,
    folder: &Path,
    is_to_end: &dyn Fn() -> bool,
) -> Result<Ran, Failure> {
    let own = std::env::current_exe().map_err(Failure::failed)?;
    let mut command = Command::new(own);
    command.arg("run").args(arguments).args(["--quiet", "--output"]).arg(folder);
    // Of what it says, the last line is why it failed.
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped());
    let child =
        command.spawn().map_err(|cause| Failure::failed(format!("a run cannot be started: {cause}")))?;
    let Some((status, said)) = end_of(child, is_to_end)? else { return Ok(Ran::Interrupted) };
    let last_line = said.trim().lines().last().map(str::to_owned);
    row.outcome = match (status.success(), status.code()) {
        (true, _) => Ending::Completed,
        (false, Some(2)) => Ending::Refused,
        (false, _) if said.contains("the simulation failed") => Ending::SimulationFailed,
        (false, _) => Ending::Failed,
    };
    row.reason = last_line.filter(|_| row.outcome != Ending::Completed);
    if let Some((run, summary)) = summary_in(folder) {
        row.ticks = summary.ticks;
        row.simulated_s = summary.simulated_s;
        row.final_hash = summary.final_hash;
        (row.tool, row.drilling) = (summary.tool, summary.drilling);
        row.log = row.log.map(|log| log.join(run));
    } else {
        row.log = None;
    }
    Ok(Ran::Ended(Box::new(row)))
}

/// How a process ended and what it said; `None` if the sweep was asked to end, and the process with it.
fn end_of(mut child: Child, is_to_end: &dyn Fn() -> bool) -> Result<Option<(ExitStatus, String)>, Failure> {
    let failed = |cause: std::io::Error| Failure::failed(format!("a run cannot be waited for: {cause}"));
    let pipe = child.stderr.take();
    let (heard, said) = std::sync::mpsc::channel();
    std::thread::spawn(move || heard.send(pipe.map(std::io::read_to_string)));
    let mut asked: Option<Instant> = None;
    let status = loop {
        if let Some(status) = child.try_wait().map_err(failed)? {
            break status;
        }
        match asked {
            None if is_to_end() => {
                asked = Some(Instant::now());
                let id = i32::try_from(child.id()).ok().and_then(Pid::from_raw);
                // One that has just ended cannot be asked.
                let _ = id.map(|id| kill_process(id, Signal::TERM));
            }
            Some(at) if at.elapsed() > ENDING_LIMIT => {
                let _ = child.kill();
            }
            _ => {}
        }
        std::thread::sleep(LOOK);
    };
    // A program that the run has left behind may hold the pipe open: then its words are not waited for.
    let said = said.recv_timeout(SAID_LIMIT).ok().flatten().and_then(Result::ok).unwrap_or_default();
    Ok(asked.is_none().then_some((status, said)))
}

/// The only run in a folder: its name and its summary.
fn summary_in(folder: &Path) -> Option<(PathBuf, Summary)> {
    let mut runs = std::fs::read_dir(folder).ok()?.flatten().map(|entry| entry.path());
    let (run, None) = (runs.next()?, runs.next()) else { return None };
    let summary = serde_json::from_slice(&std::fs::read(run.join("summary.json")).ok()?).ok()?;
    Some((PathBuf::from(run.file_name()?), summary))
}
