//! Rate-limits the notes about a late controller: the first at once, then at most one a second, each with the
//! number suppressed since. A controller slower than the tick is late at nearly every tick;
//! `TickTiming.late_controllers` lists them all.

use messages::Tick;

/// Minimum simulated time between two notes.
const QUIET_NS: u64 = 1_000_000_000;

/// Notes of one kind about one controller.
#[derive(Debug, Clone, Copy, Default)]
pub struct LateNotes {
    noted_tick: Option<Tick>,
    left_out: u64,
}

impl LateNotes {
    /// Counts a late answer at `tick`. Returns what to append to the note, or `None` if no note is due.
    pub fn add(&mut self, tick: Tick, period_ns: u64) -> Option<String> {
        let quiet_ticks = QUIET_NS / period_ns.max(1);
        if self.noted_tick.is_some_and(|noted| tick < noted.saturating_add(quiet_ticks)) {
            self.left_out += 1;
            return None;
        }
        let before = self.noted_tick.replace(tick);
        match (std::mem::take(&mut self.left_out), before) {
            (left_out @ 1.., Some(before)) => Some(format!("; {left_out} more times since tick {before}")),
            _ => Some(String::new()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A controller that answers 120 times a second is late in a thousand ticks within eight seconds.
    #[test]
    fn the_first_note_is_sent_at_once_and_then_one_a_second_with_the_number_left_out() {
        let mut notes = LateNotes::default();
        let said: Vec<(u64, String)> = (100..5100)
            .step_by(8)
            .filter_map(|tick| Some((tick, notes.add(Tick(tick), 1_000_000)?)))
            .collect();
        let ticks: Vec<u64> = said.iter().map(|(tick, _)| *tick).collect();
        assert_eq!(ticks, [100, 1100, 2100, 3100, 4100]);
        assert_eq!(said[0].1, "");
        assert_eq!(said[1].1, "; 124 more times since tick 100");
        assert_eq!(notes.add(Tick(90_000), 1_000_000).as_deref(), Some("; 124 more times since tick 4100"));
        assert_eq!(notes.add(Tick(95_000), 1_000_000).as_deref(), Some(""), "nothing was left out");
    }
}
