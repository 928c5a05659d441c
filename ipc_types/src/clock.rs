//! The monotonic clock of this machine.

use rustix::time::{ClockId, clock_gettime};

/// Reads the monotonic clock, ns.
pub fn now_ns() -> u64 {
    let time = clock_gettime(ClockId::Monotonic);
    time.tv_sec as u64 * 1_000_000_000 + time.tv_nsec as u64
}
