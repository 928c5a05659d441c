//! Runs a program that is not ours, such as valgrind or `cyclictest`, to its end or its limit.

use std::fs::File;
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use ipc_types::process::bind_to_parent;

use super::failed;
use trabecula::failure::Failure;

const POLL: Duration = Duration::from_millis(20);
/// How long a killed program may take to be gone.
const KILL_LIMIT: Duration = Duration::from_secs(10);

/// How it ended, and what it said.
pub struct Said {
    /// How it ended.
    pub status: ExitStatus,
    /// Its standard output.
    pub out: String,
    /// Its standard error.
    pub report: String,
}

/// Runs a program, which ends with this one; what it says goes through files in the folder, however much it
/// is. `missing` follows the cause if it cannot be started.
///
/// # Errors
/// It cannot be started, or has not ended within the limit and was killed.
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
            if is_gone { String::new() } else { format!("; it is still there {kill_seconds} s later") };
        return Err(Failure::failed(format!(
            "{name} has not ended within {seconds} s and was killed{still}"
        )));
    };
    let text = |path: &Path| std::fs::read(path).map(|bytes| String::from_utf8_lossy(&bytes).into_owned());
    Ok(Said { status, out: text(&out).map_err(failed)?, report: text(&report).map_err(failed)? })
}

/// How a program has ended; `None` if it runs on after the limit.
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
