//! The log of a run that is being watched: where it is, and whether it is whole.

use std::path::{Path, PathBuf};

use recorder_proc::process::OUTPUT_FILE;
use run_log::EndReason;

use crate::log::file::LogFile;

/// Where a run is recorded. The launcher says so in the session's folder, which goes with the run.
pub(super) struct FollowedLog {
    said_in: PathBuf,
    folder: Option<PathBuf>,
}

impl FollowedLog {
    pub(super) fn of(session: &Path) -> FollowedLog {
        FollowedLog { said_in: session.join(OUTPUT_FILE), folder: None }
    }

    /// Reads where it is, unless that is known.
    pub(super) fn look(&mut self) {
        if self.folder.is_none() {
            self.folder = std::fs::read_to_string(&self.said_in).ok().map(PathBuf::from);
        }
    }

    pub(super) fn is_known(&self) -> bool {
        self.folder.is_some()
    }

    /// The run's folder, once both files have their index, which is written last; and why the run ended, as its log has it.
    pub(super) fn whole(&self) -> Option<(PathBuf, Option<EndReason>)> {
        let folder = self.folder.as_ref()?;
        let [run, timing] = ["run.mcap", "timing.mcap"].map(|name| LogFile::open(&folder.join(name)).ok());
        Some((folder.clone(), run.zip(timing)?.0.end_reason()))
    }
}
