//! Removes shared-memory segments left incomplete by a process killed while creating them.
//!
//! The transport creates a segment in two steps, `shm_open` and `ftruncate`. A process that opens a segment
//! of size zero waits for the second step without a limit (iceoryx2 0.10,
//! `dynamic_storage/posix_shared_memory.rs`, the arm `MappingSizeIsZero`). If the creator is killed between
//! the two, every process that opens the segment, or cleans up after dead processes, hangs. Removing the name
//! ends their wait with an error.

use std::collections::BTreeMap;
use std::os::fd::OwnedFd;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crate::family::is_alive;
use crate::identity::process_of;
use crate::session::{SessionId, is_locked, open_folder};
use crate::shared_memory::SharedMemory;

/// Time between sweeps.
const SWEEP_PERIOD: Duration = Duration::from_millis(200);
/// How long a segment may have size zero while every process in its name is alive. Creation takes
/// microseconds; the timeout is the only evidence about a creator in another PID namespace.
const LONGEST_MAKING: Duration = Duration::from_secs(10);

/// A thread that removes a session's incomplete segments until it is dropped.
#[derive(Debug)]
pub struct SegmentSweeper {
    is_over: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl SegmentSweeper {
    /// Sweeps the session in this folder once its host is dead; until then the host does this itself. Every
    /// part runs a sweeper, because each may be the last to end, and starts it before joining, because
    /// joining opens segments. Dropping the sweeper removes whatever is left.
    ///
    /// # Errors
    /// If the folder does not belong to a session, or the system refuses to start the thread or to open the
    /// shared-memory folder.
    pub fn after_host(session: &Path) -> std::io::Result<SegmentSweeper> {
        let id = SessionId::of(session).ok_or(std::io::ErrorKind::InvalidInput)?;
        let folder = open_folder(session).map_err(std::io::Error::other)?;
        let sweep = Sweep::new(id.shared_memory_prefix())?;
        SegmentSweeper::run(move |is_over| sweep.after_host(&folder, is_over))
    }

    /// Sweeps the segments whose names start with `prefix`.
    ///
    /// # Errors
    /// If the system refuses to start the thread or to open the folder.
    pub(crate) fn start(prefix: String) -> std::io::Result<SegmentSweeper> {
        let sweep = Sweep::new(prefix)?;
        SegmentSweeper::run(move |is_over| sweep.until(is_over))
    }

    fn run(work: impl FnOnce(&AtomicBool) + Send + 'static) -> std::io::Result<SegmentSweeper> {
        let is_over = Arc::new(AtomicBool::new(false));
        let seen_over = Arc::clone(&is_over);
        let thread =
            std::thread::Builder::new().name("half-made".to_owned()).spawn(move || work(&seen_over))?;
        Ok(SegmentSweeper { is_over, thread: Some(thread) })
    }
}

/// State of the sweeping thread.
struct Sweep {
    memory: SharedMemory,
    prefix: String,
    empty_since: BTreeMap<String, Instant>,
}

impl Sweep {
    fn new(prefix: String) -> std::io::Result<Sweep> {
        Ok(Sweep { memory: SharedMemory::open()?, prefix, empty_since: BTreeMap::new() })
    }

    fn once(&mut self) {
        sweep(&self.memory, &self.prefix, &mut self.empty_since, Instant::now());
    }

    fn until(mut self, is_over: &AtomicBool) {
        while !is_over.load(Ordering::Relaxed) {
            std::thread::park_timeout(SWEEP_PERIOD);
            self.once();
        }
    }

    fn after_host(mut self, folder: &OwnedFd, is_over: &AtomicBool) {
        while is_locked(folder) {
            if is_over.load(Ordering::Relaxed) {
                return;
            }
            std::thread::park_timeout(SWEEP_PERIOD);
        }
        while !is_over.load(Ordering::Relaxed) {
            self.once();
            std::thread::park_timeout(SWEEP_PERIOD);
        }
        // A client may outlive every part, and has no such thread. Removing a segment takes two sweeps.
        self.once();
        if !self.empty_since.is_empty() {
            std::thread::sleep(SWEEP_PERIOD);
            self.once();
        }
    }
}

impl Drop for SegmentSweeper {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            thread.thread().unpark();
            // The thread does not panic; if it did, sweeping simply stops.
            let _ = thread.join();
        }
    }
}

