//! How the launcher tells its recorder why a run ends: by a file in the session's folder, or in the run's folder if that has been removed.
//! It holds the text for the end marker of the log.

use std::path::{Path, PathBuf};

use run_log::EndReason;

/// The file in the session's folder.
pub fn in_session(session: &Path) -> PathBuf {
    session.join(".end_reason")
}

/// The file in the run's folder, by the recorder's process number: nobody else has a reason to make a file of such a name.
pub fn in_output(output: &Path, recorder: u32) -> PathBuf {
    output.join(format!(".trabecula-end-for-{recorder}"))
}

/// Where this recorder has been told, if it has.
pub(crate) fn find(session: &Path, output: &Path) -> Option<PathBuf> {
    let places = [in_session(session), in_output(output, std::process::id())];
    places.into_iter().find(|path| path.exists())
}

/// What it has been told. A file that says nothing is that of a run about which there is nothing to say.
pub(crate) fn read(path: &Path) -> std::io::Result<EndReason> {
    let text = std::fs::read_to_string(path)?;
    Ok(EndReason::parse(&text).unwrap_or(EndReason::Completed))
}
