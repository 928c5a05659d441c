//! Runs one of this program's measurements under valgrind, which counts instructions: a figure that other
//! load does not change.

use std::ffi::OsStr;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use super::failed;
use super::outside::{self, Said};
use trabecula::failure::Failure;

/// How long a measurement may take; under valgrind one takes minutes on a busy machine.
const LIMIT: Duration = Duration::from_secs(1800);

/// The failure of a run under valgrind that did not give what it should.
pub fn failure(said: &Said) -> Failure {
    Failure::failed(format!("valgrind ended with {}: {}", said.status, said.report.trim()))
}

/// Runs this program with `arguments`; callgrind gets `options`, and writes `callgrind.out` and what it dumps
/// into the folder.
///
/// # Errors
/// valgrind is not on the path, or has not ended within the limit.
pub fn run(
    folder: &Path,
    options: &[&str],
    arguments: impl IntoIterator<Item = impl AsRef<OsStr>>,
) -> Result<Said, Failure> {
    let mut command = Command::new("valgrind");
    command.arg("--tool=callgrind").args(options);
    command.arg(format!("--callgrind-out-file={}", folder.join("callgrind.out").display()));
    command.arg(std::env::current_exe().map_err(failed)?).args(arguments);
    outside::run(&mut command, folder, LIMIT, "--instructions needs it (Debian package `valgrind`)")
}
