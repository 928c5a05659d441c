//! Runs one of this program's measurements under valgrind, which counts instructions: a figure unaffected by
//! other load.

use std::ffi::OsStr;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use super::failed;
use super::outside::{self, Said};
use trabecula::failure::Failure;

/// Time limit of a measurement; under valgrind one takes minutes on a busy machine.
const LIMIT: Duration = Duration::from_secs(1800);

/// Returns the failure of an unsuccessful run under valgrind.
pub fn failure(said: &Said) -> Failure {
    Failure::failed(format!("valgrind ended with {}: {}", said.status, said.report.trim()))
}

/// Runs this program with `arguments` under callgrind with `options`; writes `callgrind.out` and its dumps to
/// the folder.
///
/// # Errors
/// valgrind is not in the PATH, or did not end within the limit.
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
