//! The queue of messages to be sent to a peer.

use std::collections::VecDeque;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use openigtlink::{Body, Message};

/// Maximum number of messages with different names in the queue; the oldest is sent first.
const MOST_WAITING: usize = 256;

/// A queue that holds the newest message of each device and type, so that a slow peer gets fewer messages,
/// but no outdated ones. Answers to requests (STATUS) are never replaced: each is sent.
#[derive(Debug, Default)]
pub(crate) struct Outbox {
    state: Mutex<Waiting>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct Waiting {
    messages: VecDeque<Message>,
    replaced: u64,
    closed: Option<Instant>,
}

impl Outbox {
    /// Queues a message, replacing an older one of its name and type.
    pub(crate) fn put(&self, message: Message) {
        let mut waiting = self.lock();
        let same = |other: &Message| {
            !matches!(message.body, Body::Status(_))
                && other.device == message.device
                && core::mem::discriminant(&other.body) == core::mem::discriminant(&message.body)
        };
        match waiting.messages.iter().position(same) {
            Some(index) => {
                waiting.messages[index] = message;
                waiting.replaced += 1;
            }
            None => {
                if waiting.messages.len() == MOST_WAITING {
                    waiting.messages.pop_front();
                    waiting.replaced += 1;
                }
                waiting.messages.push_back(message);
            }
        }
        drop(waiting);
        self.changed.notify_one();
    }

    /// Waits for the next message and returns it. Returns `None` once the outbox is closed and empty, or if
    /// no message was queued within the limit.
    pub(crate) fn take(&self, limit: Duration) -> Option<Message> {
        let idle = |waiting: &mut Waiting| waiting.messages.is_empty() && waiting.closed.is_none();
        let waited = self.changed.wait_timeout_while(self.lock(), limit, idle);
        let (mut waiting, _) = waited.unwrap_or_else(PoisonError::into_inner);
        waiting.messages.pop_front()
    }

    /// Closes the queue: queued messages are still sent, new ones are rejected.
    pub(crate) fn close(&self) {
        self.lock().closed.get_or_insert_with(Instant::now);
        self.changed.notify_all();
    }

    pub(crate) fn is_closed(&self) -> bool {
        self.closed().is_some()
    }

    /// When it was closed.
    pub(crate) fn closed(&self) -> Option<Instant> {
        self.lock().closed
    }

    /// Number of messages replaced by a newer one before they were sent.
    pub(crate) fn replaced(&self) -> u64 {
        self.lock().replaced
    }

    fn lock(&self) -> MutexGuard<'_, Waiting> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slow_peer_gets_the_newest_of_each_name_and_the_rest_is_counted() {
        let outbox = Outbox::default();
        let text = |device: &str, text: &str| Message::new(device, Body::Text(text.into())).unwrap();
        for n in 0..1000 {
            outbox.put(text("A", &n.to_string()));
            outbox.put(text("B", &n.to_string()));
        }
        assert_eq!(outbox.take(Duration::ZERO), Some(text("A", "999")));
        assert_eq!(outbox.take(Duration::ZERO), Some(text("B", "999")));
        assert_eq!(outbox.take(Duration::ZERO), None);
        assert_eq!(outbox.replaced(), 2 * 999);
    }

    #[test]
    fn names_without_end_do_not_fill_the_memory() {
        let outbox = Outbox::default();
        (0..10_000)
            .for_each(|n| outbox.put(Message::new(&n.to_string(), Body::Text(String::new())).unwrap()));
        assert_eq!(outbox.lock().messages.len(), MOST_WAITING);
        assert_eq!(outbox.replaced(), 10_000 - MOST_WAITING as u64);
    }
}
