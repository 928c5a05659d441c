//! Timeouts that count only the time in which the process ran.

const MS: u64 = 1_000_000;
/// Longest time between two polls that counts toward a limit, capped at half of the limit. A longer gap means
/// that the process was stopped (Ctrl-Z, SIGSTOP, a frozen container); then the other side was stopped too,
/// or its messages could not be received.
const LONGEST_LOOK_NS: u64 = 1000 * MS;
/// Poll interval.
const LOOK_NS: u64 = 200 * MS;

const _: () =
    assert!(LOOK_NS < LONGEST_LOOK_NS, "a process that polls in time is not taken for a stopped one");

/// A timeout.
#[derive(Debug, Clone)]
pub struct ProcessTimeout {
    limit_ns: u64,
    left_ns: u64,
    looked_ns: u64,
}

impl ProcessTimeout {
    /// Creates a timeout that starts now.
    pub fn new(limit_ns: u64, now_ns: u64) -> ProcessTimeout {
        ProcessTimeout { limit_ns, left_ns: limit_ns, looked_ns: now_ns }
    }

    /// Returns whether the timeout has expired. Call it again before
    /// [`next_look_ns`](ProcessTimeout::next_look_ns).
    pub fn is_over(&mut self, now_ns: u64) -> bool {
        let passed_ns = now_ns.saturating_sub(std::mem::replace(&mut self.looked_ns, now_ns));
        self.left_ns = self.left_ns.saturating_sub(passed_ns.min(LONGEST_LOOK_NS).min(self.limit_ns / 2));
        self.left_ns == 0
    }

    /// Returns the latest time of the next call to [`is_over`](ProcessTimeout::is_over).
    pub fn next_look_ns(&self, now_ns: u64) -> u64 {
        now_ns + LOOK_NS.min(self.limit_ns / 4).min(self.left_ns)
    }

    /// Returns the time at which it was started or last checked.
    pub fn looked_ns(&self) -> u64 {
        self.looked_ns
    }

    /// Returns the full limit, ns.
    pub fn limit_ns(&self) -> u64 {
        self.limit_ns
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A run suspended with Ctrl-Z must not time out its controllers when it resumes.
    #[test]
    fn time_spent_stopped_does_not_count() {
        for limit_ns in [500 * MS, 60_000 * MS] {
            let mut now_ns = 7;
            let mut patience = ProcessTimeout::new(limit_ns, now_ns);
            now_ns += 3_600_000 * MS;
            assert!(!patience.is_over(now_ns), "{limit_ns}");
            for _ in 0..limit_ns / LOOK_NS.min(limit_ns / 4) {
                now_ns += LOOK_NS.min(limit_ns / 4);
                patience.is_over(now_ns);
            }
            assert!(patience.is_over(now_ns), "{limit_ns}");
        }
    }
}
