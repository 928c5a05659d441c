//! Measures how long a run takes to report an error or to continue, counted in polls and not in seconds: on a
//! slow machine the polls are delayed like everything else, so their number means the same on every machine.

use std::time::{Duration, Instant};

use crate::common::program::{LIMIT, Run};
use crate::table::Outcome;

/// Interval between two polls.
const LOOK: Duration = Duration::from_millis(5);
/// Number of polls in two seconds.
pub const LOOK_LIMIT: u64 = 400;

/// Polls of a run since a fault.
#[derive(Debug)]
pub struct Looks {
    /// Permitted texts of the error.
    errors: [&'static str; 2],
    since: Instant,
    started: Instant,
    count: u64,
    /// Polls and milliseconds until the error was reported.
    found: Option<(u64, u64)>,
    over_ms: u64,
}

impl Looks {
    /// Starts counting at the fault.
    pub fn new(errors: [&'static str; 2]) -> Looks {
        let now = Instant::now();
        Looks { errors, since: now, started: now, count: 0, found: None, over_ms: 0 }
    }

    /// Restarts the count, because the fault occurs only now.
    pub fn restart(&mut self) {
        if self.found.is_none() {
            (self.since, self.count) = (Instant::now(), 0);
        }
    }

    /// Returns the number of polls so far.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Checks whether the run has reported the error, and waits until the next poll.
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

    /// Checks the final output, after everything has ended.
    pub fn end(&mut self, said: &str) {
        self.find(said);
        self.over_ms = self.since.elapsed().as_millis() as u64;
    }

    /// Asserts that the error was reported in time.
    pub fn assert_in_time(&self, what: &str) {
        assert!(self.found.is_some_and(|(looks, _)| looks <= LOOK_LIMIT), "{what}: {self:?}");
    }

    /// Returns the outcome, as far as timing is concerned.
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
