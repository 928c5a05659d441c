//! One client: its subscriptions, its queued messages, its reports of drops, and its rate limit.

use std::collections::BTreeMap;
use std::sync::Arc;

use thiserror::Error;

use super::queue::{OutgoingMessage, Queue};
use super::{ChannelMessage, Limits, Policy, RetainedMessages};

/// Maximum number of subscriptions of one client.
pub const MAX_SUBSCRIPTIONS: usize = 256;
/// Maximum number of client messages per second; keyboard and gamepad send 60.
pub const MAX_MESSAGES_PER_S: u32 = 1000;

const S: u64 = 1_000_000_000;
/// Minimum time between two reports of dropped messages, ns.
const TELL_PERIOD_NS: u64 = S / 2;

/// Why a client's subscription is refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum SubscribeRefusal {
    /// The client has the maximum number of subscriptions.
    #[error(
        "subscription {subscription}: the limit of {MAX_SUBSCRIPTIONS} subscriptions per client is reached"
    )]
    TooMany {
        /// The client's number for it.
        subscription: u32,
    },
    /// The client already has a subscription of this number.
    #[error("duplicate subscription {subscription}; unsubscribe it first")]
    Taken {
        /// The client's number for it.
        subscription: u32,
    },
    /// The client has no subscription of this number.
    #[error("unknown subscription {subscription}")]
    Unknown {
        /// The client's number for it.
        subscription: u32,
    },
}

/// What a client subscribes to.
#[derive(Debug, Clone, Copy)]
struct ChannelSubscription {
    channel: u32,
    policy: Policy,
}

/// One client.
#[derive(Debug)]
pub struct Client {
    queue: Queue,
    subscriptions: BTreeMap<u32, ChannelSubscription>,
    told_ns: u64,
    /// Start of the second in which its messages are counted.
    counted_from_ns: u64,
    messages: u32,
}

impl Client {
    /// Creates a client that has just connected.
    pub fn new(limits: Limits, now_ns: u64) -> Client {
        Client {
            queue: Queue::new(limits),
            subscriptions: BTreeMap::new(),
            told_ns: now_ns,
            counted_from_ns: now_ns,
            messages: 0,
        }
    }

    /// Queues a message for each subscription to its channel; returns their number.
    pub fn offer(&mut self, message: &ChannelMessage) -> usize {
        let wanting = self.subscriptions.iter().filter(|(_, wanted)| wanted.channel == message.channel);
        let mut count = 0;
        for (subscription, wanted) in wanting {
            let payload = Arc::clone(&message.payload);
            let outgoing = OutgoingMessage { subscription: *subscription, time_ns: message.time_ns, payload };
            self.queue.push(outgoing, wanted.policy, message.slot);
            count += 1;
        }
        count
    }

    /// Adds a subscription, and queues what is kept of the channel. Of a stream, a client may want only the
    /// newest messages.
    ///
    /// # Errors
    /// [`SubscribeRefusal::TooMany`], [`SubscribeRefusal::Taken`].
    pub fn subscribe(
        &mut self,
        subscription: u32,
        channel: u32,
        policy: Policy,
        kept: &RetainedMessages,
    ) -> Result<(), SubscribeRefusal> {
        if self.subscriptions.len() >= MAX_SUBSCRIPTIONS {
            return Err(SubscribeRefusal::TooMany { subscription });
        }
        if self.subscriptions.contains_key(&subscription) {
            return Err(SubscribeRefusal::Taken { subscription });
        }
        self.subscriptions.insert(subscription, ChannelSubscription { channel, policy });
        for message in kept.of(channel) {
            let payload = Arc::clone(message.payload);
            let outgoing = OutgoingMessage { subscription, time_ns: message.time_ns, payload };
            self.queue.push(outgoing, policy, message.slot);
        }
        Ok(())
    }

    /// Ends a subscription, and drops its queued messages.
    ///
    /// # Errors
    /// [`SubscribeRefusal::Unknown`].
    pub fn unsubscribe(&mut self, subscription: u32) -> Result<(), SubscribeRefusal> {
        let ended = self.subscriptions.remove(&subscription);
        ended.ok_or(SubscribeRefusal::Unknown { subscription })?;
        self.queue.forget(subscription);
        Ok(())
    }

