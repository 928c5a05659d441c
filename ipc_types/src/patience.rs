//! Limits of waiting that count only time in which this process ran.

use std::time::{Duration, Instant};

/// Most of the time between two looks that counts, as long as it is no more than half of the limit. What is longer was
/// spent stopped (Ctrl-Z, SIGSTOP, a frozen container): then the other side had stood still, too, or could not be heard.
const LONGEST_LOOK: Duration = Duration::from_secs(1);
/// Time between two looks.
const LOOK: Duration = Duration::from_millis(200);

/// A limit of waiting.
#[derive(Debug, Clone)]
pub struct Patience {
    limit: Duration,
    left: Duration,
    looked: Instant,
}

impl Patience {
    /// A limit that begins now.
    pub fn new(limit: Duration) -> Patience {
        Patience { limit, left: limit, looked: Instant::now() }
    }

    /// Whether it is over; to be asked again before [`next_look`](Patience::next_look).
    pub fn is_over(&mut self) -> bool {
        let now = Instant::now();
        let passed = now.duration_since(std::mem::replace(&mut self.looked, now));
        self.left = self.left.saturating_sub(passed.min(LONGEST_LOOK).min(self.limit / 2));
        self.left.is_zero()
    }

    /// Until when one may wait before it is asked again.
    pub fn next_look(&self) -> Instant {
        Instant::now() + LOOK.min(self.limit / 4).min(self.left)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A run that was suspended with Ctrl-Z ended when it was woken: its controller had not answered "within the limit".
    #[test]
    fn time_spent_stopped_does_not_count() {
        for limit in [Duration::from_millis(500), Duration::from_secs(60)] {
            let mut patience = Patience::new(limit);
            patience.looked -= Duration::from_secs(3600);
            assert!(!patience.is_over(), "{limit:?}");
            let looks = limit.as_millis() / LOOK.min(limit / 4).as_millis();
            for _ in 0..looks {
                patience.looked -= LOOK.min(limit / 4);
                patience.is_over();
            }
            assert!(patience.is_over(), "{limit:?}");
        }
    }
}
