//! Rules for a viewer's client: which messages reach it and in which order, how many missed messages are
//! reported to it, and how much waits for it.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use delivery::viewer::{ChannelMessage, OutgoingMessage};

use crate::plan::MS;
use crate::viewer::{NOTICES, NOTICES_KEPT, STREAMS};

/// Least time between two reports of dropped messages.
const TELL_NS: u64 = 500 * MS;

/// A message due for delivery: its subscription, number and length.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Due {
    subscription: u32,
    number: u64,
    bytes: usize,
}

/// A model of one client, kept in parallel to [`delivery::viewer::Client`].
#[derive(Debug, Default)]
pub struct WatcherAccount {
    /// The first violated rule.
    pub failure: Option<String>,
    stream_bytes: usize,
    /// Messages kept for late subscribers: number and length by channel and slot.
    kept: BTreeMap<(u32, u32), (u64, usize)>,
    /// Channel by subscription.
    subscriptions: BTreeMap<u32, u32>,
    /// Waiting messages of streams, and their bytes.
    stream: VecDeque<Due>,
    waiting_bytes: usize,
    /// The message that is due by subscription and slot, with the number of messages of other slots sent
    /// while it waits.
    newest: BTreeMap<(u32, u32), (u64, usize)>,
    slots: BTreeSet<(u32, u32)>,
    /// Number of the last message delivered, by subscription and, where only the newest counts, slot.
    delivered: BTreeMap<(u32, u32), u64>,
    dropped: u64,
    told_ns: Option<u64>,
}

impl WatcherAccount {
    /// Creates the model of a client whose streams may queue this many bytes.
    pub fn new(stream_bytes: usize) -> WatcherAccount {
        WatcherAccount { stream_bytes, ..WatcherAccount::default() }
    }

    fn fail(&mut self, what: String) {
        self.failure.get_or_insert(what);
    }

    /// Returns whether it has a subscription of this number.
    pub fn has(&self, subscription: u32) -> bool {
        self.subscriptions.contains_key(&subscription)
    }

    /// Returns whether a message waits for it.
    pub fn has_waiting(&self) -> bool {
        !self.stream.is_empty() || !self.newest.is_empty()
    }

    /// Records that a message is published, and offered to the client if it is connected; `count` is the
    /// number of subscriptions that it was offered to.
    pub fn published(&mut self, message: &ChannelMessage, count: Option<usize>) {
        let (number, bytes) = (number_of(&message.payload), message.payload.len());
        self.kept.insert((message.channel, message.slot), (number, bytes));
        if message.channel == NOTICES && message.slot >= NOTICES_KEPT {
            self.kept.remove(&(NOTICES, message.slot - NOTICES_KEPT));
        }
        let Some(count) = count else { return };
        let wanting = self.subscriptions.iter().filter(|(_, channel)| **channel == message.channel);
        let wanting: Vec<u32> = wanting.map(|(subscription, _)| *subscription).collect();
        expect!(self, count == wanting.len(), format!("{count} subscriptions, not {}", wanting.len()));
        for subscription in wanting {
            self.due(Due { subscription, number, bytes }, message.channel, message.slot);
        }
    }

    fn due(&mut self, due: Due, channel: u32, slot: u32) {
        if !STREAMS.contains(&channel) {
            let key = (due.subscription, slot);
            self.slots.insert(key);
            self.newest.entry(key).or_default().0 = due.number;
            return;
        }
        self.stream.push_back(due);
        self.waiting_bytes += due.bytes;
        // The oldest are dropped first; the newest of each subscription stays.
        while self.waiting_bytes > self.stream_bytes
            && let Some(index) = self.oldest_replaced()
        {
            self.waiting_bytes -= self.stream.remove(index).map_or(0, |due| due.bytes);
            self.dropped += 1;
        }
        let most = self.stream_bytes + self.subscriptions.len() * due.bytes;
        let waiting = self.waiting_bytes;
        expect!(self, waiting <= most, format!("{waiting} bytes wait, at most {most}"));
    }

    fn oldest_replaced(&self) -> Option<usize> {
        let is_replaced = |(index, due): &(usize, &Due)| {
            self.stream.iter().skip(index + 1).any(|later| later.subscription == due.subscription)
        };
        self.stream.iter().enumerate().find(is_replaced).map(|(index, _)| index)
    }

    /// Records that the client has requested a subscription, which was accepted or not.
    pub fn subscribed(&mut self, subscription: u32, channel: u32, accepted: bool) {
        let free = !self.has(subscription);
        expect!(self, accepted == free, format!("subscription {subscription}: accepted is {accepted}"));
        if !free {
            return;
        }
        self.subscriptions.insert(subscription, channel);
        let kept: Vec<(u32, u64, usize)> = (self.kept.range((channel, 0)..=(channel, u32::MAX)))
            .map(|((_, slot), (number, bytes))| (*slot, *number, *bytes))
            .collect();
        for (slot, number, bytes) in kept {
            self.due(Due { subscription, number, bytes }, channel, slot);
        }
    }

