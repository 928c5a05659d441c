//! Counts messages that never arrived, from the sequence numbers of those that did.

use std::collections::BTreeMap;

use messages::services::EVENT;

use crate::topics::Topic;

/// Maximum number of senders tracked, more than a session has. Messages carry their sender's id, so a client
/// could invent any number of them.
const MAX_SENDERS: usize = 64;

const _: () = assert!(EVENT.max_publishers + Topic::ALL.len() < MAX_SENDERS);
/// Longest plausible gap (49 days at 1 kHz); a longer jump means that the sender has restarted.
const LONGEST_GAP: u64 = u32::MAX as u64;

/// Last sequence number of each sender on each topic, and the messages missed.
#[derive(Debug, Default)]
pub struct Gaps {
    last: BTreeMap<(Topic, u32), u64>,
    lost: BTreeMap<String, u64>,
}

impl Gaps {
    /// Checks a message's number. A sender's numbers start at 1 and increase by one; a sender that restarts
    /// has lost nothing.
    pub fn see(&mut self, topic: Topic, sender: u32, number: u64) {
        if self.last.len() >= MAX_SENDERS && !self.last.contains_key(&(topic, sender)) {
            return;
        }
        let last = self.last.insert((topic, sender), number).unwrap_or(0);
        let missed = number.saturating_sub(last.saturating_add(1));
        if (1..=LONGEST_GAP).contains(&missed) {
            let lost = self.lost.entry(topic.name().to_owned()).or_default();
            *lost = lost.saturating_add(missed);
        }
    }

    /// Number of missed messages by topic.
    pub fn lost(&self) -> &BTreeMap<String, u64> {
        &self.lost
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn jumps_are_counted_by_topic_and_a_new_beginning_is_none() {
        let mut gaps = Gaps::default();
        for (sender, number) in [(1, 1), (1, 2), (2, 3), (1, 5), (2, 4), (1, 1), (1, 2)] {
            gaps.see(Topic::Event, sender, number);
        }
        gaps.see(Topic::TickTiming, 0, 1);
        assert_eq!(gaps.lost(), &BTreeMap::from([("/event".to_owned(), 2 + 2)]));
    }

    /// A client chooses its own numbers and sender id.
    #[test]
    fn what_a_client_invents_neither_falsifies_the_count_nor_fills_the_memory() {
        let mut gaps = Gaps::default();
        gaps.see(Topic::Event, 0, 1);
        for sender in 0..100_000 {
            gaps.see(Topic::Event, sender, u64::MAX);
            gaps.see(Topic::Event, sender, u64::MAX - 1);
        }
        assert!(gaps.lost().is_empty(), "{:?}", gaps.lost());
        assert_eq!(gaps.last.len(), MAX_SENDERS);
    }
}
