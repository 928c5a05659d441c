//! Runs one of this program's measurements under valgrind, which counts instructions: a figure that other load does not change.

use std::ffi::OsStr;
use std::fs::File;
use std::path::Path;
use std::process::{Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use super::failed;
use trabecula::failure::Failure;

/// How long a measurement may take; under valgrind one takes minutes on a busy machine.
const LIMIT: Duration = Duration::from_secs(1800);
const POLL: Duration = Duration::from_millis(20);

/// What a measurement printed under valgrind.
pub struct Counted {
    /// How it ended.
    pub status: ExitStatus,
    /// Its standard output.
    pub out: String,
    /// Its standard error, with valgrind's report.
    pub report: String,
}

impl Counted {
    /// The failure of a run that did not give what it should.
    pub fn failure(&self) -> Failure {
        Failure::failed(format!("valgrind ended with {}: {}", self.status, self.report.trim()))
    }
}

/// Runs this program with `arguments`; callgrind gets `options`, and writes `callgrind.out` and what it dumps into the folder.
///
/// # Errors
/// valgrind is not on the path, or has not ended within the limit.
pub fn run(
    folder: &Path,
    options: &[&str],
    arguments: impl IntoIterator<Item = impl AsRef<OsStr>>,
) -> Result<Counted, Failure> {
    let [out, report] = ["out.txt", "report.txt"].map(|name| folder.join(name));
    let mut child = Command::new("valgrind")
        .arg("--tool=callgrind")
        .args(options)
        .arg(format!("--callgrind-out-file={}", folder.join("callgrind.out").display()))
        .arg(std::env::current_exe().map_err(failed)?)
        .args(arguments)
        .stdin(Stdio::null())
        .stdout(File::create(&out).map_err(failed)?)
        .stderr(File::create(&report).map_err(failed)?)
        .spawn()
        .map_err(|cause| {
            Failure::failed(format!("valgrind: {cause}; --instructions needs it (Debian package `valgrind`)"))
        })?;
    let began = Instant::now();
    let status = loop {
        if let Some(status) = child.try_wait().map_err(failed)? {
            break status;
        }
        if began.elapsed() > LIMIT {
            child.kill().map_err(failed)?;
            child.wait().map_err(failed)?;
            let seconds = LIMIT.as_secs();
            return Err(Failure::failed(format!("valgrind has not ended within {seconds} s and was killed")));
        }
        std::thread::sleep(POLL);
    };
    let text = |path: &Path| std::fs::read(path).map(|bytes| String::from_utf8_lossy(&bytes).into_owned());
    Ok(Counted { status, out: text(&out).map_err(failed)?, report: text(&report).map_err(failed)? })
}
