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
    let request = Timespec {
        tv_sec: (deadline_ns / 1_000_000_000) as i64,
        tv_nsec: (deadline_ns % 1_000_000_000) as i64,
    };
    // An interrupted sleep is looked at by the caller, which knows whether to end.
    let _ = rustix::thread::clock_nanosleep_absolute(ClockId::Monotonic, &request);
}

/// Per-thread counters that the kernel keeps.
#[derive(Debug)]
pub(super) struct ThreadCounters {
    schedstat: Option<File>,
    wait_ns: u64,
    switches: u64,
    page_faults: u64,
}

/// What has happened to this thread since the last look; 0 where the kernel does not say.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Disturbance {
    /// Time for which it waited for a core.
    pub(super) run_queue_wait_ns: u64,
    /// Page faults.
    pub(super) page_faults: u32,
}

impl ThreadCounters {
    pub(super) fn new() -> ThreadCounters {
        let schedstat = File::open("/proc/thread-self/schedstat").ok();
        let mut counters = ThreadCounters { schedstat, wait_ns: 0, switches: u64::MAX, page_faults: 0 };
        counters.since_last();
        counters
    }

    /// Looks at the counters.
    pub(super) fn since_last(&mut self) -> Disturbance {
        let Ok(usage) = getrusage(UsageWho::RUSAGE_THREAD) else { return Disturbance::default() };
        let faults = (usage.minor_page_faults() + usage.major_page_faults()) as u64;
        let switches = (usage.voluntary_context_switches() + usage.involuntary_context_switches()) as u64;
        let page_faults = (faults - self.page_faults.min(faults)) as u32;
        self.page_faults = faults;
        // A thread that was never taken off its core has not waited for one: the file, a microsecond to read, is
        // looked at only after a switch.
        let mut run_queue_wait_ns = 0;
        if switches != self.switches {
            self.switches = switches;
            let total_ns = self.total_wait_ns().unwrap_or(self.wait_ns);
            run_queue_wait_ns = total_ns.saturating_sub(self.wait_ns);
            self.wait_ns = total_ns;
        }
        Disturbance { run_queue_wait_ns, page_faults }
    }

    fn total_wait_ns(&self) -> Option<u64> {
        let mut text = [0; 96];
        let length = self.schedstat.as_ref()?.read_at(&mut text, 0).ok()?;
        let second = text[..length].split(|byte| *byte == b' ').nth(1)?;
        Some(second.iter().fold(0_u64, |sum, digit| sum * 10 + u64::from(digit.wrapping_sub(b'0'))))
    }
}

/// Nanoseconds since an instant.
pub(super) fn elapsed_ns(since: Instant) -> u64 {
    since.elapsed().as_nanos() as u64
}
