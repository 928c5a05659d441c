//! Messages that never came, as the numbers of those that did show.

use std::collections::BTreeMap;

/// Last number of each sender on each topic, and what was missed.
#[derive(Debug, Default)]
pub(crate) struct Gaps {
    last: BTreeMap<(&'static str, u32), u64>,
    lost: BTreeMap<String, u64>,
}

impl Gaps {
    /// A message has come; a sender's numbers begin at 1 and rise by one. One that begins anew lost nothing.
    pub fn see(&mut self, topic: &'static str, sender: u32, number: u64) {
        let last = self.last.insert((topic, sender), number).unwrap_or(0);
        let missed = number.saturating_sub(last.saturating_add(1));
        if missed > 0 {
            *self.lost.entry(topic.to_owned()).or_default() += missed;
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
}
