//! Delivery to a viewer's clients: the messages kept for late subscribers, those that a slow client misses,
//! and the reports of missed messages.
//!
//! **Boundary:** as in the rest of this crate, decisions only; the viewer's process takes the session's
//! messages, owns sockets, locks and clock, and sends what [`Client::take`] returns.
//!
//! **Invariants**, tested against every schedule of `hub_schedules`: each client's queue is bounded; each
//! message of a stream is delivered once and in order, or counted and reported as dropped; a client that
//! keeps reading gets the newest message of each of its channels; no channel starves another.
//!
//! ```
//! use delivery::viewer::{Client, RetainedMessages, Limits, Policy, ChannelMessage};
//!
//! let mut kept = RetainedMessages::default();
//! let mut client = Client::new(Limits { stream_bytes: 100 }, 0);
//! client.subscribe(7, 1, Policy::Stream, &kept).unwrap();
//! for byte in 0..5 {
//!     let message = ChannelMessage { channel: 1, slot: 0, time_ns: 0, payload: vec![byte; 40].into() };
//!     kept.keep(&message);
//!     client.offer(&message);
//! }
//! // It has not read: the oldest three are gone, and half a second later it is told.
//! let bytes: Vec<u8> = client.take(1000).iter().map(|message| message.payload[0]).collect();
//! assert_eq!(bytes, [3, 4]);
//! assert_eq!(client.drops_to_tell(600_000_000), Some(3));
//! ```

mod client;
mod kept;
mod queue;

pub use client::{Client, MAX_MESSAGES_PER_S, MAX_SUBSCRIPTIONS, SubscribeRefusal};
pub use kept::{Decimation, RetainedMessages, SubscribedChannels};
pub use queue::OutgoingMessage;

use std::sync::Arc;

/// A message's payload, shared among clients.
pub type Payload = Arc<[u8]>;

/// Which messages a slow client misses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Policy {
    /// The oldest messages of a bounded queue; never the newest.
    Stream,
    /// All except the newest message.
    Newest,
}

/// A message for the clients that subscribe to its channel.
#[derive(Debug, Clone)]
pub struct ChannelMessage {
    /// Number of the channel.
    pub channel: u32,
    /// The part of the channel that it updates: a surface has a slot for each block, most channels have one
    /// slot.
    pub slot: u32,
    /// Simulated time, ns.
    pub time_ns: u64,
    /// Payload.
    pub payload: Payload,
}

/// Limits for one client.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Maximum payload bytes of queued stream messages. The oldest are dropped and counted, except for the
    /// newest of each subscription.
    pub stream_bytes: usize,
}

impl Default for Limits {
    /// Holds about half a second of states at 1 kHz.
    fn default() -> Limits {
        Limits { stream_bytes: 4 << 20 }
    }
}
