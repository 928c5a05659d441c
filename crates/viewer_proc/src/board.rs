//! The board between the data sources and the client connections. Sources never block here: they hand over a
//! message and continue.

use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use delivery::viewer::{
    self, ChannelMessage, Limits, OutgoingMessage, Policy, RetainedMessages, SubscribedChannels,
};
use ipc_types::clock::now_ns;
use ipc_types::messages::TickTiming;
use ipc_types::messages::layout::CDR_LITTLE_ENDIAN;
use run_log::Topic;
use run_log::misses::Misses;
use tokio::sync::Notify;
use zerocopy::FromBytes;

use crate::channels::{Channels, MISS, NOTICE};
use crate::protocol::Subscription;

/// Notices kept for clients that subscribe later.
const NOTICES_KEPT: u32 = 64;
/// Number of late ticks kept for them, with their causes.
const MISSES_KEPT: u32 = 1024;

/// Close reason when the viewer will show something else next. The page compares this string.
pub const GOES_ON: &str = "the viewer goes on";

/// One client's side of the board.
#[derive(Debug)]
pub struct Client {
    /// Notified when a message is queued.
    pub bell: Notify,
    state: Mutex<viewer::Client>,
}

impl Client {
    /// Takes the next messages ([`viewer::Client::take`]).
    pub fn take(&self, bytes: usize) -> Vec<OutgoingMessage> {
        lock(&self.state).take(bytes)
    }

    /// Takes everything that is queued, each newest message once.
    pub fn take_all(&self, bytes: usize) -> Vec<OutgoingMessage> {
        let mut state = lock(&self.state);
        core::iter::repeat_with(|| state.take(bytes))
            .take_while(|batch| !batch.is_empty())
            .flatten()
            .collect()
    }

    /// Returns the number of dropped messages to report to the client now
    /// ([`viewer::Client::drops_to_tell`]).
    pub fn drops_to_tell(&self) -> Option<u64> {
        lock(&self.state).drops_to_tell(now_ns())
    }

    /// Same, when the connection closes.
    pub fn last_drops_to_tell(&self) -> Option<u64> {
        lock(&self.state).last_drops_to_tell()
    }

    /// Counts a message against the client's rate limit; returns false if the limit is exceeded.
    pub fn may_send(&self) -> bool {
        lock(&self.state).may_send(now_ns())
    }
}

/// Channels, clients, and each channel's newest message.
#[derive(Debug)]
pub struct Board {
    channels: Channels,
    clients: Mutex<Vec<Arc<Client>>>,
    /// For clients that subscribe later.
    kept: Mutex<RetainedMessages>,
    /// The bits of [`SubscribedChannels`].
    wanted: AtomicU64,
    time_ns: AtomicU64,
    /// Number of the next notice.
    notices: AtomicU32,
    /// Attributes late ticks. Kept across ticks, because stolen time is checked against the machine's counter
    /// over the whole run.
    misses: Mutex<Misses>,
    /// Number of the next reported miss.
    misses_told: AtomicU32,
    /// Whether the viewer will show something else at the same address afterwards.
    goes_on: AtomicBool,
}

