//! What a reader grants programs that flood: to each its ration, so that what others have sent is found behind it, and
//! few words about what was refused.

use std::time::{Duration, Instant};

use crate::identity::Sender;

/// Messages that a queue which every client may write is looked through for at a time. Taking one and passing it over is
/// faster than sending it, so even a queue that is filled all the time runs empty now and then.
pub const LOOKED_AT: usize = 256;

/// Messages of one connection that count within [`PERIOD`]: more than a program can send that waits for its answers.
const EACH: usize = 64;
const PERIOD: Duration = Duration::from_millis(10);
/// Texts that are said one by one within [`SAYING`].
const TEXTS: usize = 16;
const SAYING: Duration = Duration::from_millis(100);

/// How many messages of each connection count.
#[derive(Debug)]
pub struct Ration {
    began: Instant,
    taken: Vec<(Sender, usize)>,
}

impl Default for Ration {
    fn default() -> Self {
        Ration { began: Instant::now(), taken: Vec::new() }
    }
}

impl Ration {
    /// Whether one more message of this connection is within its ration.
    pub fn allows(&mut self, sender: Sender) -> bool {
        if self.began.elapsed() >= PERIOD {
            *self = Ration::default();
        }
        match self.taken.iter_mut().find(|(other, _)| *other == sender) {
            Some((_, count)) => {
                *count += 1;
                *count <= EACH
            }
            None => {
                self.taken.push((sender, 1));
                true
            }
        }
    }
}

/// How many texts are said one by one; further ones are counted, and said together.
#[derive(Debug)]
pub struct Remarks {
    began: Instant,
    said: usize,
    unsaid: u64,
}

impl Default for Remarks {
    fn default() -> Self {
        Remarks { began: Instant::now(), said: 0, unsaid: 0 }
    }
}

impl Remarks {
    /// Whether one more text is said; if not, it counts.
    pub fn allows(&mut self) -> bool {
        if self.unsaid == 0 && self.began.elapsed() >= SAYING {
            *self = Remarks::default();
        }
        let allowed = self.said < TEXTS;
        self.said += usize::from(allowed);
        self.unsaid += u64::from(!allowed);
        allowed
    }

    /// How many texts were not said, when it is time to say so.
    pub fn unsaid(&mut self) -> Option<u64> {
        let unsaid = self.unsaid;
        if unsaid == 0 || self.began.elapsed() < SAYING {
            return None;
        }
        *self = Remarks::default();
        Some(unsaid)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// In lockstep a flood is looked at many thousand times a second: a bound on each look bounded nothing.
    #[test]
    fn texts_beyond_the_first_are_counted_and_said_once() {
        let mut remarks = Remarks::default();
        assert_eq!((0..1000).filter(|_| remarks.allows()).count(), TEXTS);
        remarks.began -= SAYING;
        assert!(!remarks.allows(), "not before those that wait have been said");
        assert_eq!(remarks.unsaid(), Some(1001 - TEXTS as u64));
        assert_eq!(remarks.unsaid(), None);
        assert!(remarks.allows());
    }
}
