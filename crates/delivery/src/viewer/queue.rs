//! One client's send queue, bounded so that a slow or stalled client costs no more than that.

use std::collections::{BTreeMap, VecDeque};

use super::{Limits, Payload, Policy};

/// A message queued for a client.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OutgoingMessage {
    /// The client's number for the subscription.
    pub subscription: u32,
    /// Simulated time, ns.
    pub time_ns: u64,
    /// Payload.
    pub payload: Payload,
}

/// The queue of one client.
#[derive(Debug)]
pub(super) struct Queue {
    limits: Limits,
    stream: VecDeque<OutgoingMessage>,
    stream_bytes: usize,
    /// Number of queued stream messages, by subscription.
    waiting: BTreeMap<u32, usize>,
    newest: BTreeMap<(u32, u32), (u64, Payload)>,
    /// Slot sent last; the others are sent before it.
    last_slot: (u32, u32),
    dropped: u64,
}

impl Queue {
    /// Creates an empty queue.
    pub(super) fn new(limits: Limits) -> Queue {
        Queue {
            limits,
            stream: VecDeque::new(),
            stream_bytes: 0,
            waiting: BTreeMap::new(),
            newest: BTreeMap::new(),
            last_slot: (0, 0),
            dropped: 0,
        }
    }

    /// Queues a message; `slot` distinguishes messages of which only the newest counts.
    pub(super) fn push(&mut self, message: OutgoingMessage, policy: Policy, slot: u32) {
        match policy {
            Policy::Stream => self.push_stream(message),
            Policy::Newest => {
                self.newest.insert((message.subscription, slot), (message.time_ns, message.payload));
            }
        }
    }

    fn push_stream(&mut self, message: OutgoingMessage) {
        self.stream_bytes += message.payload.len();
        *self.waiting.entry(message.subscription).or_default() += 1;
        self.stream.push_back(message);
        // A subscription's newest message stays: it may be the last one, as before a pause or the end of the
        // run.
        while self.stream_bytes > self.limits.stream_bytes
            && let Some(index) = self.stream.iter().position(|message| self.has_newer(message))
            && let Some(oldest) = self.stream.remove(index)
        {
            self.leaves(&oldest);
            self.dropped += 1;
        }
    }

    fn has_newer(&self, message: &OutgoingMessage) -> bool {
        self.waiting.get(&message.subscription).is_some_and(|count| *count > 1)
    }

    /// Accounts for a stream message that leaves the queue.
    fn leaves(&mut self, message: &OutgoingMessage) {
        self.stream_bytes -= message.payload.len();
        if let Some(count) = self.waiting.get_mut(&message.subscription) {
            *count -= 1;
        }
    }

    /// Takes the next messages: stream messages up to a number of bytes, then one of the others.
    pub(super) fn take(&mut self, bytes: usize) -> Vec<OutgoingMessage> {
        let mut taken = Vec::new();
        let mut count = 0;
        while count < bytes
            && let Some(message) = self.stream.pop_front()
        {
            count += message.payload.len();
            self.leaves(&message);
            taken.push(message);
        }
        let after = (std::ops::Bound::Excluded(self.last_slot), std::ops::Bound::Unbounded);
        let next =
            self.newest.range(after).next().or_else(|| self.newest.iter().next()).map(|(slot, _)| *slot);
        if let Some(slot) = next
            && let Some((time_ns, payload)) = self.newest.remove(&slot)
        {
            self.last_slot = slot;
            taken.push(OutgoingMessage { subscription: slot.0, time_ns, payload });
        }
        taken
    }

    /// Drops everything queued for a subscription.
    pub(super) fn forget(&mut self, subscription: u32) {
        self.stream.retain(|message| message.subscription != subscription);
        self.stream_bytes = self.stream.iter().map(|message| message.payload.len()).sum();
        self.waiting.remove(&subscription);
        self.newest.retain(|(of, _), _| *of != subscription);
    }

    /// Returns whether stream messages have been dropped since the last [`Queue::take_dropped`].
    pub(super) fn has_dropped(&self) -> bool {
        self.dropped > 0
    }

    /// Returns the number of stream messages dropped since the last call.
    pub(super) fn take_dropped(&mut self) -> u64 {
        std::mem::take(&mut self.dropped)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(subscription: u32, byte: u8, length: usize) -> OutgoingMessage {
        OutgoingMessage { subscription, time_ns: 0, payload: vec![byte; length].into() }
    }

    #[test]
    fn a_client_that_never_reads_costs_a_bounded_queue_and_is_told_what_it_lost() {
        let mut queue = Queue::new(Limits { stream_bytes: 8000 });
        let length = 1000;
        (0..20).for_each(|i| queue.push(message(1, i, length), Policy::Stream, 0));
        (0..20).for_each(|i| queue.push(message(2, i, length), Policy::Newest, 7));
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

    /// Regression: a stalled client never learned that the run was paused, because states, a thousand a
    /// second, evicted the message that announced it.
    #[test]
    fn a_busy_stream_does_not_push_out_the_newest_message_of_a_quiet_one() {
        let mut queue = Queue::new(Limits { stream_bytes: 100 });
        for byte in 0..20 {
            if byte < 2 {
                queue.push(message(2, 100 + byte, 10), Policy::Stream, 0);
            }
            queue.push(message(1, byte, 10), Policy::Stream, 0);
        }
        let bytes: Vec<u8> = queue.take(usize::MAX).iter().map(|message| message.payload[0]).collect();
        assert_eq!(bytes, [101, 11, 12, 13, 14, 15, 16, 17, 18, 19]);
        assert_eq!(queue.take_dropped(), 12);
    }

    #[test]
    fn slots_take_turns() {
        let mut queue = Queue::new(Limits::default());
        for _ in 0..2 {
            (0..3).for_each(|slot| queue.push(message(1, slot as u8, 1), Policy::Newest, slot));
        }
        queue.push(message(1, 9, 1), Policy::Newest, 0);
        let mut order = Vec::new();
        for _ in 0..3 {
            order.push(queue.take(0)[0].payload[0]);
            queue.push(message(1, 9, 1), Policy::Newest, 0);
        }
        assert_eq!(order, [9, 1, 2]);
        queue.forget(1);
        assert!(queue.take(1).is_empty());
    }
}
