//! Runs an external program, such as valgrind or `cyclictest`, until its end or a time limit.

use std::fs::File;
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use ipc_types::process::bind_to_parent;

use super::failed;
use trabecula::failure::Failure;

const POLL: Duration = Duration::from_millis(20);
/// Time limit for a killed program to end.
const KILL_LIMIT: Duration = Duration::from_secs(10);

/// Exit status and output of a program.
pub struct Said {
    /// Exit status.
    pub status: ExitStatus,
    /// Standard output.
    pub out: String,
    /// Standard error.
    pub report: String,
}

/// Runs a program, which ends with this one; its output goes through files in the folder, so its size does
/// not matter. `missing` is appended to the cause if it cannot be started.
///
/// # Errors
/// It cannot be started, or did not end within the limit and was killed.
pub fn run(command: &mut Command, folder: &Path, limit: Duration, missing: &str) -> Result<Said, Failure> {
    let name = command.get_program().to_string_lossy().into_owned();
    let [out, report] = ["out.txt", "report.txt"].map(|name| folder.join(name));
    command.stdin(Stdio::null()).stdout(File::create(&out).map_err(failed)?);
    command.stderr(File::create(&report).map_err(failed)?);
    let started = bind_to_parent(command).spawn();
    let mut child = started.map_err(|cause| Failure::failed(format!("{name}: {cause}; {missing}")))?;
    let Some(status) = ends_within(&mut child, limit)? else {
        child.kill().map_err(failed)?;
        let is_gone = ends_within(&mut child, KILL_LIMIT)?.is_some();
        let (seconds, kill_seconds) = (limit.as_secs(), KILL_LIMIT.as_secs());
        let still =
            if is_gone { String::new() } else { format!("; it is still running {kill_seconds} s later") };
        return Err(Failure::failed(format!("{name} did not end within {seconds} s and was killed{still}")));
    };
    let text = |path: &Path| std::fs::read(path).map(|bytes| String::from_utf8_lossy(&bytes).into_owned());
    Ok(Said { status, out: text(&out).map_err(failed)?, report: text(&report).map_err(failed)? })
}

/// Returns a program's exit status, or `None` if it is still running at the limit.
fn ends_within(child: &mut Child, limit: Duration) -> Result<Option<ExitStatus>, Failure> {
    let began = Instant::now();
    loop {
        let status = child.try_wait().map_err(failed)?;
        if status.is_some() || began.elapsed() > limit {
            return Ok(status);
        }
        std::thread::sleep(POLL);
    }
}
