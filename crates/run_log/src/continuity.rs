//! Finds missing messages of a run lane from their sequence numbers.
//!
//! Every state and command carries its tick; every removal, keyframe part and frame carries a number that
//! increases by one. Missing messages are reported as stretches of ticks, each with its count of missing
//! messages per topic.

use std::cmp::Ordering;
use std::collections::BTreeMap;
use std::fmt;

use messages::{Frame, Keyframe, Latched, Removed, SensorReading, State, Tick};
use zerocopy::FromBytes;

use crate::end::EndMarker;
use crate::limits::MAX_REPORTED;
use crate::stream::TopicCount;
use crate::topics::Topic;

/// A range of ticks with messages missing from the log.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Stretch {
    /// First tick (`State.tick`).
    pub first_tick: Tick,
    /// Last tick, inclusive.
    pub last_tick: Tick,
    /// Number of missing messages, by topic.
    pub messages: BTreeMap<&'static str, u64>,
}

impl fmt::Display for Stretch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self.first_tick, self.last_tick) {
            (first, last) if first >= last => write!(f, "tick {first}")?,
            (first, last) => write!(f, "ticks {first} to {last}")?,
        }
        let each: Vec<String> = self.messages.iter().map(|(topic, n)| format!("{n} of {topic}")).collect();
        write!(f, ": {}", each.join(", "))
    }
}

/// Messages missing from a log.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Gap {
    /// The first stretches with missing messages, in tick order.
    pub stretches: Vec<Stretch>,
    /// Number of stretches beyond those listed.
    pub more: u64,
    /// Missing messages by topic. Includes those after the last tick and those of unnumbered topics, computed
    /// from the end marker's counts.
    pub lost: BTreeMap<String, u64>,
}

/// Sequence numbers of a run lane's messages read so far.
#[derive(Debug, Default)]
pub(crate) struct Continuity {
    /// Tick of the next command.
    next_latched: Tick,
    next_state: Tick,
    /// Whether the first state, which has removals before the log's beginning, is still to come.
    begins_late: bool,
    removed: Numbered,
    removed_total: u64,
    /// State whose removals have not arrived yet.
    owed: Option<Tick>,
    keyframe: Numbered,
    reading: Numbered,
    frame: Numbered,
    stretches: Vec<Stretch>,
    more: u64,
    lost: BTreeMap<&'static str, u64>,
}

/// Messages numbered from 1.
#[derive(Debug, Default)]
struct Numbered {
    last: u64,
    last_tick: Tick,
    /// Whether the first message may have any number, in a log that begins later than its run.
    begins_anywhere: bool,
}

/// Number and location of missing messages.
#[derive(Debug, Clone, Copy)]
struct Missing {
    first_tick: Tick,
    last_tick: Tick,
    count: u64,
    place: TickPrecision,
}

/// How precisely the ticks affected by a loss are known.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum TickPrecision {
    /// The first and last ticks are those affected.
    Exact,
    /// The loss lies somewhere between these ticks.
    Between,
}

/// Whether removals are among the topics being read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Removals {
    Read,
    Skipped,
}

impl Numbered {
    /// Returns what is missing before this message.
    fn see(&mut self, number: u64, tick: Tick) -> Option<Missing> {
        let expected = match std::mem::take(&mut self.begins_anywhere) {
            true => number,
            false => self.last.saturating_add(1),
        };
        let first = self.last_tick.saturating_add(u64::from(self.last > 0));
        (self.last, self.last_tick) = (number, tick);
        (number != expected).then(|| Missing {
            first_tick: first.min(tick),
            last_tick: tick,
            count: number.saturating_sub(expected).max(1),
            place: TickPrecision::Between,
        })
    }
}

impl Continuity {
    /// Returns the numbers expected of a log whose first state is of this tick. The header gives only that
    /// tick; where other numbers begin is unknown, and the end marker counts what is lost there.
    pub fn from_tick(first: Tick) -> Continuity {
        let begins_anywhere = first > Tick::START;
        let numbered = || Numbered { begins_anywhere, ..Numbered::default() };
        Continuity {
            next_latched: first,
            next_state: first,
            begins_late: begins_anywhere,
            removed: numbered(),
            keyframe: numbered(),
            reading: numbered(),
            frame: numbered(),
            ..Continuity::default()
        }
    }

