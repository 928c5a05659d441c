//! What the kernel says about this thread: time, waiting, faults.

use std::fs::File;
use std::os::unix::fs::FileExt;
use std::time::Instant;

use nix::sys::resource::{UsageWho, getrusage};
use rustix::time::{ClockId, Timespec, clock_gettime};

/// Monotonic clock in nanoseconds.
pub(super) fn now_ns() -> u64 {
    let time = clock_gettime(ClockId::Monotonic);
    time.tv_sec as u64 * 1_000_000_000 + time.tv_nsec as u64
}

/// Sleeps until the monotonic clock shows `deadline_ns`. A signal ends the sleep early.
pub(super) fn sleep_until(deadline_ns: u64) {
    let request =
        Timespec { tv_sec: (deadline_ns / 1_000_000_000) as i64, tv_nsec: (deadline_ns % 1_000_000_000) as i64 };
    // An interrupted sleep is looked at by the caller, which knows whether to end.
    let _ = rustix::thread::clock_nanosleep_absolute(ClockId::Monotonic, &request);
}

/// Per-thread counters that the kernel keeps.
#[derive(Debug)]
pub(super) struct ThreadCounters {
    schedstat: Option<File>,
    last_wait_ns: u64,
}

impl ThreadCounters {
    pub(super) fn new() -> ThreadCounters {
        let mut counters = ThreadCounters { schedstat: File::open("/proc/thread-self/schedstat").ok(), last_wait_ns: 0 };
        counters.run_queue_wait_ns();
        counters
    }

    /// Time this thread waited for a core since the last call; 0 where the kernel does not say.
    pub(super) fn run_queue_wait_ns(&mut self) -> u64 {
        let mut text = [0; 96];
        let Some(file) = &self.schedstat else { return 0 };
        let Ok(length) = file.read_at(&mut text, 0) else { return 0 };
        let second = text[..length].split(|byte| *byte == b' ').nth(1).unwrap_or_default();
        let total = second.iter().fold(0_u64, |sum, digit| sum * 10 + u64::from(digit.wrapping_sub(b'0')));
        let since = total.saturating_sub(self.last_wait_ns);
        self.last_wait_ns = total;
        since
    }

    /// Page faults of this thread so far; 0 where the kernel does not say.
    pub(super) fn page_faults(&self) -> u64 {
        let usage = getrusage(UsageWho::RUSAGE_THREAD);
        usage.map_or(0, |usage| (usage.minor_page_faults() + usage.major_page_faults()) as u64)
    }
}

/// Nanoseconds since an instant.
pub(super) fn elapsed_ns(since: Instant) -> u64 {
    since.elapsed().as_nanos() as u64
}
