//! Passes the end reason of a run from the launcher to its recorder: through a file in the session's folder,
//! or in the run's folder if the session's has been removed. The file contains the text for the log's end
//! marker.

use std::path::{Path, PathBuf};

use run_log::EndReason;

/// The file in the session's folder.
pub const IN_SESSION: &str = ".end_reason";

/// The file in the run's folder, named after the recorder's process ID so that no other program creates it by
/// accident.
pub fn in_output(output: &Path, recorder: u32) -> PathBuf {
    output.join(format!(".trabecula-end-for-{recorder}"))
}

/// Returns the path of this recorder's reason, if it has been written.
pub(crate) fn find(session: &Path, output: &Path) -> Option<PathBuf> {
    let places = [session.join(IN_SESSION), in_output(output, std::process::id())];
    places.into_iter().find(|path| path.exists())
}

/// Reads the reason. A file without a valid reason means a completed run.
pub(crate) fn read(path: &Path) -> std::io::Result<EndReason> {
    let text = std::fs::read_to_string(path)?;
    Ok(EndReason::parse(&text).unwrap_or(EndReason::Completed))
}
