//! What stays of each channel for clients that subscribe later, and what is handed on while nobody does.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::{Payload, Published};

/// The newest message of each channel and slot.
#[derive(Debug, Default)]
pub struct Kept(BTreeMap<(u32, u32), (u64, Payload)>);

/// One message that was kept.
#[derive(Debug, Clone, Copy)]
pub(super) struct KeptMessage<'a> {
    pub slot: u32,
    pub time_ns: u64,
    pub payload: &'a Payload,
}

impl Kept {
    /// Keeps a message instead of the one before it in its slot.
    pub fn keep(&mut self, message: &Published) {
        let kept = (message.time_ns, Arc::clone(&message.payload));
        self.0.insert((message.channel, message.slot), kept);
    }

    /// Keeps the last `count` messages of a channel whose slots count on from 0, one for each message.
    pub fn keep_last(&mut self, message: &Published, count: u32) {
        self.keep(message);
        if let Some(old) = message.slot.checked_sub(count) {
            self.0.remove(&(message.channel, old));
        }
    }

    pub(super) fn of(&self, channel: u32) -> impl Iterator<Item = KeptMessage<'_>> {
        let kept = self.0.range((channel, 0)..=(channel, u32::MAX));
        kept.map(|((_, slot), (time_ns, payload))| KeptMessage { slot: *slot, time_ns: *time_ns, payload })
    }
}

/// The channels that somebody subscribes to: bit i stands for the channels i modulo 64.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Wanted(pub u64);

impl Wanted {
    /// Those of all clients' subscriptions.
    pub fn of(channels: impl Iterator<Item = u32>) -> Wanted {
        Wanted(channels.fold(0, |bits, channel| bits | 1 << (channel % 64)))
    }

    /// Whether anybody subscribes to a channel. May be true when nobody does.
    pub fn has(self, channel: u32) -> bool {
        self.0 & (1 << (channel % 64)) != 0
    }
}

/// Which of the messages that a look at a queue finds are handed on: all if somebody subscribes, otherwise
/// the newest, which is kept for those that subscribe later.
#[derive(Debug)]
pub struct Decimation<M> {
    is_wanted: bool,
    newest: Option<M>,
}

impl<M> Decimation<M> {
    /// For one look at the queue of a channel.
    pub fn new(wanted: Wanted, channel: u32) -> Decimation<M> {
        Decimation { is_wanted: wanted.has(channel), newest: None }
    }

    /// The next message of the queue; returns it if it is handed on now.
    pub fn next(&mut self, message: M) -> Option<M> {
        if self.is_wanted {
            return Some(message);
        }
        self.newest = Some(message);
        None
    }

    /// The queue is empty: the message that is handed on last, if any.
    pub fn last(self) -> Option<M> {
        self.newest
    }
}
