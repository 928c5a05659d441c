//! What the clients of a viewer get: what is kept for those that subscribe later, what a slow one misses, and
//! what it is told of that.
//!
//! **Boundary:** as in the rest of this crate, it only decides; the viewer's process takes the session's
//! messages, owns sockets, locks and clock, and sends what [`Client::take`] returns.
//!
//! **Invariants**, held against every schedule of `hub_simulator`: what waits for one client is bounded; each
//! message of a stream is delivered once and in order, or counted as dropped and told as such; a client that
//! reads on gets the newest message of each of its channels; no channel waits for ever behind another.
//!
//! ```
//! use delivery::viewer::{Client, Kept, Limits, Policy, Published};
//!
//! let mut kept = Kept::default();
//! let mut client = Client::new(Limits { stream_bytes: 100 }, 0);
//! client.subscribe(7, 1, Policy::Stream, &kept).unwrap();
//! for byte in 0..5 {
//!     let message = Published { channel: 1, slot: 0, time_ns: 0, policy: Policy::Stream, payload: vec![byte; 40].into() };
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
pub use kept::{Decimation, Kept, Wanted};
pub use queue::Outgoing;

use std::sync::Arc;

/// A message's payload, shared among clients.
pub type Payload = Arc<[u8]>;

/// What a slow client misses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Policy {
    /// The oldest messages of a bounded queue; never the newest.
    Stream,
    /// All but the newest message.
    Newest,
}

/// A message for the clients that subscribe to its channel.
#[derive(Debug, Clone)]
pub struct Published {
    /// Number of the channel.
    pub channel: u32,
    /// Which of the channel's things it shows: a surface has a slot for each block, most channels have one
    /// slot.
    pub slot: u32,
    /// Simulated time, ns.
    pub time_ns: u64,
    /// What a slow client misses of the channel.
    pub policy: Policy,
    /// Payload.
    pub payload: Payload,
}

/// What one client may cost.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Most payload bytes of stream messages that wait. The oldest are dropped and counted, but for the
    /// newest of each subscription.
    pub stream_bytes: usize,
}

impl Default for Limits {
    /// About half a second of states at 1 kHz.
    fn default() -> Limits {
        Limits { stream_bytes: 4 << 20 }
    }
}
