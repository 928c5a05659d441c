//! One client's send queue. Bounded, so that a slow or stalled client costs no more than that.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

/// Most bytes of stream messages queued for one client: about half a second of states at 1 kHz. The oldest are dropped and counted.
pub const STREAM_BYTES: usize = 4 << 20;

/// A message's payload, shared among clients.
pub type Payload = Arc<[u8]>;

/// A message queued for a client.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Outgoing {
    /// The client's number for the subscription.
    pub subscription: u32,
    /// Simulated time, ns.
    pub time_ns: u64,
    /// Payload.
    pub payload: Payload,
}

/// The queue of one client.
#[derive(Debug, Default)]
pub struct Queue {
    stream: VecDeque<Outgoing>,
    stream_bytes: usize,
    newest: BTreeMap<(u32, u32), (u64, Payload)>,
    /// Slot sent last; the others take their turn first.
    last_slot: (u32, u32),
    dropped: u64,
}

impl Queue {
    /// Queues a message of a stream, where every message counts.
    pub fn push_stream(&mut self, message: Outgoing) {
        self.stream_bytes += message.payload.len();
        self.stream.push_back(message);
        while self.stream_bytes > STREAM_BYTES
            && self.stream.len() > 1
            && let Some(oldest) = self.stream.pop_front()
        {
            self.stream_bytes -= oldest.payload.len();
            self.dropped += 1;
        }
    }

    /// Queues a message of which only the newest per slot counts.
    pub fn push_newest(&mut self, message: Outgoing, slot: u32) {
        self.newest.insert((message.subscription, slot), (message.time_ns, message.payload));
    }

    /// Takes the next messages: stream messages up to a number of bytes, then one of the others.
    pub fn take(&mut self, bytes: usize) -> Vec<Outgoing> {
        let mut taken = Vec::new();
        let mut count = 0;
        while count < bytes
            && let Some(message) = self.stream.pop_front()
        {
            count += message.payload.len();
            self.stream_bytes -= message.payload.len();
            taken.push(message);
        }
        let after = (std::ops::Bound::Excluded(self.last_slot), std::ops::Bound::Unbounded);
        let next =
            self.newest.range(after).next().or_else(|| self.newest.iter().next()).map(|(slot, _)| *slot);
        if let Some(slot) = next
            && let Some((time_ns, payload)) = self.newest.remove(&slot)
        {
            self.last_slot = slot;
            taken.push(Outgoing { subscription: slot.0, time_ns, payload });
        }
        taken
    }

    /// Drops everything queued for a subscription.
    pub fn forget(&mut self, subscription: u32) {
        self.stream.retain(|message| message.subscription != subscription);
        self.stream_bytes = self.stream.iter().map(|message| message.payload.len()).sum();
        self.newest.retain(|(of, _), _| *of != subscription);
    }

    /// Stream messages dropped since the last call.
    pub fn take_dropped(&mut self) -> u64 {
        std::mem::take(&mut self.dropped)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(subscription: u32, byte: u8, length: usize) -> Outgoing {
        Outgoing { subscription, time_ns: 0, payload: vec![byte; length].into() }
    }

    #[test]
    fn a_client_that_never_reads_costs_a_bounded_queue_and_is_told_what_it_lost() {
        let mut queue = Queue::default();
        let length = STREAM_BYTES / 8;
        (0..20).for_each(|i| queue.push_stream(message(1, i, length)));
        (0..20).for_each(|i| queue.push_newest(message(2, i, length), 7));
        assert_eq!(queue.take_dropped(), 12);
        assert_eq!(queue.take_dropped(), 0);
        let taken = queue.take(usize::MAX);
        let bytes: Vec<u8> = taken.iter().map(|message| message.payload[0]).collect();
        assert_eq!(
            bytes,
            [12, 13, 14, 15, 16, 17, 18, 19, 19],
            "the newest eight, then the newest of the slot"
        );
        assert!(queue.take(usize::MAX).is_empty());
    }

    #[test]
    fn slots_take_turns() {
        let mut queue = Queue::default();
        for _ in 0..2 {
            (0..3).for_each(|slot| queue.push_newest(message(1, slot as u8, 1), slot));
        }
        queue.push_newest(message(1, 9, 1), 0);
        let mut order = Vec::new();
        for _ in 0..3 {
            order.push(queue.take(0)[0].payload[0]);
            queue.push_newest(message(1, 9, 1), 0);
        }
        assert_eq!(order, [9, 1, 2]);
        queue.forget(1);
        assert!(queue.take(1).is_empty());
    }
}
