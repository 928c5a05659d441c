//! Where the sources put their messages and the clients' connections take them. Nobody waits here: a source hands its
//! message over and goes on.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use ipc_types::layout::CDR_LITTLE_ENDIAN;
use ipc_types::messages::TickTiming;
use run_log::Misses;
use run_log::topics;
use tokio::sync::Notify;
use zerocopy::FromBytes;

use crate::channels::{Channels, MISS, NOTICE, Policy};
use crate::protocol::Subscription;
use crate::queue::{Outgoing, Payload, Queue};

/// Most subscriptions of one client.
pub const MAX_SUBSCRIPTIONS: usize = 256;

/// Notices that a client is told of when it subscribes.
const NOTICES_KEPT: u32 = 64;

/// One client's side of the board.
#[derive(Debug, Default)]
pub struct Client {
    /// Rung when something waits.
    pub bell: Notify,
    state: Mutex<ClientState>,
}

#[derive(Debug, Default)]
struct ClientState {
    queue: Queue,
    /// Channel by subscription.
    subscriptions: BTreeMap<u32, u32>,
}

impl Client {
    /// The next messages ([`Queue::take`]), and how many were dropped since the last call.
    pub fn take(&self, bytes: usize) -> (Vec<Outgoing>, u64) {
        let mut state = lock(&self.state);
        (state.queue.take(bytes), state.queue.take_dropped())
    }
}

/// Channels, clients, and the newest message of each channel.
#[derive(Debug)]
pub struct Board {
    channels: Channels,
    clients: Mutex<Vec<Arc<Client>>>,
    /// Newest message by channel and slot, for whoever subscribes later.
    kept: Mutex<BTreeMap<(u32, u32), (u64, Payload)>>,
    /// Bit i: somebody has subscribed to channel i, modulo 64.
    wanted: AtomicU64,
    time_ns: AtomicU64,
    /// Number of the next notice.
    notices: AtomicU32,
    /// What is called stolen is held against the machine's counter over all ticks.
    misses: Mutex<Misses>,
}

impl Board {
    /// An empty board.
    pub fn new(channels: Channels) -> Board {
        Board {
            channels,
            clients: Mutex::default(),
            kept: Mutex::default(),
            wanted: AtomicU64::new(0),
            time_ns: AtomicU64::new(0),
            notices: AtomicU32::new(0),
            misses: Mutex::default(),
        }
    }

    /// The channels.
    pub fn channels(&self) -> &Channels {
        &self.channels
    }

    /// The simulated time of the newest message.
    pub fn time_ns(&self) -> u64 {
        self.time_ns.load(Ordering::Relaxed)
    }

    /// Sets the simulated time.
    pub fn set_time_ns(&self, time_ns: u64) {
        self.time_ns.store(time_ns, Ordering::Relaxed);
    }

    /// Whether somebody wants a topic. May say yes for a topic that nobody wants.
    pub fn wants(&self, topic: &str) -> bool {
        let Some(id) = self.channels.id(topic) else { return false };
        self.wanted.load(Ordering::Relaxed) & (1 << (id % 64)) != 0
    }

    /// Hands out a log's message: parts of a body, behind the CDR header.
    pub fn publish_cdr(&self, topic: &str, time_ns: u64, parts: &[&[u8]]) {
        let mut bytes = CDR_LITTLE_ENDIAN.to_vec();
        parts.iter().for_each(|part| bytes.extend_from_slice(part));
        self.publish(topic, time_ns, 0, bytes);
    }

    /// Hands out a JSON message.
    pub fn publish_json(&self, topic: &str, value: &serde_json::Value) {
        self.publish(topic, self.time_ns(), 0, value.to_string().into_bytes());
    }

    /// Tells the user something. Whoever comes later is told the last `NOTICES_KEPT`.
    pub fn notice(&self, level: &str, text: &str) {
        let number = self.notices.fetch_add(1, Ordering::Relaxed);
        let value = serde_json::json!({"level": level, "text": text});
        self.hand_out(NOTICE, self.time_ns(), number, value.to_string().into_bytes());
        if let Some(old) = number.checked_sub(NOTICES_KEPT)
            && let Some(id) = self.channels.id(NOTICE)
        {
            lock(&self.kept).remove(&(id, old));
        }
    }

    /// Hands out a message and keeps it as the newest of its channel and slot; before a late tick's timing, its cause.
    pub fn publish(&self, topic: &str, time_ns: u64, slot: u32, bytes: Vec<u8>) {
        if topic == topics::TICK_TIMING
            && let Some(miss) = self.miss_of(&bytes)
        {
            self.hand_out(MISS, time_ns, 0, miss.to_string().into_bytes());
        }
        self.hand_out(topic, time_ns, slot, bytes);
    }

