//! Messages that never arrived, according to the numbers of those that did.

use std::collections::BTreeMap;

/// Most senders that are followed: more than a session has. A message names its sender, so a client could invent any number of them.
const MAX_SENDERS: usize = 64;
/// Longest gap that is believed (49 days at 1 kHz); a longer jump is a sender that starts anew.
const LONGEST_GAP: u64 = u32::MAX as u64;

/// Last number of each sender on each topic, and what was missed.
#[derive(Debug, Default)]
pub struct Gaps {
    last: BTreeMap<(&'static str, u32), u64>,
    lost: BTreeMap<String, u64>,
}

impl Gaps {
    /// Takes in a message. The numbers of a sender begin at 1 and rise by one; a sender that starts anew has lost nothing.
    pub fn see(&mut self, topic: &'static str, sender: u32, number: u64) {
        if self.last.len() >= MAX_SENDERS && !self.last.contains_key(&(topic, sender)) {
            return;
        }
        let last = self.last.insert((topic, sender), number).unwrap_or(0);
        let missed = number.saturating_sub(last.saturating_add(1));
        if (1..=LONGEST_GAP).contains(&missed) {
            let lost = self.lost.entry(topic.to_owned()).or_default();
            *lost = lost.saturating_add(missed);
        }
    }

    /// Messages missed, by topic.
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
            gaps.see("/event", sender, number);
        }
        gaps.see("/timing/tick", 0, 1);
        assert_eq!(gaps.lost(), &BTreeMap::from([("/event".to_owned(), 2 + 2)]));
    }

    /// Numbers and names of senders are what a client wrote.
    #[test]
    fn what_a_client_invents_neither_falsifies_the_count_nor_fills_the_memory() {
        let mut gaps = Gaps::default();
        gaps.see("/event", 0, 1);
        for sender in 0..100_000 {
            gaps.see("/event", sender, u64::MAX);
            gaps.see("/event", sender, u64::MAX - 1);
        }
        assert!(gaps.lost().is_empty(), "{:?}", gaps.lost());
        assert_eq!(gaps.last.len(), MAX_SENDERS);
    }
}
