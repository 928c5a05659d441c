//! Limits of waiting that count only time in which the process ran.

const MS: u64 = 1_000_000;
/// Most of the time between two looks that counts, as long as it is no more than half of the limit. What is longer was
/// spent stopped (Ctrl-Z, SIGSTOP, a frozen container): the other side had stood still too, or could not be heard.
const LONGEST_LOOK_NS: u64 = 1000 * MS;
/// Time between two looks.
const LOOK_NS: u64 = 200 * MS;

/// A limit of waiting.
#[derive(Debug, Clone)]
pub struct Patience {
    limit_ns: u64,
    left_ns: u64,
    looked_ns: u64,
}

impl Patience {
    /// A limit that begins now.
    pub fn new(limit_ns: u64, now_ns: u64) -> Patience {
        Patience { limit_ns, left_ns: limit_ns, looked_ns: now_ns }
    }

    /// Whether it is over; to be asked again before [`next_look_ns`](Patience::next_look_ns).
    pub fn is_over(&mut self, now_ns: u64) -> bool {
        let passed_ns = now_ns.saturating_sub(std::mem::replace(&mut self.looked_ns, now_ns));
        self.left_ns = self.left_ns.saturating_sub(passed_ns.min(LONGEST_LOOK_NS).min(self.limit_ns / 2));
        self.left_ns == 0
    }

    /// Until when one may wait before it is asked again.
    pub fn next_look_ns(&self, now_ns: u64) -> u64 {
        now_ns + LOOK_NS.min(self.limit_ns / 4).min(self.left_ns)
    }

    /// The whole limit.
    pub fn limit_ns(&self) -> u64 {
        self.limit_ns
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A run that was suspended with Ctrl-Z ended when it was woken: its controller had not answered "within the limit".
    #[test]
    fn time_spent_stopped_does_not_count() {
        for limit_ns in [500 * MS, 60_000 * MS] {
            let mut now_ns = 7;
            let mut patience = Patience::new(limit_ns, now_ns);
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
