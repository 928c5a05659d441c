//! Rate limits per sender and for warnings, so that a flooding client can neither stall the tick nor fill the
//! log.

const MS: u64 = 1_000_000;

/// Maximum number of messages read per poll from a queue that every client may write to. Taking and skipping
/// a message is faster than sending one, so even a queue under constant flood runs empty now and then.
pub const LOOKED_AT: usize = 256;

/// Messages accepted from one connection within [`PERIOD_NS`]: more than a program that waits for its replies
/// can send.
const EACH: usize = 64;
const PERIOD_NS: u64 = 10 * MS;
/// Warnings sent individually within [`WARNING_PERIOD_NS`].
const WARNINGS: usize = 16;
const WARNING_PERIOD_NS: u64 = 100 * MS;

const _: () = assert!(EACH < LOOKED_AT, "one poll sees more than one connection may send");

/// One connection of a sender; the number changes each time it reconnects.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Connection(pub u128);

/// Rate limit for messages, per connection.
#[derive(Debug, Clone, Default)]
pub struct RateLimit {
    began_ns: u64,
    taken: Vec<(Connection, usize)>,
}

impl RateLimit {
    /// Counts a message against the connection's limit; returns false if the limit is exceeded.
    pub fn allows(&mut self, connection: Connection, now_ns: u64) -> bool {
        if now_ns.saturating_sub(self.began_ns) >= PERIOD_NS {
            self.began_ns = now_ns;
            self.taken.clear();
        }
        match self.taken.iter_mut().find(|(other, _)| *other == connection) {
            Some((_, count)) => {
                *count += 1;
                *count <= EACH
            }
            None => {
                self.taken.push((connection, 1));
                true
            }
        }
    }
}

/// Rate limit for warnings: suppressed ones are counted, and their number is reported.
#[derive(Debug, Clone, Default)]
pub struct WarningLimit {
    began_ns: u64,
    sent: usize,
    suppressed: u64,
}

impl WarningLimit {
    /// Returns whether to send one more warning; if not, counts it as suppressed.
    pub fn allows(&mut self, now_ns: u64) -> bool {
        if self.suppressed == 0 && now_ns.saturating_sub(self.began_ns) >= WARNING_PERIOD_NS {
            *self = WarningLimit { began_ns: now_ns, ..WarningLimit::default() };
        }
        let allowed = self.sent < WARNINGS;
        self.sent += usize::from(allowed);
        self.suppressed += u64::from(!allowed);
        allowed
    }

    /// Returns the number of suppressed warnings when it is time to report it. Reads the clock only if there
    /// are any, because it is called several times in every tick.
    pub fn take_suppressed(&mut self, now_ns: impl FnOnce() -> u64) -> Option<u64> {
        let suppressed = self.suppressed;
        if suppressed == 0 {
            return None;
        }
        let now_ns = now_ns();
        if now_ns.saturating_sub(self.began_ns) < WARNING_PERIOD_NS {
            return None;
        }
        *self = WarningLimit { began_ns: now_ns, ..WarningLimit::default() };
        Some(suppressed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// In lockstep the queue is polled many thousand times a second, so a limit per poll alone bounds
    /// nothing.
    #[test]
    fn warnings_beyond_the_first_are_counted_and_said_once() {
        let mut limit = WarningLimit::default();
        let start_ns = 5 * WARNING_PERIOD_NS;
        assert_eq!((0..1000).filter(|_| limit.allows(start_ns)).count(), WARNINGS);
        let later_ns = start_ns + WARNING_PERIOD_NS;
        assert!(!limit.allows(later_ns), "not before the suppressed ones have been reported");
        assert_eq!(limit.take_suppressed(|| later_ns), Some(1001 - WARNINGS as u64));
        assert_eq!(limit.take_suppressed(|| later_ns), None);
        assert!(limit.allows(later_ns));
    }

    #[test]
    fn a_connection_that_floods_takes_nothing_from_the_others() {
        let mut limit = RateLimit::default();
        let granted = (0..1000).filter(|_| limit.allows(Connection(1), PERIOD_NS)).count();
        assert_eq!(granted, EACH);
        assert!(limit.allows(Connection(2), PERIOD_NS));
        assert!(limit.allows(Connection(1), 2 * PERIOD_NS), "a new period");
    }
}
