//! Detects suspensions of the whole process: a cgroup quota, a freezer, a stop signal.
//!
//! The files are opened once and read only after a long gap, so that ticks that are on time or slightly late
//! pay nothing.

use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use ipc_types::process::ResumeFlag;

use super::disturbance::number;

/// Shortest gap that a quota or a freezer can explain: both suspend a process for milliseconds.
const LONG_GAP_NS: i64 = 5_000_000;
/// Maximum depth of the cgroup hierarchy to watch.
const MAX_GROUPS: usize = 8;

/// Counters of the cgroups that this process is in, and whether it received SIGCONT.
#[derive(Debug)]
pub(super) struct SuspensionCounters {
    throttled: Vec<Counter>,
    frozen: Vec<Counter>,
    continued: ResumeFlag,
}

impl SuspensionCounters {
    /// Opens the counters of the cgroups that the process is in now.
    pub(super) fn new() -> SuspensionCounters {
        let text = |path: &str| std::fs::read_to_string(path).unwrap_or_default();
        let groups = groups(&text("/proc/self/mounts"), &text("/proc/self/cgroup"));
        let open = |files: &[(&str, &'static str, u64)]| -> Vec<Counter> {
            let counter = |folder: &PathBuf| {
                files.iter().find_map(|(file, key, unit_ns)| Counter::open(&folder.join(file), key, *unit_ns))
            };
            groups.iter().filter_map(counter).take(MAX_GROUPS).collect()
        };
        SuspensionCounters {
            // The first is cheap because the kernel does not sum over child groups; the last is version 1's.
            throttled: open(&[
                ("cpu.stat.local", "throttled_usec", 1000),
                ("cpu.stat", "throttled_usec", 1000),
                ("cpu.stat", "throttled_time", 1),
            ]),
            frozen: open(&[("cgroup.stat.local", "frozen_usec", 1000)]),
            // Without this, a stop cannot be identified.
            continued: ResumeFlag::install().unwrap_or_default(),
        }
    }

    /// Returns how long the process was throttled and how long it was stopped before a tick with this
    /// lateness.
    pub(super) fn before(&mut self, lateness_ns: i64) -> (u64, u64) {
        let continued = self.continued.take();
        if lateness_ns <= LONG_GAP_NS {
            return (0, 0);
        }
        // A suspended group suspends all its children too; taking the maximum avoids counting that twice.
        let most = |counters: &mut [Counter]| counters.iter_mut().map(Counter::since_last).max().unwrap_or(0);
        let (throttled_ns, frozen_ns) = (most(&mut self.throttled), most(&mut self.frozen));
        (throttled_ns, if continued { lateness_ns as u64 } else { frozen_ns })
    }
}

/// A monotonic counter in a cgroup file.
#[derive(Debug)]
struct Counter {
    file: File,
    key: &'static str,
    unit_ns: u64,
    last: u64,
}

impl Counter {
    /// Opens a counter; `None` if the file does not contain it.
    fn open(path: &Path, key: &'static str, unit_ns: u64) -> Option<Counter> {
        let mut counter = Counter { file: File::open(path).ok()?, key, unit_ns, last: 0 };
        counter.last = counter.read()?;
        Some(counter)
    }

    fn read(&self) -> Option<u64> {
        let mut text = [0; 1024];
        let length = self.file.read_at(&mut text, 0).ok()?;
        let mut lines = text[..length].split(|byte| *byte == b'\n');
        lines.find_map(|line| number(line.strip_prefix(self.key.as_bytes())?.strip_prefix(b" ")?))
    }

    /// Returns the nanoseconds since the last read.
    fn since_last(&mut self) -> u64 {
        let now = self.read().unwrap_or(self.last);
        let since = now.saturating_sub(self.last);
        self.last = now;
        since.saturating_mul(self.unit_ns)
    }
}

/// Lists the folders of a process's cgroups and their ancestors: of version 2, and of the `cpu` controller of
/// version 1.
fn groups(mounts: &str, own: &str) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for line in mounts.lines() {
        let mut words = line.split(' ').skip(1);
        let (Some(point), Some(kind), Some(options)) = (words.next(), words.next(), words.next()) else {
            continue;
        };
        let of_kind = |controllers: &str| match kind {
            "cgroup2" => controllers.is_empty(),
            "cgroup" => [options, controllers].iter().all(|list| list.split(',').any(|name| name == "cpu")),
            _ => false,
        };
        // hierarchy:controllers:path; in version 2 the list is empty (cgroups(7)).
        let path = own.lines().find_map(|line| {
            let mut fields = line.splitn(3, ':').skip(1);
            let (controllers, path) = (fields.next()?, fields.next()?);
            of_kind(controllers).then_some(path)
        });
        let Some(path) = path else { continue };
        let group = Path::new(point).join(path.trim_start_matches('/'));
        found.extend(group.ancestors().take_while(|folder| folder.starts_with(point)).map(Path::to_owned));
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_groups_of_both_versions_are_found_with_those_above() {
        let mounts = "proc /proc proc rw 0 0\n\
                      cgroup2 /sys/fs/cgroup/unified cgroup2 rw,nosuid 0 0\n\
                      cgroup /sys/fs/cgroup/cpu,cpuacct cgroup rw,cpu,cpuacct 0 0\n\
                      cgroup /sys/fs/cgroup/cpuset cgroup rw,cpuset 0 0\n";
        let own = "3:cpuset:/other\n2:cpu,cpuacct:/lab/run\n0::/user.slice\n";
        let found: Vec<String> =
            groups(mounts, own).iter().map(|folder| folder.to_string_lossy().into_owned()).collect();
        let expected = [
            "/sys/fs/cgroup/unified/user.slice",
            "/sys/fs/cgroup/unified",
            "/sys/fs/cgroup/cpu,cpuacct/lab/run",
            "/sys/fs/cgroup/cpu,cpuacct/lab",
            "/sys/fs/cgroup/cpu,cpuacct",
        ];
        assert_eq!(found, expected);
        assert_eq!(groups("", ""), Vec::<PathBuf>::new());
    }

    #[test]
    fn a_counter_says_what_came_since_the_last_look() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("cpu.stat");
        std::fs::write(&path, "nr_throttled 7\nthrottled_usec 40\n").unwrap();
        let mut counter = Counter::open(&path, "throttled_usec", 1000).unwrap();
        assert_eq!(counter.since_last(), 0);
        std::fs::write(&path, "nr_throttled 8\nthrottled_usec 75\n").unwrap();
        assert_eq!((counter.since_last(), counter.since_last()), (35_000, 0));
        assert!(Counter::open(&path, "frozen_usec", 1000).is_none());
    }

    #[test]
    fn a_process_that_goes_on_after_a_stop_knows_it() {
        let mut held_back = SuspensionCounters::new();
        assert_eq!(held_back.before(LONG_GAP_NS).1, 0);
        signal_hook::low_level::raise(signal_hook::consts::SIGCONT).unwrap();
        assert_eq!(held_back.before(600_000_000).1, 600_000_000);
        // A stop is reported only once.
        assert_eq!(held_back.before(600_000_000).1, 0);
    }
}
