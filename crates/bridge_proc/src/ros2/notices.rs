//! Rate-limited lines about rejected messages: flooding a topic must not flood a terminal or a log.

use std::time::{Duration, Instant};

const PERIOD: Duration = Duration::from_secs(1);

pub(crate) struct Notices<F> {
    say: F,
    next: Instant,
    held_back: u64,
}

impl<F: FnMut(&str)> Notices<F> {
    pub(crate) fn new(say: F) -> Notices<F> {
        Notices { say, next: Instant::now(), held_back: 0 }
    }

    /// Prints a line, unless one was printed within the last second. Returns it as printed, for the log.
    pub(crate) fn say(&mut self, line: &str) -> Option<String> {
        if Instant::now() < self.next {
            self.held_back += 1;
            return None;
        }
        self.next = Instant::now() + PERIOD;
        let more = std::mem::take(&mut self.held_back);
        let line =
            if more > 0 { format!("{line} ({more} more since the last line)") } else { line.to_owned() };
        (self.say)(&line);
        Some(line)
    }

    /// Reports how many lines were suppressed since the last one.
    pub(crate) fn close(&mut self) {
        if self.held_back > 0 {
            (self.say)(&format!("{} more notices were suppressed", self.held_back));
        }
    }
}
