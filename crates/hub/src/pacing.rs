//! The schedule of ticks in real time.

/// Absolute deadlines on the monotonic clock, one per period.
#[derive(Debug, Clone)]
pub struct Schedule {
    period_ns: u64,
    next_ns: u64,
    missed: u64,
}

/// When a tick began, relative to its deadline.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Start {
    /// Time since the deadline, ns.
    pub lateness_ns: i64,
    /// Whether the tick began more than one period late.
    pub missed: bool,
}

impl Schedule {
    /// Creates a schedule whose first deadline is `now_ns`.
    pub fn new(period_ns: u64, now_ns: u64) -> Schedule {
        Schedule { period_ns, next_ns: now_ns, missed: 0 }
    }

    /// Resumes at `now_ns` after a pause. The pause does not count as a miss; earlier misses still count.
    pub fn go_on(&mut self, now_ns: u64) {
        self.next_ns = now_ns;
    }

    /// Returns the deadline of the next tick.
    pub fn deadline_ns(&self) -> u64 {
        self.next_ns
    }

    /// Begins a tick now. After a miss the schedule restarts from here: lost time is not made up.
    pub fn begin(&mut self, now_ns: u64) -> Start {
        let lateness_ns = now_ns as i64 - self.next_ns as i64;
        let missed = lateness_ns > self.period_ns as i64;
        if missed {
            self.missed += 1;
            self.next_ns = now_ns;
        }
        self.next_ns += self.period_ns;
        Start { lateness_ns, missed }
    }

    /// Returns the number of ticks that began more than a period late.
    pub fn missed(&self) -> u64 {
        self.missed
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_lateness_does_not_move_the_schedule_and_a_miss_does() {
        let mut schedule = Schedule::new(1000, 5000);
        assert_eq!(schedule.begin(5100), Start { lateness_ns: 100, missed: false });
        assert_eq!(schedule.deadline_ns(), 6000);
        assert_eq!(schedule.begin(8500), Start { lateness_ns: 2500, missed: true });
        // No burst to catch up: the next tick is one period from now.
        assert_eq!(schedule.deadline_ns(), 9500);
        assert_eq!(schedule.missed(), 1);
    }

    /// A pause must not reset the count of missed deadlines.
    #[test]
    fn misses_before_a_pause_still_count() {
        let mut schedule = Schedule::new(1000, 5000);
        assert!(schedule.begin(8500).missed);
        schedule.go_on(1_000_000);
        assert_eq!(schedule.begin(1_000_000), Start { lateness_ns: 0, missed: false });
        assert_eq!(schedule.missed(), 1);
    }
}
