//! The choices of a seed about the viewer: how often it looks, its clients, and how fast each of them reads.

use fastrand::Rng;

use crate::plan::{MS, SchedulePlan, US};

/// The viewer of a schedule.
#[derive(Debug, Clone, Default)]
pub struct ViewerPlan {
    /// Time between two passes over its queues.
    pub look_ns: u64,
    /// Number of messages that each of its queues holds.
    pub queue: usize,
    /// Limit for the waiting bytes of one client's streams.
    pub stream_bytes: usize,
    /// Bytes of a message.
    pub message_bytes: usize,
    /// Its clients.
    pub clients: Vec<WatcherPlan>,
}

/// A client of the viewer.
#[derive(Debug, Clone)]
pub struct WatcherPlan {
    /// When it connects.
    pub joins_ns: u64,
    /// When it leaves; `None` if it stays to the end.
    pub leaves_ns: Option<u64>,
    /// Bytes that it is sent at a time.
    pub batch_bytes: usize,
    /// Longest time that it takes to read them.
    pub read_ns: u64,
    /// Channels of its initial subscriptions, which are numbered from 1.
    pub channels: Vec<u32>,
    /// Changes of its subscriptions.
    pub changes: Vec<SubscriptionChange>,
    /// When it stops reading for a time, and for how long.
    pub stalls: Option<(u64, u64)>,
}

/// A change of a subscription: ends it if the client has it, otherwise begins it.
#[derive(Debug, Clone, Copy)]
pub struct SubscriptionChange {
    /// Time of the change.
    pub at_ns: u64,
    /// The client's number for it.
    pub subscription: u32,
    /// The channel, if it begins.
    pub channel: u32,
}

/// Number of channels of the simulated viewer.
pub const CHANNELS: u32 = 4;

impl ViewerPlan {
    /// Derives the viewer from a plan's seed and length; `None` in a third of the plans. Draws from its own
    /// random stream, so that the rest of the plan does not depend on it.
    pub fn of(plan: &SchedulePlan) -> Option<ViewerPlan> {
        let mut random = Rng::with_seed(plan.seed ^ 0x6c8e_9cf5_7093_2bd5);
        let clients = [0, 1, 1, 2, 3, 0][random.usize(..6)];
        let message_bytes = random.usize(8..100);
        let latest_ns = plan.nominal_ns() + 3 * MS;
        (clients > 0).then(|| ViewerPlan {
            look_ns: [300 * US, 4 * MS, 20 * MS][random.usize(..3)],
            queue: [4, 512][random.usize(..2)],
            stream_bytes: message_bytes * random.usize(1..12) + random.usize(..message_bytes),
            message_bytes,
            clients: (0..clients).map(|_| watcher(&mut random, latest_ns)).collect(),
        })
    }
}

fn watcher(random: &mut Rng, latest_ns: u64) -> WatcherPlan {
    let changes = [0, 0, 1, 4][random.usize(..4)];
    let change = |random: &mut Rng| SubscriptionChange {
        at_ns: random.u64(..latest_ns),
        subscription: random.u32(1..=3),
        channel: random.u32(1..=CHANNELS),
    };
    WatcherPlan {
        joins_ns: [0, random.u64(..latest_ns)][random.usize(..2)],
        leaves_ns: (random.u8(..6) == 0).then(|| random.u64(..latest_ns)),
        batch_bytes: [1, 100, 1000][random.usize(..3)],
        read_ns: [50 * US, MS, 10 * MS][random.usize(..3)],
        channels: (0..random.usize(1..=4)).map(|_| random.u32(1..=CHANNELS)).collect(),
        changes: (0..changes).map(|_| change(random)).collect(),
        stalls: random.bool().then(|| (random.u64(..latest_ns), random.u64(..latest_ns))),
    }
}