    /// Checks a message's number; `topic` is `None` for topics unknown to this build.
    pub fn see(&mut self, topic: Option<Topic>, body: &[u8]) {
        match topic {
            Some(Topic::Latched) => {
                let Ok(latched) = Latched::read_from_bytes(body) else { return };
                // The command u_k leads to state k + 1.
                let (expected, tick) = (self.next_latched, Tick(latched.tick));
                self.next_latched = tick.saturating_add(1);
                self.ticks(Topic::Latched, expected.saturating_add(1), tick.saturating_add(1));
            }
            Some(Topic::State) => {
                let Ok(state) = State::read_from_bytes(body) else { return };
                let (expected, tick) = (self.next_state, Tick(state.tick));
                self.next_state = tick.saturating_add(1);
                self.ticks(Topic::State, expected, tick);
                if std::mem::take(&mut self.begins_late) {
                    self.removed_total = state.removed_total;
                }
                if state.removed_total == self.removed_total {
                    self.owed = None;
                } else {
                    self.owed.get_or_insert(tick);
                }
            }
            Some(Topic::Removed) => {
                let Ok((removed, _)) = Removed::read_from_prefix(body) else { return };
                self.removed_total = removed.removed_total;
                let missing = self.removed.see(removed.sequence, Tick(removed.tick));
                // A state that lacks removals and a jump in the removals' numbers are the same loss; count it
                // once.
                self.owed = self.owed.filter(|_| missing.is_none());
                self.numbered(Topic::Removed, missing);
            }
            Some(Topic::Sensor) => {
                let Ok(reading) = SensorReading::read_from_bytes(body) else { return };
                let missing = self.reading.see(reading.sequence, Tick(reading.tick));
                self.numbered(Topic::Sensor, missing);
            }
            Some(Topic::Keyframe) => {
                let Ok((part, _)) = Keyframe::read_from_prefix(body) else { return };
                let missing = self.keyframe.see(part.sequence, Tick(part.tick));
                self.numbered(Topic::Keyframe, missing);
            }
            Some(Topic::DrrFrame) => {
                let Ok(frame) = Frame::read_from_bytes(body) else { return };
                let missing = self.frame.see(frame.sequence, Tick(frame.tick));
                self.numbered(Topic::DrrFrame, missing);
            }
            _ => {}
        }
    }

    /// Returns what is missing. `counts` and the end marker cover messages after the last one and unnumbered
    /// topics.
    pub fn gap(
        &self,
        removals: Removals,
        counts: &BTreeMap<String, TopicCount>,
        marker: Option<&EndMarker>,
    ) -> Option<Gap> {
        let mut lost: BTreeMap<String, u64> =
            self.lost.iter().map(|(topic, n)| ((*topic).to_owned(), *n)).collect();
        if removals == Removals::Read && self.owed.is_some() {
            *lost.entry(Topic::Removed.name().to_owned()).or_default() += 1;
        }
        let mut at_least = |topic: &String, n: u64| {
            if n > 0 {
                let entry = lost.entry(topic.clone()).or_default();
                *entry = n.max(*entry);
            }
        };
        counts.iter().for_each(|(topic, count)| at_least(topic, count.missing));
        if let Some(marker) = marker {
            for topic in marker.lost.keys().chain(marker.damaged.keys()) {
                let of = |counts: &BTreeMap<String, u64>| counts.get(topic).copied().unwrap_or(0);
                at_least(topic, of(&marker.lost).saturating_add(of(&marker.damaged)));
            }
        }
        let mut stretches = self.stretches.clone();
        stretches.sort_by_key(|stretch| stretch.first_tick);
        (!lost.is_empty()).then_some(Gap { stretches, more: self.more, lost })
    }

    /// Checks a message of a topic that has exactly one message per tick.
    fn ticks(&mut self, topic: Topic, expected: Tick, found: Tick) {
        let place = TickPrecision::Exact;
        let missing = match found.cmp(&expected) {
            Ordering::Equal => return,
            Ordering::Greater => Missing {
                first_tick: expected,
                last_tick: found.saturating_sub(1),
                count: found.since(expected),
                place,
            },
            // The number went backwards.
            Ordering::Less => Missing { first_tick: found, last_tick: found, count: 1, place },
        };
        self.note(topic, missing);
    }

    fn numbered(&mut self, topic: Topic, missing: Option<Missing>) {
        if let Some(missing) = missing {
            self.note(topic, missing);
        }
    }

    /// Records a loss.
    fn note(&mut self, topic: Topic, missing: Missing) {
        let topic = topic.name();
        let Missing { first_tick: first, last_tick: last, count, place } = missing;
        let total = self.lost.entry(topic).or_default();
        *total = total.saturating_add(count);
        let touches = |s: &&mut Stretch| {
            first <= s.last_tick.saturating_add(1) && s.first_tick <= last.saturating_add(1)
        };
        if let Some(stretch) = self.stretches.iter_mut().rev().find(touches) {
            if place == TickPrecision::Exact {
                stretch.first_tick = stretch.first_tick.min(first);
                stretch.last_tick = stretch.last_tick.max(last);
            }
            let entry = stretch.messages.entry(topic).or_default();
            *entry = entry.saturating_add(count);
        } else if self.stretches.len() < MAX_REPORTED {
            let messages = BTreeMap::from([(topic, count)]);
            self.stretches.push(Stretch { first_tick: first, last_tick: last, messages });
        } else {
            self.more += 1;
        }
    }
}
