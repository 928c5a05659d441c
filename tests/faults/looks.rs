//! How long a run takes to say what is wrong or to go on, counted in looks at it and not in seconds: on a
//! machine that is slow the looks come as late as everybody else does, so a count of them means the same on
//! every machine.

use std::time::{Duration, Instant};

use crate::common::program::{LIMIT, Run};
use crate::table::Outcome;

/// Time between two looks.
const LOOK: Duration = Duration::from_millis(5);
/// Looks of two seconds.
pub const LOOK_LIMIT: u64 = 400;

/// Looks at a run since a fault.
#[derive(Debug)]
pub struct Looks {
    /// What the error may say.
    errors: [&'static str; 2],
    since: Instant,
    started: Instant,
    count: u64,
    /// Looks and milliseconds until it was said.
    found: Option<(u64, u64)>,
    over_ms: u64,
}

impl Looks {
    /// The fault comes now.
    pub fn new(errors: [&'static str; 2]) -> Looks {
        let now = Instant::now();
        Looks { errors, since: now, started: now, count: 0, found: None, over_ms: 0 }
    }

    /// The fault has come only now.
    pub fn restart(&mut self) {
        if self.found.is_none() {
            (self.since, self.count) = (Instant::now(), 0);
        }
    }

    /// Looks so far.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Looks whether the run has said what is wrong, and waits until the next look.
    pub fn look(&mut self, run: &Run) {
        self.count += 1;
        self.find(&run.said());
        assert!(self.started.elapsed() < LIMIT, "neither an end nor a tick within {LIMIT:?}");
        std::thread::sleep(LOOK);
    }

    fn find(&mut self, said: &str) {
        if self.errors.iter().any(|words| said.contains(words)) {
            let elapsed_ms = self.since.elapsed().as_millis() as u64;
            self.found.get_or_insert((self.count, elapsed_ms));
        }
    }

    /// All is over, and this is what has been said.
    pub fn end(&mut self, said: &str) {
        self.find(said);
        self.over_ms = self.since.elapsed().as_millis() as u64;
    }

    /// It must have been said, and soon.
    pub fn assert_in_time(&self, what: &str) {
        assert!(self.found.is_some_and(|(looks, _)| looks <= LOOK_LIMIT), "{what}: {self:?}");
    }

    /// As far as time goes.
    pub fn outcome(&self, went_on: bool) -> Outcome {
        let named = self.found.filter(|_| !went_on);
        Outcome {
            went_on,
            named_after_looks: named.map(|(looks, _)| looks),
            named_after_ms: named.map(|(_, ms)| ms),
            over_after_ms: (!went_on).then_some(self.over_ms),
            ..Outcome::default()
        }
    }
}