    /// Main cause of a late tick, as the page shows it; none for a tick in time.
    fn miss_of(&self, timing: &[u8]) -> Option<serde_json::Value> {
        let timing = TickTiming::read_from_bytes(timing.strip_prefix(CDR_LITTLE_ENDIAN.as_slice())?).ok()?;
        let lost = lock(&self.misses).add(&timing)?;
        let cause = lost.main_cause();
        let letter = cause.letter().to_string();
        Some(
            serde_json::json!({"tick": timing.tick, "cause": cause.name(), "letter": letter, "lost_ns": lost.total_ns()}),
        )
    }

    fn hand_out(&self, topic: &str, time_ns: u64, slot: u32, bytes: Vec<u8>) {
        let Some(id) = self.channels.id(topic) else { return };
        let Some(channel) = self.channels.get(id) else { return };
        let payload: Payload = bytes.into();
        // Clients subscribe under the same lock: each gets this message once, as kept or as sent.
        let mut kept = lock(&self.kept);
        kept.insert((id, slot), (time_ns, Arc::clone(&payload)));
        for client in lock(&self.clients).iter() {
            let mut state = lock(&client.state);
            let ClientState { queue, subscriptions } = &mut *state;
            for (subscription, _) in subscriptions.iter().filter(|(_, channel)| **channel == id) {
                let message =
                    Outgoing { subscription: *subscription, time_ns, payload: Arc::clone(&payload) };
                match channel.policy {
                    Policy::Stream => queue.push_stream(message),
                    Policy::Newest => queue.push_newest(message, slot),
                }
                client.bell.notify_one();
            }
        }
    }

    /// A new client.
    pub fn join(&self) -> Arc<Client> {
        let client = Arc::new(Client::default());
        lock(&self.clients).push(Arc::clone(&client));
        client
    }

    /// A client has gone.
    pub fn leave(&self, client: &Arc<Client>) {
        lock(&self.clients).retain(|other| !Arc::ptr_eq(other, client));
        self.count_wanted();
    }

    /// Number of clients.
    pub fn client_count(&self) -> usize {
        lock(&self.clients).len()
    }

    /// A client subscribes and is given the newest message of the channel, of a surface all blocks.
    ///
    /// # Errors
    /// No such channel, a number that is taken, too many; the text says so.
    pub fn subscribe(&self, client: &Client, wanted: Subscription) -> Result<(), String> {
        let Subscription { id, channel_id } = wanted;
        let Some(channel) = self.channels.get(channel_id) else {
            return Err(format!("subscription {id}: there is no channel {channel_id}"));
        };
        {
            let kept = lock(&self.kept);
            let mut state = lock(&client.state);
            if state.subscriptions.len() >= MAX_SUBSCRIPTIONS {
                return Err(format!("subscription {id}: a client may have {MAX_SUBSCRIPTIONS}, not more"));
            }
            if state.subscriptions.contains_key(&id) {
                return Err(format!("subscription {id} is taken; unsubscribe it first"));
            }
            state.subscriptions.insert(id, channel_id);
            for ((_, slot), (time_ns, payload)) in kept.range((channel_id, 0)..=(channel_id, u32::MAX)) {
                let payload = Arc::clone(payload);
                let message = Outgoing { subscription: id, time_ns: *time_ns, payload };
                match channel.policy {
                    Policy::Stream => state.queue.push_stream(message),
                    Policy::Newest => state.queue.push_newest(message, *slot),
                }
            }
            client.bell.notify_one();
        }
        self.count_wanted();
        Ok(())
    }

    /// A client wants a subscription no more.
    ///
    /// # Errors
    /// It has no such subscription.
    pub fn unsubscribe(&self, client: &Client, subscription: u32) -> Result<(), String> {
        {
            let mut state = lock(&client.state);
            if state.subscriptions.remove(&subscription).is_none() {
                return Err(format!("there is no subscription {subscription}"));
            }
            state.queue.forget(subscription);
        }
        self.count_wanted();
        Ok(())
    }

    fn count_wanted(&self) {
        let mut bits = 0;
        for client in lock(&self.clients).iter() {
            for channel in lock(&client.state).subscriptions.values() {
                bits |= 1 << (channel % 64);
            }
        }
        self.wanted.store(bits, Ordering::Relaxed);
    }
}

/// A panic elsewhere leaves the data whole: every change is one insertion.
pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
