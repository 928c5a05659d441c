//! The viewer in memory: decides with [`delivery::viewer`] as `viewer_proc` does, and its clients read at
//! their own pace.

use std::collections::VecDeque;

use delivery::viewer::{
    ChannelMessage, Client, Decimation, Limits, Policy, RetainedMessages, SubscribedChannels,
};
use fastrand::Rng;

use crate::oracle::viewer::WatcherAccount;
use crate::plan::MS;
use crate::viewer_plan::{SubscriptionChange, ViewerPlan};

/// Channel of the states.
pub const STATES: u32 = 1;
/// Channel of the X-ray frames, where only the newest counts.
pub const FRAMES: u32 = 2;
/// Channel of the bone's surface, block by block.
pub const SURFACE: u32 = 3;
/// Channel of notices, of which the last few are kept.
pub const NOTICES: u32 = 4;
/// Channels where every message counts.
pub const STREAMS: [u32; 2] = [STATES, NOTICES];
/// Notices kept for clients that subscribe later.
pub const NOTICES_KEPT: u32 = 3;
/// Number of blocks of the surface.
const BLOCKS: u32 = 5;
/// Longest sleep of a client's connection while its queue is empty.
const END_CHECK_NS: u64 = 100 * MS;

/// One client and its connection.
#[derive(Debug)]
struct Watcher {
    client: Client,
    account: WatcherAccount,
    connected: bool,
    /// It has been sent everything and waits to be woken.
    asleep: bool,
    reading_until_ns: u64,
}

/// The viewer process.
#[derive(Debug)]
pub struct Viewer {
    plan: ViewerPlan,
    random: Rng,
    kept: RetainedMessages,
    wanted: SubscribedChannels,
    /// Messages in its queues that it has not taken: channel and number.
    states: VecDeque<u64>,
    frames: VecDeque<u64>,
    notices: u32,
    /// Number of the newest message of each channel that the run has published.
    newest: [u64; 2],
    number: u64,
    watchers: Vec<Watcher>,
    /// Messages sent to clients.
    pub sent: u64,
    /// Missed messages reported to them.
    pub missed: u64,
    /// The first violated rule.
    pub failure: Option<String>,
}

impl Viewer {
    /// Creates the viewer of a plan, at the beginning.
    pub fn new(plan: &ViewerPlan, seed: u64, now_ns: u64) -> Viewer {
        let watcher = |_| Watcher {
            client: Client::new(Limits { stream_bytes: plan.stream_bytes }, now_ns),
            account: WatcherAccount::new(plan.stream_bytes),
            connected: false,
            asleep: false,
            reading_until_ns: 0,
        };
        Viewer {
            plan: plan.clone(),
            random: Rng::with_seed(seed ^ 0x2545_f491_4f6c_dd1d),
            kept: RetainedMessages::default(),
            wanted: SubscribedChannels::default(),
            states: VecDeque::new(),
            frames: VecDeque::new(),
            notices: 0,
            newest: [0; 2],
            number: 0,
            watchers: (0..plan.clients.len()).map(watcher).collect(),
            sent: 0,
            missed: 0,
            failure: None,
        }
    }

    /// Puts a state into its queue, which drops its oldest when full.
    pub fn receive_state(&mut self) {
        self.newest[0] += 1;
        push_bounded(&mut self.states, self.newest[0], self.plan.queue);
    }

    /// Puts an X-ray frame into its queue.
    pub fn receive_frame(&mut self) {
        self.newest[1] += 1;
        push_bounded(&mut self.frames, self.newest[1], self.plan.queue);
    }

    /// Processes its queues, and passes on what it finds.
    pub fn look(&mut self, now_ns: u64) {
        let states = std::mem::take(&mut self.states);
        self.forward(STATES, states, now_ns);
        // If several frames have arrived, it publishes the last.
        let newest_frame = self.frames.drain(..).next_back();
        if let Some(frame) = newest_frame {
            self.publish(FRAMES, 0, frame, now_ns);
        }
        let (block, what) = (self.random.u32(..BLOCKS), self.random.u8(..4));
        if what == 0 {
            self.number += 1;
            self.publish(SURFACE, block, self.number, now_ns);
        }
        if what == 1 {
            self.notices += 1;
            self.publish(NOTICES, self.notices - 1, u64::from(self.notices), now_ns);
        }
    }

    fn forward(&mut self, channel: u32, found: VecDeque<u64>, now_ns: u64) {
        let mut decimation = Decimation::new(self.wanted, channel);
        for number in found {
            if let Some(number) = decimation.next(number) {
                self.publish(channel, 0, number, now_ns);
            }
        }
        if let Some(number) = decimation.last() {
            self.publish(channel, 0, number, now_ns);
        }
    }