impl Board {
    /// Creates an empty board.
    pub fn new(channels: Channels) -> Board {
        Board {
            channels,
            clients: Mutex::default(),
            kept: Mutex::default(),
            wanted: AtomicU64::new(0),
            time_ns: AtomicU64::new(0),
            notices: AtomicU32::new(0),
            misses: Mutex::default(),
            misses_told: AtomicU32::new(0),
            goes_on: AtomicBool::new(false),
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

    /// Whether any client subscribes to a topic. May return true when none does.
    pub fn wants(&self, topic: &str) -> bool {
        self.channels.id(topic).is_some_and(|id| self.wanted().has(id))
    }

    /// The channels with at least one subscriber.
    pub fn wanted(&self) -> SubscribedChannels {
        SubscribedChannels(self.wanted.load(Ordering::Relaxed))
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

    /// Notifies the user. Clients that subscribe later get the last `NOTICES_KEPT` notices.
    pub fn notice(&self, level: &str, text: &str) {
        let number = self.notices.fetch_add(1, Ordering::Relaxed);
        let value = serde_json::json!({"level": level, "text": text});
        let keep =
            |kept: &mut RetainedMessages, message: &ChannelMessage| kept.keep_last(message, NOTICES_KEPT);
        self.hand_out(NOTICE, self.time_ns(), number, value.to_string().into_bytes(), keep);
    }

    /// Publishes a message and keeps it as the newest of its channel and slot. Before the timing of a late
    /// tick, also publishes the cause.
    pub fn publish(&self, topic: &str, time_ns: u64, slot: u32, bytes: Vec<u8>) {
        if topic == Topic::TickTiming.name()
            && let Some(miss) = self.miss_of(&bytes)
        {
            // Kept, so that a page opened later still shows it.
            let number = self.misses_told.fetch_add(1, Ordering::Relaxed);
            let keep =
                |kept: &mut RetainedMessages, message: &ChannelMessage| kept.keep_last(message, MISSES_KEPT);
            self.hand_out(MISS, time_ns, number, miss.to_string().into_bytes(), keep);
        }
        self.hand_out(topic, time_ns, slot, bytes, RetainedMessages::keep);
    }

    /// Returns the main cause of a late tick, in the page's format, or `None` for a tick on time.
    fn miss_of(&self, timing: &[u8]) -> Option<serde_json::Value> {
        let timing = TickTiming::read_from_bytes(timing.strip_prefix(CDR_LITTLE_ENDIAN.as_slice())?).ok()?;
        let lost = lock(&self.misses).add(&timing)?;
        let cause = lost.main_cause();
        let letter = cause.letter().to_string();
        Some(serde_json::json!({"tick": timing.tick, "cause": cause.name(), "letter": letter,
                "lost_ns": lost.total_ns()}))
    }

    fn hand_out(
        &self,
        topic: &str,
        time_ns: u64,
        slot: u32,
        bytes: Vec<u8>,
        keep: impl Fn(&mut RetainedMessages, &ChannelMessage),
    ) {
        let Some(id) = self.channels.id(topic) else { return };
        let message = ChannelMessage { channel: id, slot, time_ns, payload: bytes.into() };
        // Clients subscribe under the same lock, so each gets this message exactly once, kept or sent.
        let mut kept = lock(&self.kept);
        keep(&mut kept, &message);
        for client in lock(&self.clients).iter() {
            if lock(&client.state).offer(&message) > 0 {
                client.bell.notify_one();
            }
        }
    }

    /// Announces that something else will be shown at the same address, so that clients reconnect.
    pub fn go_on(&self) {
        self.goes_on.store(true, Ordering::Relaxed);
    }

    /// Reason given to clients when their connections close.
    pub fn farewell(&self) -> &'static str {
        if self.goes_on.load(Ordering::Relaxed) { GOES_ON } else { "the viewer has ended" }
    }

    /// Adds a client.
    pub fn join(&self) -> Arc<Client> {
        let state = Mutex::new(viewer::Client::new(Limits::default(), now_ns()));
        let client = Arc::new(Client { bell: Notify::new(), state });
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
    /// No such channel, duplicate subscription number, or too many subscriptions.
    pub fn subscribe(&self, client: &Client, wanted: Subscription) -> Result<(), String> {
        let Subscription { id, channel_id, newest } = wanted;
        let Some(channel) = self.channels.get(channel_id) else {
            return Err(format!("subscription {id}: there is no channel {channel_id}"));
        };
        {
            let kept = lock(&self.kept);
            let policy = if newest { Policy::Newest } else { channel.policy };
            let subscribed = lock(&client.state).subscribe(id, channel_id, policy, &kept);
            subscribed.map_err(|refusal| refusal.to_string())?;
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
        lock(&client.state).unsubscribe(subscription).map_err(|refusal| refusal.to_string())?;
        self.count_wanted();
        Ok(())
    }

    fn count_wanted(&self) {
        let clients = lock(&self.clients);
        let channels = clients.iter().flat_map(|client| lock(&client.state).channels().collect::<Vec<_>>());
        self.wanted.store(SubscribedChannels::of(channels).0, Ordering::Relaxed);
    }
}

/// Ignores poisoning: every change is a single insertion, so a panic elsewhere leaves the data intact.
pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
