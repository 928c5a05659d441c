//! When ticks begin in real time.

/// Absolute deadlines on the monotonic clock, one a period.
#[derive(Debug, Clone)]
pub struct Schedule {
    period_ns: u64,
    next_ns: u64,
    missed: u64,
}

/// How a tick began.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Start {
    /// How long after its deadline.
    pub lateness_ns: i64,
    /// Whether that was more than a period.
    pub missed: bool,
}

impl Schedule {
    /// The first deadline is `now_ns`.
    pub fn new(period_ns: u64, now_ns: u64) -> Schedule {
        Schedule { period_ns, next_ns: now_ns, missed: 0 }
    }

    /// Goes on at `now_ns` after a pause, which is no miss; what was missed before still counts.
    pub fn go_on(&mut self, now_ns: u64) {
        self.next_ns = now_ns;
    }

    /// Deadline of the next tick.
    pub fn deadline_ns(&self) -> u64 {
        self.next_ns
    }

    /// A tick begins now. After a miss the schedule starts anew from here: lost time is not made up for.
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

    /// Ticks that began more than a period late.
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
        // No burst of three ticks: the next one is a period from now.
        assert_eq!(schedule.deadline_ns(), 9500);
        assert_eq!(schedule.missed(), 1);
    }

    /// A run that was paused said afterwards that it had missed nothing before.
    #[test]
    fn misses_before_a_pause_still_count() {
        let mut schedule = Schedule::new(1000, 5000);
        assert!(schedule.begin(8500).missed);
        schedule.go_on(1_000_000);
        assert_eq!(schedule.begin(1_000_000), Start { lateness_ns: 0, missed: false });
        assert_eq!(schedule.missed(), 1);
    }
}
