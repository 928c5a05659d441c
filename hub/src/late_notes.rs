//! What is said of a controller that is late again and again: the first time at once, then at most once a second with the
//! number of times that were not said. A controller that is slower than the tick is late at nearly every one; which ticks
//! these were stands in `TickTiming.late_controllers`.

/// Simulated time without another note.
const QUIET_NS: u64 = 1_000_000_000;

/// Notes of one kind about one controller.
#[derive(Debug, Clone, Copy, Default)]
pub struct LateNotes {
    said_tick: Option<u64>,
    unsaid: u64,
}

impl LateNotes {
    /// It has happened at a tick. What to add to the note, or none: nothing is to be said now.
    pub fn add(&mut self, tick: u64, period_ns: u64) -> Option<String> {
        let quiet_ticks = QUIET_NS / period_ns.max(1);
        if self.said_tick.is_some_and(|said| tick < said.saturating_add(quiet_ticks)) {
            self.unsaid += 1;
            return None;
        }
        let before = self.said_tick.replace(tick);
        match (std::mem::take(&mut self.unsaid), before) {
            (unsaid @ 1.., Some(before)) => Some(format!("; {unsaid} more times since tick {before}")),
            _ => Some(String::new()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// At 120 answers a second a thousand notes were sent in eight seconds.
    #[test]
    fn the_first_is_said_at_once_and_the_others_once_a_second_with_their_number() {
        let mut notes = LateNotes::default();
        let said: Vec<(u64, String)> =
            (100..5100).step_by(8).filter_map(|tick| Some((tick, notes.add(tick, 1_000_000)?))).collect();
        let ticks: Vec<u64> = said.iter().map(|(tick, _)| *tick).collect();
        assert_eq!(ticks, [100, 1100, 2100, 3100, 4100]);
        assert_eq!(said[0].1, "");
        assert_eq!(said[1].1, "; 124 more times since tick 100");
        assert_eq!(notes.add(90_000, 1_000_000).as_deref(), Some("; 124 more times since tick 4100"));
        assert_eq!(notes.add(95_000, 1_000_000).as_deref(), Some(""), "nothing was left out");
    }
}
