//! The board between the sources and the clients' connections. No source ever blocks here: it hands its message over and continues.

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

/// Notices kept for clients that subscribe later.
const NOTICES_KEPT: u32 = 64;

/// One client's side of the board.
#[derive(Debug, Default)]
pub struct Client {
    /// Notified when a message is queued.
    pub bell: Notify,
    state: Mutex<ClientState>,
}

#[derive(Debug, Default)]
struct ClientState {
    queue: Queue,
    /// Channel number by subscription.
    subscriptions: BTreeMap<u32, u32>,
}

impl Client {
    /// Takes the next messages ([`Queue::take`]), and the number dropped since the last call.
    pub fn take(&self, bytes: usize) -> (Vec<Outgoing>, u64) {
        let mut state = lock(&self.state);
        (state.queue.take(bytes), state.queue.take_dropped())
    }
}

/// Channels, clients, and each channel's newest message.
#[derive(Debug)]
pub struct Board {
    channels: Channels,
    clients: Mutex<Vec<Arc<Client>>>,
    /// Newest message by channel and slot, for clients that subscribe later.
    kept: Mutex<BTreeMap<(u32, u32), (u64, Payload)>>,
    /// Bit i: some client has subscribed to channel i, modulo 64.
    wanted: AtomicU64,
    time_ns: AtomicU64,
    /// Number of the next notice.
    notices: AtomicU32,
    /// Attributes late ticks. Kept across ticks, because stolen time is checked against the machine's counter over all of them.
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

    /// Simulated time of the newest message, ns.
    pub fn time_ns(&self) -> u64 {
        self.time_ns.load(Ordering::Relaxed)
    }

    /// Sets the simulated time, ns.
    pub fn set_time_ns(&self, time_ns: u64) {
        self.time_ns.store(time_ns, Ordering::Relaxed);
    }

    /// Whether anybody subscribes to a topic. May return true when nobody does.
    pub fn wants(&self, topic: &str) -> bool {
        let Some(id) = self.channels.id(topic) else { return false };
        self.wanted.load(Ordering::Relaxed) & (1 << (id % 64)) != 0
    }

    /// Publishes a log message: the CDR header, then the parts of its body.
    pub fn publish_cdr(&self, topic: &str, time_ns: u64, parts: &[&[u8]]) {
        let mut bytes = CDR_LITTLE_ENDIAN.to_vec();
        parts.iter().for_each(|part| bytes.extend_from_slice(part));
        self.publish(topic, time_ns, 0, bytes);
    }

    /// Publishes a JSON message.
    pub fn publish_json(&self, topic: &str, value: &serde_json::Value) {
        self.publish(topic, self.time_ns(), 0, value.to_string().into_bytes());
    }

    /// Notifies the user. Clients that subscribe later get the last `NOTICES_KEPT`.
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

    /// Publishes a message and keeps it as the newest of its channel and slot. Before a late tick's timing, also publishes the cause.
    pub fn publish(&self, topic: &str, time_ns: u64, slot: u32, bytes: Vec<u8>) {
        if topic == topics::TICK_TIMING
            && let Some(miss) = self.miss_of(&bytes)
        {
            self.hand_out(MISS, time_ns, 0, miss.to_string().into_bytes());
        }
        self.hand_out(topic, time_ns, slot, bytes);
    }

    /// Main cause of a late tick, as the page shows it; `None` for a tick on time.
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
        // Clients subscribe under the same lock, so each gets this message exactly once, kept or sent.
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

    /// Adds a client.
    pub fn join(&self) -> Arc<Client> {
        let client = Arc::new(Client::default());
        lock(&self.clients).push(Arc::clone(&client));
        client
    }

    /// Removes a client.
    pub fn leave(&self, client: &Arc<Client>) {
        lock(&self.clients).retain(|other| !Arc::ptr_eq(other, client));
        self.count_wanted();
    }

    /// Number of clients.
    pub fn client_count(&self) -> usize {
        lock(&self.clients).len()
    }

    /// Subscribes a client and gives it the channel's newest message; for a surface, all blocks.
    ///
    /// # Errors
    /// No such channel, a number already in use, too many subscriptions; the text says which.
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

    /// Ends a client's subscription.
    ///
    /// # Errors
    /// The client has no such subscription.
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

/// Ignores poisoning: every change is a single insertion, so a panic elsewhere leaves the data intact.
pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
