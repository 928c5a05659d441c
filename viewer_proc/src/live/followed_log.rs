//! The log of a run that is being watched: where it is, and whether it is whole.

use std::path::{Path, PathBuf};

use recorder_proc::process::OUTPUT_FILE;

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

    /// The run's folder, once both files have their index, which is written last.
    pub(super) fn whole(&self) -> Option<PathBuf> {
        let folder = self.folder.as_ref()?;
        let is_whole = |name: &str| LogFile::open(&folder.join(name)).is_ok();
        (is_whole("run.mcap") && is_whole("timing.mcap")).then(|| folder.clone())
    }
}