    /// Records that the client has ended a subscription.
    pub fn unsubscribed(&mut self, subscription: u32, accepted: bool) {
        let known = self.subscriptions.remove(&subscription).is_some();
        expect!(self, accepted == known, format!("subscription {subscription}: ended is {accepted}"));
        self.stream.retain(|due| due.subscription != subscription);
        self.waiting_bytes = self.stream.iter().map(|due| due.bytes).sum();
        self.newest.retain(|(of, _), _| *of != subscription);
        self.delivered.retain(|(of, _), _| *of != subscription);
    }

    /// Records that the client is sent some messages: at most `batch_bytes` of streams and one of the others.
    pub fn delivered(&mut self, messages: &[OutgoingMessage], batch_bytes: usize) {
        let had_newest = !self.newest.is_empty();
        let (mut bytes, mut others) = (0, 0);
        for message in messages {
            let channel = self.subscriptions.get(&message.subscription).copied().unwrap_or(0);
            if STREAMS.contains(&channel) {
                expect!(self, bytes < batch_bytes && others == 0, "more than a batch".to_owned());
                bytes += message.payload.len();
                self.delivered_of_stream(message);
            } else {
                others += 1;
                self.delivered_newest(message);
            }
        }
        let (left, sent) = (self.stream.len(), usize::from(had_newest));
        expect!(self, left == 0 || bytes >= batch_bytes, format!("{left} messages are held back"));
        expect!(self, others == sent, format!("{others} messages of other channels, expected {sent}"));
    }

    fn delivered_of_stream(&mut self, message: &OutgoingMessage) {
        let due = self.stream.pop_front();
        self.waiting_bytes -= due.map_or(0, |due| due.bytes);
        let (subscription, number) = (message.subscription, number_of(&message.payload));
        let expected = due.map(|due| (due.subscription, due.number));
        expect!(self, Some((subscription, number)) == expected, {
            format!("message {number} of subscription {subscription}, expected {expected:?}")
        });
        self.in_order((subscription, 0), number);
    }

    fn delivered_newest(&mut self, message: &OutgoingMessage) {
        let (subscription, number) = (message.subscription, number_of(&message.payload));
        let matches =
            |((of, _), (due, _)): &(&(u32, u32), &(u64, usize))| *of == subscription && *due == number;
        let key = self.newest.iter().find(matches).map(|(key, _)| *key);
        let Some(key) = key else {
            return self.fail(format!("message {number} of subscription {subscription} is not the newest"));
        };
        self.newest.remove(&key);
        self.in_order(key, number);
        self.newest.values_mut().for_each(|(_, waited)| *waited += 1);
        let most = self.slots.len();
        let starved = self.newest.iter().find(|(_, (_, waited))| *waited > most).map(|(key, _)| *key);
        expect!(self, starved.is_none(), format!("{starved:?} is starved by others"));
    }

    fn in_order(&mut self, key: (u32, u32), number: u64) {
        let before = self.delivered.insert(key, number);
        expect!(self, before.is_none_or(|before| before < number), {
            format!("message {number} of {key:?} after {before:?}")
        });
    }

    /// Records that the client is sent the number of messages it missed; `now_ns` is `None` at the end.
    pub fn told(&mut self, dropped: u64, now_ns: Option<u64>) {
        let missed = std::mem::take(&mut self.dropped);
        expect!(self, dropped == missed, format!("reported {dropped} dropped messages, not {missed}"));
        if let Some(now_ns) = now_ns {
            let before_ns = self.told_ns.replace(now_ns);
            let is_early = before_ns.is_some_and(|before_ns| now_ns < before_ns + TELL_NS);
            expect!(self, !is_early, format!("drops reported at {now_ns} ns, and at {before_ns:?}"));
        }
    }

    /// Records that the client has read to the end of the run; `newest` holds each channel and the number of
    /// its newest message.
    pub fn ended(&mut self, newest: &[(u32, u64)]) {
        let (waits, untold) = (self.has_waiting(), self.dropped);
        expect!(self, !waits, "a message waits for a client that has read everything".to_owned());
        expect!(self, untold == 0, format!("{untold} dropped messages are never reported"));
        for (subscription, channel) in self.subscriptions.clone() {
            let expected = newest.iter().find(|(of, number)| *of == channel && *number > 0);
            let given = self.delivered.get(&(subscription, 0)).copied();
            expect!(self, expected.is_none_or(|(_, number)| given == Some(*number)), {
                format!("the last message of channel {channel} received is {given:?}, expected {expected:?}")
            });
        }
    }
}

/// Returns the number in a payload.
fn number_of(payload: &[u8]) -> u64 {
    payload.iter().take(8).rev().fold(0, |number, byte| number << 8 | u64::from(*byte))
}
