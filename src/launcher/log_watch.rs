//! Checks that the log being written still exists at its path.

use std::fs::{File, Metadata};
use std::os::fd::AsRawFd;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Interval between checks.
const CHECK_PERIOD: Duration = Duration::from_millis(250);

/// Watches `run.mcap`, or the run's folder if a flight recorder replaces the logs in it; otherwise the
/// recorder would silently keep writing to an unlinked file.
#[derive(Debug)]
pub(super) struct LogWatch {
    log: PathBuf,
    /// Opened once the recorder has created it.
    file: Option<File>,
    looked: Instant,
}

impl LogWatch {
    pub(super) fn new(folder: &Path, has_ring: bool) -> LogWatch {
        let log = if has_ring { folder.to_owned() } else { folder.join("run.mcap") };
        LogWatch { log, file: None, looked: Instant::now() }
    }

    /// Returns what happened to the log if it is no longer in place.
    pub(super) fn check(&mut self) -> Option<String> {
        if self.looked.elapsed() < CHECK_PERIOD {
            return None;
        }
        self.looked = Instant::now();
        let Some(file) = &self.file else {
            self.file = File::open(&self.log).ok();
            return None;
        };
        let written = file.metadata().ok()?;
        let is_it = |there: Metadata| (there.dev(), there.ino()) == (written.dev(), written.ino());
        if std::fs::metadata(&self.log).is_ok_and(is_it) {
            return None;
        }
        let log = self.log.display();
        if written.nlink() == 0 {
            return Some(format!("the log {log} was removed during the run: its content is lost"));
        }
        let place = std::fs::read_link(format!("/proc/self/fd/{}", file.as_raw_fd())).ok()?;
        Some(format!("the log {log} was moved to {} during the run", place.display()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_log_that_is_removed_or_moved_is_noticed() {
        let folder = tempfile::tempdir().unwrap();
        let mut watch = LogWatch::new(folder.path(), false);
        let mut look = || {
            watch.looked -= CHECK_PERIOD;
            watch.check()
        };
        assert_eq!(look(), None, "not created yet");
        let (log, other) = (folder.path().join("run.mcap"), folder.path().join("other.mcap"));
        std::fs::write(&log, "x").unwrap();
        assert_eq!((look(), look()), (None, None));
        std::fs::rename(&log, &other).unwrap();
        assert!(look().is_some_and(|said| said.contains("moved to") && said.contains("other.mcap")));
        std::fs::rename(&other, &log).unwrap();
        assert_eq!(look(), None);
        std::fs::remove_file(&log).unwrap();
        assert!(look().is_some_and(|said| said.contains("removed")));
        // A different file under the same name is not the log.
        std::fs::write(&log, "y").unwrap();
        assert!(look().is_some_and(|said| said.contains("removed")));
    }

    /// Regression: with a flight recorder there is no `run.mcap` before the end, so nothing was watched.
    #[test]
    fn a_moved_folder_of_a_flight_recorder_is_noticed() {
        let folder = tempfile::tempdir().unwrap();
        let [run, other] = ["run", "other"].map(|name| folder.path().join(name));
        std::fs::create_dir(&run).unwrap();
        let mut watch = LogWatch::new(&run, true);
        let mut look = || {
            watch.looked -= CHECK_PERIOD;
            watch.check()
        };
        assert_eq!((look(), look()), (None, None));
        std::fs::rename(&run, &other).unwrap();
        assert!(
            look().is_some_and(|said| said.contains("moved to") && said.ends_with("other during the run"))
        );
    }
}
