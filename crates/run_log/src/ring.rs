//! Decides which logs of a flight recorder begin, are saved and are dropped.
//!
//! A new log begins at the first keyframe a *period* after the last one, and every message goes to all open
//! logs. So the older one always reaches back at least a period. Once it is no longer needed for that, not
//! even by a trigger that is read late, it is dropped, unless a trigger has chosen it: then it continues
//! until the ticks after the trigger are recorded. Open logs are thus bounded in number and length, and
//! each saved log is a single file.

use std::fmt;

use messages::Tick;

/// A trigger continues a log that is being saved only until the log is this many periods long.
const EXTENDED_PERIODS: u64 = 4;
/// Number of causes that the end of a saved log names.
const CAUSES_NAMED: usize = 8;

/// The open logs, oldest first.
#[derive(Debug, Clone)]
pub struct Ring {
    period_ticks: u64,
    late_ticks: u64,
    saved_at_most: u64,
    saved: u64,
    open: Vec<OpenLog>,
}

#[derive(Debug, Clone)]
struct OpenLog {
    first_tick: Tick,
    save: Option<Save>,
}

/// Why and until when a log is recorded that is to be kept.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Save {
    /// Number of the saved log, from 1.
    pub number: u64,
    /// The tick with which it may end.
    pub until: Tick,
    causes: Vec<String>,
    more_causes: u64,
}

impl fmt::Display for Save {
    /// The causes.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.causes.join("; "))?;
        if self.more_causes > 0 {
            write!(f, "; and {} more", self.more_causes)?;
        }
        Ok(())
    }
}

impl Save {
    fn extend(&mut self, until: Tick, cause: String) {
        self.until = self.until.max(until);
        if self.causes.len() < CAUSES_NAMED {
            self.causes.push(cause);
        } else {
            self.more_causes += 1;
        }
    }
}

/// Answer to a trigger.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Triggered {
    /// The ticks before and after it are being saved.
    Saving {
        /// Number of the saved log.
        number: u64,
        /// Its first tick.
        first_tick: Tick,
        /// The tick with which it may end.
        until: Tick,
        /// Whether the log was already being saved for an earlier trigger.
        is_extended: bool,
    },
    /// As many logs as allowed have been saved.
    Full,
}

/// What becomes of a log that is open at the end of a run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Fate {
    /// It is the log of the end of the run.
    Last,
    /// It is saved.
    Saved(Save),
    /// It is dropped.
    Dropped,
}

impl Ring {
    /// Returns the logs of a run with one open log, which begins with the run. A trigger may be read up to
    /// `late_ticks` later than its tick.
    pub fn new(period_ticks: u64, late_ticks: u64, saved_at_most: u64) -> Ring {
        let open = vec![OpenLog { first_tick: Tick::START, save: None }];
        Ring { period_ticks: period_ticks.max(1), late_ticks, saved_at_most, saved: 0, open }
    }

    /// The tick from which the next log may begin.
    pub fn next_begin(&self) -> Tick {
        self.open.last().map_or(Tick::START, |log| log.first_tick.saturating_add(self.period_ticks))
    }

    /// Notes that another log has begun.
    pub fn begun(&mut self, first_tick: Tick) {
        self.open.push(OpenLog { first_tick, save: None });
    }

    /// Forgets the open logs that no trigger needs once this tick is recorded; returns their places, last
    /// first.
    pub fn unneeded(&mut self, tick: Tick) -> Vec<usize> {
        let Some(needed) = self.unsaved_since_a_period(self.earliest_trigger(tick)) else {
            return Vec::new();
        };
        let dropped: Vec<usize> =
            (0..needed).rev().filter(|place| self.open[*place].save.is_none()).collect();
        dropped.iter().for_each(|place| drop(self.open.remove(*place)));
        dropped
    }

    /// Saves what is before a tick, and `after_ticks` after it.
    pub fn trigger(&mut self, tick: Tick, after_ticks: u64, cause: &str) -> Triggered {
        let (cause, until) = (format!("tick {tick}: {cause}"), tick.saturating_add(after_ticks));
        let longest = self.period_ticks.saturating_mul(EXTENDED_PERIODS);
        let is_short = |log: &OpenLog| log.first_tick.saturating_add(longest) > tick;
        let saved = |log: &OpenLog| log.save.is_some() && self.covers(log, tick);
        let found = self.open.iter().rposition(|log| saved(log) && is_short(log));
        let found = found.or_else(|| self.unsaved_since_a_period(tick));
        let found = found.or_else(|| self.open.iter().rposition(saved));
        // There is always one that reaches back a period, but not before a tick of the past.
        let Some(place) = found.or((!self.open.is_empty()).then_some(0)) else { return Triggered::Full };
        let is_extended = self.open[place].save.is_some();
        let log = &mut self.open[place];
        let save = match &mut log.save {
            Some(save) => save,
            None if self.saved >= self.saved_at_most => return Triggered::Full,
            None => {
                self.saved += 1;
                let empty = Save { number: self.saved, until, causes: Vec::new(), more_causes: 0 };
                log.save.insert(empty)
            }
        };
        save.extend(until, cause);
        let (number, until) = (save.number, save.until);
        Triggered::Saving { number, first_tick: log.first_tick, until, is_extended }
    }

    /// Returns the place of an open log that is to be saved and complete at this tick, and forgets it. As
    /// long as no other log reaches back a period, it continues: the next trigger may need it.
    pub fn complete(&mut self, tick: Tick) -> Option<(usize, Save)> {
        let is_complete = |(place, log): (usize, &OpenLog)| {
            let others = || self.open.iter().enumerate().filter(|(other, _)| *other != place);
            log.save.as_ref().is_some_and(|save| save.until <= tick)
                && others().any(|(_, other)| self.covers(other, self.earliest_trigger(tick)))
        };
        let place = self.open.iter().enumerate().position(is_complete)?;
        Some((place, self.open.remove(place).save?))
    }

    /// Returns what becomes of each open log at the end of the run. The log of the end is one that reaches
    /// back a period, if there is one, and preferably one that is not saved.
    pub fn end(&mut self, tick: Tick) -> Vec<Fate> {
        let covering = self.open.iter().rposition(|log| self.covers(log, tick));
        let last = self.unsaved_since_a_period(tick).or(covering).unwrap_or(0);
        let fate = |(place, log): (usize, OpenLog)| match log.save {
            _ if place == last => Fate::Last,
            Some(save) => Fate::Saved(save),
            None => Fate::Dropped,
        };
        std::mem::take(&mut self.open).into_iter().enumerate().map(fate).collect()
    }

    /// Returns the earliest tick whose trigger may still be read.
    fn earliest_trigger(&self, tick: Tick) -> Tick {
        Tick(tick.0.saturating_sub(self.late_ticks))
    }

    /// Returns whether a log reaches back a period from this tick, or to the start of the run.
    fn covers(&self, log: &OpenLog, tick: Tick) -> bool {
        log.first_tick == Tick::START || log.first_tick.saturating_add(self.period_ticks) <= tick
    }

    /// Returns the place of the youngest log that is not saved and reaches back a period.
    fn unsaved_since_a_period(&self, tick: Tick) -> Option<usize> {
        self.open.iter().rposition(|log| log.save.is_none() && self.covers(log, tick))
    }
}
