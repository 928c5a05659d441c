//! The messages kept of each channel for clients that subscribe later, and those passed on without
//! subscribers.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::{ChannelMessage, Payload};

/// The newest message of each channel and slot.
#[derive(Debug, Default)]
pub struct RetainedMessages(BTreeMap<(u32, u32), (u64, Payload)>);

/// One kept message.
#[derive(Debug, Clone, Copy)]
pub(super) struct KeptMessage<'a> {
    pub slot: u32,
    pub time_ns: u64,
    pub payload: &'a Payload,
}

impl RetainedMessages {
    /// Keeps a message, replacing the previous one in its slot.
    pub fn keep(&mut self, message: &ChannelMessage) {
        let kept = (message.time_ns, Arc::clone(&message.payload));
        self.0.insert((message.channel, message.slot), kept);
    }

    /// Keeps the last `count` messages of a channel whose slots count up from 0, one for each message.
    pub fn keep_last(&mut self, message: &ChannelMessage, count: u32) {
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

/// The channels with at least one subscriber: bit i represents the channels i modulo 64.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct SubscribedChannels(pub u64);

impl SubscribedChannels {
    /// Collects the channels of all clients' subscriptions.
    pub fn of(channels: impl Iterator<Item = u32>) -> SubscribedChannels {
        SubscribedChannels(channels.fold(0, |bits, channel| bits | 1 << (channel % 64)))
    }

    /// Returns whether a channel has subscribers. Can be true without any.
    pub fn has(self, channel: u32) -> bool {
        self.0 & (1 << (channel % 64)) != 0
    }
}

/// Decides which messages of a queue are passed on: all if there are subscribers, otherwise only the newest,
/// which is kept for later ones.
#[derive(Debug)]
pub struct Decimation<M> {
    is_wanted: bool,
    newest: Option<M>,
}

impl<M> Decimation<M> {
    /// Starts one pass over the queue of a channel.
    pub fn new(wanted: SubscribedChannels, channel: u32) -> Decimation<M> {
        Decimation { is_wanted: wanted.has(channel), newest: None }
    }

    /// Handles the next message of the queue; returns it if it is passed on now.
    pub fn next(&mut self, message: M) -> Option<M> {
        if self.is_wanted {
            return Some(message);
        }
        self.newest = Some(message);
        None
    }

    /// Ends the pass; returns the message that is passed on last, if any.
    pub fn last(self) -> Option<M> {
        self.newest
    }
}
