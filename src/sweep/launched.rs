//! Runs a point of a sweep as a separate session, for scenes whose controllers are programs and for logs with
//! X-ray frames.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use ipc_types::process::bind_to_parent;
use ipc_types::text_file::{MAX_TEXT_BYTES, read_bytes};
use rustix::process::{Pid, Signal, kill_process};

use super::in_process::PointOutcome;
use super::row::{Ending, Row};
use crate::failure::Failure;
use crate::report::Summary;

/// Interval at which the end of the run is polled.
const LOOK: Duration = Duration::from_millis(20);
/// Timeout for a session to finish its log after it was asked to end.
const ENDING_LIMIT: Duration = Duration::from_secs(30);
/// Timeout for the remaining output of a run that has ended.
const SAID_LIMIT: Duration = Duration::from_secs(5);
/// Length of the end of a run's error output that is kept, bytes.
const SAID_BYTES: usize = 64 << 10;

/// Runs `trabecula run` with these arguments into a folder, and fills in the row from its `summary.json`. The
/// folder keeps the log, because the behaviour of a user's program cannot be reproduced from the row.
pub fn run(
    arguments: &[String],
    mut row: Row,
    folder: &Path,
    is_to_end: &dyn Fn() -> bool,
) -> Result<PointOutcome, Failure> {
    let own = std::env::current_exe().map_err(Failure::failed)?;
    let mut command = Command::new(own);
    command.arg("run").args(arguments).args(["--quiet", "--output"]).arg(folder);
    // The last line of its error output is why it failed.
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped());
    // The run ends with this process, even if this process is killed.
    let child = bind_to_parent(&mut command)
        .spawn()
        .map_err(|cause| Failure::failed(format!("a run cannot be started: {cause}")))?;
    let Some((status, said)) = end_of(child, is_to_end)? else { return Ok(PointOutcome::Interrupted) };
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
        row.breaches = summary.breaches;
        (row.tool, row.drilling, row.plan) = (summary.tool, summary.drilling, summary.plan);
        row.structures = summary.structures;
        row.log = row.log.map(|log| log.join(run));
    } else {
        row.log = None;
    }
    Ok(PointOutcome::Ended(Box::new(row)))
}

/// Returns a process's exit status and error output, or `None` if the sweep, and so the process, was ended.
fn end_of(mut child: Child, is_to_end: &dyn Fn() -> bool) -> Result<Option<(ExitStatus, String)>, Failure> {
    let failed = |cause: std::io::Error| Failure::failed(format!("a run cannot be waited for: {cause}"));
    let pipe = child.stderr.take();
    let (heard, said) = std::sync::mpsc::channel();
    let hearing = std::thread::Builder::new().name("listener".to_owned());
    if let Err(cause) = hearing.spawn(move || heard.send(pipe.map(last_of))) {
        // Its pipe is closed, so the run cannot be heard.
        let _ = child.kill();
        let _ = child.wait();
        return Err(failed(cause));
    }
    let mut asked: Option<Instant> = None;
    let status = loop {
        if let Some(status) = child.try_wait().map_err(failed)? {
            break status;
        }
        match asked {
            None if is_to_end() => {
                asked = Some(Instant::now());
                let id = i32::try_from(child.id()).ok().and_then(Pid::from_raw);
                // It may have just ended.
                let _ = id.map(|id| kill_process(id, Signal::TERM));
            }
            Some(at) if at.elapsed() > ENDING_LIMIT => {
                let _ = child.kill();
            }
            _ => {}
        }
        std::thread::sleep(LOOK);
    };
    // A program left behind by the run may hold the pipe open, so do not wait indefinitely.
    let said = said.recv_timeout(SAID_LIMIT).ok().flatten().unwrap_or_default();
    Ok(asked.is_none().then_some((status, said)))
}

/// Reads to the end and returns the last part.
fn last_of(mut pipe: impl std::io::Read) -> String {
    let (mut kept, mut piece) = (Vec::new(), [0; 4096]);
    while let Ok(count @ 1..) = pipe.read(&mut piece) {
        kept.extend_from_slice(&piece[..count]);
        kept.drain(..kept.len().saturating_sub(SAID_BYTES));
    }
    String::from_utf8_lossy(&kept).into_owned()
}

/// Returns the name and summary of the only run in a folder.
fn summary_in(folder: &Path) -> Option<(PathBuf, Summary)> {
    let mut runs = std::fs::read_dir(folder).ok()?.flatten().map(|entry| entry.path());
    let (run, None) = (runs.next()?, runs.next()) else { return None };
    let text = read_bytes(&run.join("summary.json"), MAX_TEXT_BYTES).ok()?;
    let summary = serde_json::from_slice(&text).ok()?;
    Some((PathBuf::from(run.file_name()?), summary))
}
