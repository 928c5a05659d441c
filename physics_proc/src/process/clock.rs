//! Clocks, and sleeping by them.

use std::num::NonZeroU64;

use ipc_types::clock::now_ns;
use ipc_types::scene::Wait;
use ipc_types::wake::allowed_cores;
use rustix::time::{ClockId, Timespec, clock_gettime};

/// Processor time of this thread in nanoseconds; the kernel leaves out what a hypervisor stole, where it is told.
pub(super) fn thread_cpu_ns() -> u64 {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    time.tv_sec as u64 * 1_000_000_000 + time.tv_nsec as u64
}

/// Before its deadline a hybrid wait stops sleeping by this much: two wake-ups of a halted virtual core.
const SPIN_TIME_NS: u64 = 100_000;

/// Waits for deadlines.
#[derive(Debug)]
pub(super) struct Sleeper {
    wait: Wait,
    cores: usize,
}

impl Sleeper {
    /// For this thread, with the cores that it may use now.
    pub(super) fn new(wait: Wait) -> Sleeper {
        Sleeper { wait, cores: allowed_cores() }
    }

    /// Waits until the monotonic clock shows `deadline_ns`. A signal ends the wait early. Nothing spins on one core.
    ///
    /// The last moments before the deadline are the tick's: a yield there would give the core to a renderer's thread, which Linux does
    /// not take it from before its next tick, up to 4 ms later.
    pub(super) fn wait_until(&self, deadline_ns: u64) {
        match self.wait {
            Wait::Event => sleep_until(deadline_ns),
            _ if self.cores <= 1 => sleep_until(deadline_ns),
            Wait::Spin => spin_until(deadline_ns),
            Wait::Hybrid => {
                let awake_ns = deadline_ns.saturating_sub(SPIN_TIME_NS);
                sleep_until(awake_ns);
                if now_ns() >= awake_ns {
                    spin_until(deadline_ns);
                }
            }
        }
    }
}

/// Looks at the monotonic clock until it shows `deadline_ns`.
fn spin_until(deadline_ns: u64) {
    while now_ns() < deadline_ns {
        std::hint::spin_loop();
    }
}

/// Sleeps until the monotonic clock shows `deadline_ns`.
fn sleep_until(deadline_ns: u64) {
    if now_ns() >= deadline_ns {
        return;
    }
    let request = Timespec {
        tv_sec: (deadline_ns / 1_000_000_000) as i64,
        tv_nsec: (deadline_ns % 1_000_000_000) as i64,
    };
    // An interrupted sleep is looked at by the caller, which knows whether to end.
    let _ = rustix::thread::clock_nanosleep_absolute(ClockId::Monotonic, &request);
}

/// Has the kernel end this thread's sleeps when they are due, not up to 50 µs later.
pub(super) fn wake_exactly() {
    // Where it refuses, sleeps are that much less exact, which the lateness of ticks shows.
    let _ = rustix::thread::set_current_timer_slack(NonZeroU64::new(1));
}
