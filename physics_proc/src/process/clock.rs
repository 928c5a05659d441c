//! Clocks, and sleeping until a deadline.

use std::num::NonZeroU64;

use ipc_types::clock::now_ns;
use ipc_types::scene::Wait;
use ipc_types::wake::allowed_cores;
use rustix::time::{ClockId, Timespec, clock_gettime};

/// Reads this thread's processor time, ns; excludes time stolen by the hypervisor if the kernel reports it.
pub(super) fn thread_cpu_ns() -> u64 {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    time.tv_sec as u64 * 1_000_000_000 + time.tv_nsec as u64
}

/// A hybrid wait stops sleeping this long before its deadline: two wake-ups of a halted virtual core.
const SPIN_TIME_NS: u64 = 100_000;

/// Waits for deadlines.
#[derive(Debug)]
pub(super) struct Sleeper {
    wait: Wait,
    cores: usize,
}

impl Sleeper {
    /// Creates a sleeper for the current thread and the cores that it can use now.
    pub(super) fn new(wait: Wait) -> Sleeper {
        Sleeper { wait, cores: allowed_cores() }
    }

    /// Waits until the monotonic clock reaches `deadline_ns`. A signal ends the wait early. Never spins on a
    /// single core.
    ///
    /// Does not yield just before the deadline: a yield could hand the core to a renderer's thread, which
    /// Linux would not preempt before its next tick, up to 4 ms later.
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

/// Polls the monotonic clock until it reaches `deadline_ns`.
fn spin_until(deadline_ns: u64) {
    while now_ns() < deadline_ns {
        std::hint::spin_loop();
    }
}

/// Sleeps until the monotonic clock reaches `deadline_ns`.
fn sleep_until(deadline_ns: u64) {
    if now_ns() >= deadline_ns {
        return;
    }
    let request = Timespec {
        tv_sec: (deadline_ns / 1_000_000_000) as i64,
        tv_nsec: (deadline_ns % 1_000_000_000) as i64,
    };
    // The caller checks after an interrupted sleep, because it knows whether to end.
    let _ = rustix::thread::clock_nanosleep_absolute(ClockId::Monotonic, &request);
}

/// Sets the timer slack so that the kernel ends this thread's sleeps on time, not up to 50 µs late.
pub(super) fn wake_exactly() {
    // If the kernel refuses, sleeps are less exact, which shows in the ticks' lateness.
    let _ = rustix::thread::set_current_timer_slack(NonZeroU64::new(1));
}