    /// Returns the channels that it subscribes to.
    pub fn channels(&self) -> impl Iterator<Item = u32> {
        self.subscriptions.values().map(|wanted| wanted.channel)
    }

    /// Takes the next messages: of streams up to a number of bytes, then one of the others. Empty only if
    /// nothing waits.
    pub fn take(&mut self, bytes: usize) -> Vec<OutgoingMessage> {
        self.queue.take(bytes)
    }

    /// Returns the number of dropped messages if it is time to report it to the client: at most twice a
    /// second.
    pub fn drops_to_tell(&mut self, now_ns: u64) -> Option<u64> {
        if now_ns.saturating_sub(self.told_ns) <= TELL_PERIOD_NS || !self.queue.has_dropped() {
            return None;
        }
        self.told_ns = now_ns;
        self.last_drops_to_tell()
    }

    /// Returns the number of dropped messages at the end, when there is no later report.
    pub fn last_drops_to_tell(&mut self) -> Option<u64> {
        Some(self.queue.take_dropped()).filter(|dropped| *dropped > 0)
    }

    /// Counts a message of the client against its rate limit; returns false if the limit is exceeded.
    pub fn may_send(&mut self, now_ns: u64) -> bool {
        if now_ns.saturating_sub(self.counted_from_ns) > S {
            (self.counted_from_ns, self.messages) = (now_ns, 0);
        }
        self.messages += 1;
        self.messages <= MAX_MESSAGES_PER_S
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn client() -> Client {
        Client::new(Limits { stream_bytes: 10 }, 0)
    }

    fn state(byte: u8) -> ChannelMessage {
        ChannelMessage { channel: 1, slot: 0, time_ns: 0, payload: vec![byte; 10].into() }
    }

    /// Regression: drops of the last half second before the end were never reported.
    #[test]
    fn what_is_dropped_is_told_twice_a_second_and_at_the_end() {
        let mut client = client();
        client.subscribe(1, 1, Policy::Stream, &RetainedMessages::default()).unwrap();
        (0..3).for_each(|byte| assert_eq!(client.offer(&state(byte)), 1));
        assert_eq!(client.drops_to_tell(S / 2), None);
        assert_eq!(client.drops_to_tell(S), Some(2));
        client.offer(&state(3));
        assert_eq!(client.drops_to_tell(S + 1), None);
        assert_eq!((client.last_drops_to_tell(), client.last_drops_to_tell()), (Some(1), None));
    }

    #[test]
    fn a_subscription_is_refused_by_name_and_changes_nothing() {
        let (mut client, kept) = (client(), RetainedMessages::default());
        client.subscribe(1, 1, Policy::Stream, &kept).unwrap();
        let taken = client.subscribe(1, 2, Policy::Stream, &kept).unwrap_err();
        assert_eq!(taken.to_string(), "duplicate subscription 1; unsubscribe it first");
        assert_eq!(client.unsubscribe(5), Err(SubscribeRefusal::Unknown { subscription: 5 }));
        assert_eq!(client.channels().collect::<Vec<_>>(), [1]);
        let more = 2..=MAX_SUBSCRIPTIONS as u32;
        more.for_each(|number| client.subscribe(number, 1, Policy::Stream, &kept).unwrap());
        let refused = client.subscribe(9999, 1, Policy::Stream, &kept).unwrap_err();
        assert_eq!(refused, SubscribeRefusal::TooMany { subscription: 9999 });
    }

    #[test]
    fn a_client_that_wants_the_newest_of_a_stream_loses_the_others_unreported() {
        let mut client = client();
        client.subscribe(1, 1, Policy::Newest, &RetainedMessages::default()).unwrap();
        (0..3).for_each(|byte| assert_eq!(client.offer(&state(byte)), 1));
        let taken = client.take(usize::MAX);
        assert_eq!(taken.iter().map(|message| message.payload[0]).collect::<Vec<_>>(), [2]);
        assert_eq!(client.drops_to_tell(S), None);
    }

    #[test]
    fn a_client_may_send_so_many_messages_a_second() {
        let mut client = client();
        let sent = (0..2000).filter(|_| client.may_send(S)).count();
        assert_eq!(sent, MAX_MESSAGES_PER_S as usize);
        assert!(client.may_send(2 * S + 1));
    }
}
