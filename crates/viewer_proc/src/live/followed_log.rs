//! The log of a run that is being watched: where it is, and whether it is whole.

use std::path::{Path, PathBuf};

use recorder_proc::process::OUTPUT_FILE;
use run_log::EndReason;

use crate::log::file::LogFile;

/// The folder in which a session is recorded; `None` if it is not, or not yet said. The launcher says so in
/// the session's folder, which goes with the run.
pub(super) fn recorded_in(session: &Path) -> Option<PathBuf> {
    std::fs::read_to_string(session.join(OUTPUT_FILE)).ok().map(PathBuf::from)
}

/// Where a run is recorded.
pub(super) struct FollowedLog {
    session: PathBuf,
    folder: Option<PathBuf>,
}

impl FollowedLog {
    pub(super) fn of(session: &Path) -> FollowedLog {
        FollowedLog { session: session.to_owned(), folder: None }
    }

    /// Reads where it is, unless that is known.
    pub(super) fn look(&mut self) {
        if self.folder.is_none() {
            self.folder = recorded_in(&self.session);
        }
    }

    pub(super) fn is_known(&self) -> bool {
        self.folder.is_some()
    }

    /// The run's folder, once both files have their index, which is written last; and why the run ended, as
    /// its log has it.
    pub(super) fn whole(&self) -> Option<(PathBuf, Option<EndReason>)> {
        let folder = self.folder.as_ref()?;
        let [run, timing] = ["run.mcap", "timing.mcap"].map(|name| LogFile::open(&folder.join(name)).ok());
        Some((folder.clone(), run.zip(timing)?.0.end_reason()))
    }
}