    fn publish(&mut self, channel: u32, slot: u32, number: u64, now_ns: u64) {
        let mut payload = vec![0; self.plan.message_bytes];
        payload[..8].copy_from_slice(&number.to_le_bytes());
        let message = ChannelMessage { channel, slot, time_ns: now_ns, payload: payload.into() };
        if channel == NOTICES {
            self.kept.keep_last(&message, NOTICES_KEPT);
        } else {
            self.kept.keep(&message);
        }
        for watcher in &mut self.watchers {
            let count = watcher.connected.then(|| watcher.client.offer(&message));
            watcher.account.published(&message, count);
        }
    }

    /// Wakes a client that sleeps although messages wait; returns whether it did.
    pub fn wakes(&mut self, index: usize) -> bool {
        let watcher = &mut self.watchers[index];
        let wakes = watcher.connected && watcher.asleep && watcher.account.has_waiting();
        watcher.asleep &= !wakes;
        wakes
    }

    /// Connects a client, with its subscriptions.
    pub fn join(&mut self, index: usize) {
        self.watchers[index].connected = true;
        for (subscription, channel) in (1..).zip(self.plan.clients[index].channels.clone()) {
            self.subscribe(index, subscription, channel);
        }
        self.count_wanted();
    }

    fn subscribe(&mut self, index: usize, subscription: u32, channel: u32) {
        let policy = if STREAMS.contains(&channel) { Policy::Stream } else { Policy::Newest };
        let Watcher { client, account, .. } = &mut self.watchers[index];
        let outcome = client.subscribe(subscription, channel, policy, &self.kept);
        account.subscribed(subscription, channel, outcome.is_ok());
    }

    /// Begins or ends a subscription of a client.
    pub fn change(&mut self, index: usize, change: SubscriptionChange) {
        if !self.watchers[index].connected {
            return;
        }
        let Watcher { client, account, .. } = &mut self.watchers[index];
        if account.has(change.subscription) {
            let outcome = client.unsubscribe(change.subscription);
            account.unsubscribed(change.subscription, outcome.is_ok());
        } else {
            self.subscribe(index, change.subscription, change.channel);
        }
        self.count_wanted();
    }

    /// Disconnects a client, discarding drops not yet reported to it.
    pub fn leave(&mut self, index: usize) {
        self.watchers[index].connected = false;
        self.count_wanted();
    }

    fn count_wanted(&mut self) {
        let connected = self.watchers.iter().filter(|watcher| watcher.connected);
        self.wanted = SubscribedChannels::of(connected.flat_map(|watcher| watcher.client.channels()));
    }

    /// Sends what waits for a client; returns the time until it checks again, or `None` if the client has
    /// left.
    pub fn serve(&mut self, index: usize, now_ns: u64) -> Option<u64> {
        let (plan, watcher) = (&self.plan.clients[index], &mut self.watchers[index]);
        if !watcher.connected {
            return None;
        }
        if let Some((from_ns, for_ns)) = plan.stalls
            && watcher.reading_until_ns < from_ns
            && now_ns >= from_ns
        {
            watcher.reading_until_ns = from_ns + for_ns;
        }
        if now_ns < watcher.reading_until_ns {
            return Some(watcher.reading_until_ns - now_ns);
        }
        let count = watcher.send(plan.batch_bytes);
        if let Some(dropped) = watcher.client.drops_to_tell(now_ns) {
            watcher.account.told(dropped, Some(now_ns));
            self.missed += dropped;
        }
        let is_empty = count == 0;
        watcher.asleep = is_empty;
        self.sent += count as u64;
        let read_ns = self.random.u64(plan.read_ns / 4..=plan.read_ns);
        Some(if is_empty { END_CHECK_NS } else { read_ns })
    }

    /// Ends the run: the viewer takes what has arrived, and each remaining client reads to the end.
    pub fn finish(&mut self, now_ns: u64) {
        self.look(now_ns);
        for (index, watcher) in self.watchers.iter_mut().enumerate().filter(|(_, watcher)| watcher.connected)
        {
            while let count @ 1.. = watcher.send(self.plan.clients[index].batch_bytes) {
                self.sent += count as u64;
            }
            if let Some(dropped) = watcher.client.last_drops_to_tell() {
                watcher.account.told(dropped, None);
                self.missed += dropped;
            }
            watcher.account.ended(&[(STATES, self.newest[0]), (FRAMES, self.newest[1])]);
        }
        self.note_failures();
    }

    /// Adopts a violated rule of a client.
    pub fn note_failures(&mut self) {
        for (index, watcher) in self.watchers.iter_mut().enumerate() {
            if let Some(failure) = watcher.account.failure.take() {
                self.failure.get_or_insert(format!("the viewer's client {index}: {failure}"));
            }
        }
    }
}

impl Watcher {
    /// Sends the next messages; returns their number.
    fn send(&mut self, batch_bytes: usize) -> usize {
        let messages = self.client.take(batch_bytes);
        self.account.delivered(&messages, batch_bytes);
        messages.len()
    }
}

fn push_bounded(queue: &mut VecDeque<u64>, number: u64, length: usize) {
    if queue.len() == length {
        queue.pop_front();
    }
    queue.push_back(number);
}