/// Removes every segment that also had size zero at the last sweep and whose creator is dead.
fn sweep(memory: &SharedMemory, prefix: &str, empty_since: &mut BTreeMap<String, Instant>, now: Instant) {
    let empty = memory.empty_segments(prefix);
    empty_since.retain(|name, _| empty.contains(name));
    for name in empty {
        match empty_since.get(&name) {
            None => {
                empty_since.insert(name, now);
            }
            Some(since) if !makers(&name).all(is_alive) || now.duration_since(*since) >= LONGEST_MAKING => {
                memory.remove(&name);
            }
            Some(_) => {}
        }
    }
}

/// Processes whose numbers are in a segment's name. A connection's name holds those of both ends.
fn makers(name: &str) -> impl Iterator<Item = u32> + '_ {
    let numbers = name.split(['_', '.']).filter_map(|part| part.parse::<u128>().ok());
    numbers.filter(|number| *number > u128::from(u64::MAX)).map(process_of)
}

#[cfg(test)]
mod tests {
    use std::fs::{self, File};
    use std::path::PathBuf;

    use rustix::fs::{FlockOperation, flock};

    use super::*;

    struct Segment(PathBuf);

    impl Segment {
        fn make(prefix: &str, maker: u32, bytes: u64) -> Segment {
            let number = (u128::from(maker) << 64) | 77;
            let path = PathBuf::from(format!("/dev/shm/{prefix}_0354a209_{number}.data"));
            File::create(&path).unwrap().set_len(bytes).unwrap();
            Segment(path)
        }
    }

    impl Drop for Segment {
        fn drop(&mut self) {
            let _ = fs::remove_file(&self.0);
        }
    }

    #[test]
    fn only_segments_without_a_size_go_and_at_once_only_those_of_dead_makers() {
        let prefix = format!("trabecula_half_made_test_{}_", std::process::id());
        let mut dead = std::process::Command::new("true").spawn().unwrap();
        dead.wait().unwrap();
        let living = std::process::id();
        let half_made = Segment::make(&prefix, dead.id(), 0);
        let whole = Segment::make(&format!("{prefix}whole"), dead.id(), 10);
        let in_the_making = Segment::make(&prefix, living, 0);
        let foreign = Segment::make("trabecula_half_made_foreign", dead.id(), 0);
        let memory = SharedMemory::open().unwrap();
        let (mut empty_since, now) = (BTreeMap::new(), Instant::now());
        sweep(&memory, &prefix, &mut empty_since, now);
        assert!(half_made.0.exists(), "its maker may have died since the name was read");
        sweep(&memory, &prefix, &mut empty_since, now);
        let left = [&half_made, &whole, &in_the_making, &foreign].map(|segment| segment.0.exists());
        assert_eq!(left, [false, true, true, true]);
        sweep(&memory, &prefix, &mut empty_since, now + LONGEST_MAKING);
        assert!(!in_the_making.0.exists() && whole.0.exists());
    }

    /// Regression: a run without a recorder hung if its launcher was killed while creating a segment, because
    /// only launcher and recorder swept.
    #[test]
    fn a_part_sweeps_when_its_host_is_dead_and_a_last_time_when_it_ends() {
        let prefix = format!("trabecula_half_made_after_host_{}_", std::process::id());
        let mut dead = std::process::Command::new("true").spawn().unwrap();
        dead.wait().unwrap();
        let folder = tempfile::tempdir().unwrap();
        let open = || OwnedFd::from(File::open(folder.path()).unwrap());
        let host = open();
        flock(&host, FlockOperation::NonBlockingLockExclusive).unwrap();
        let half_made = Segment::make(&prefix, dead.id(), 0);
        let ended = AtomicBool::new(true);
        Sweep::new(prefix.clone()).unwrap().after_host(&open(), &ended);
        assert!(half_made.0.exists(), "the host sweeps while it is alive");
        // Not by closing it: the child that the other test forks may hold a copy of the handle.
        flock(&host, FlockOperation::Unlock).unwrap();
        Sweep::new(prefix).unwrap().after_host(&open(), &ended);
        assert!(!half_made.0.exists());
    }
}
