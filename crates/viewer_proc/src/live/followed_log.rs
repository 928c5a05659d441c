//! The log of the run being watched: its location, and whether it is complete.

use std::path::{Path, PathBuf};

use recorder_proc::process::OUTPUT_FILE;
use run_log::EndReason;

use crate::log::file::LogFile;

/// Returns the folder in which a session is recorded, or `None` if it is not recorded or not yet known. The
/// launcher writes it to the session's folder, which is deleted with the run.
pub(crate) fn recorded_in(session: &Path) -> Option<PathBuf> {
    std::fs::read_to_string(session.join(OUTPUT_FILE)).ok().map(PathBuf::from)
}

/// Location of a run's recording.
pub(super) struct FollowedLog {
    session: PathBuf,
    folder: Option<PathBuf>,
}

impl FollowedLog {
    pub(super) fn of(session: &Path) -> FollowedLog {
        FollowedLog { session: session.to_owned(), folder: None }
    }

    /// Reads the location unless it is known.
    pub(super) fn look(&mut self) {
        if self.folder.is_none() {
            self.folder = recorded_in(&self.session);
        }
    }

    pub(super) fn is_known(&self) -> bool {
        self.folder.is_some()
    }

    /// Returns the run's folder and, if logged, the reason why the run ended; `None` until both files are
    /// complete (their index is written last).
    pub(super) fn whole(&self) -> Option<(PathBuf, Option<EndReason>)> {
        let folder = self.folder.as_ref()?;
        let [run, timing] = ["run.mcap", "timing.mcap"].map(|name| LogFile::open(&folder.join(name)).ok());
        Some((folder.clone(), run.zip(timing)?.0.end_reason()))
    }
}
