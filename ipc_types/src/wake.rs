//! Waiting for messages: yield for a short while, then sleep until woken.
//!
//! A writer must not pay for waking a reader that is awake, and a reader must not burn a core that another part
//! needs. So a reader that is about to sleep says so in a flag that it shares with its writers, looks at its queues
//! once more, and then blocks on its iceoryx2 event; a writer sends the event only if the flag is up. The flag starts
//! raised, so that a client that knows nothing of it is always woken.
//!
//! Why no wake-up is lost: the reader stores the flag before it looks at the queue, the writer stores into the queue
//! before it reads the flag, and both put a sequentially consistent fence between. At least one sees the other's.

use std::fs::OpenOptions;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering, fence};
use std::time::{Duration, Instant};

use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::prelude::ipc;
use memmap2::MmapRaw;

/// How long a reader yields before it sleeps. Measured: pure spinning collapses a thousandfold when spinners outnumber
/// cores; yielding for 20 µs costs nothing there and catches nearly every answer of a running peer.
pub const YIELD_TIME: Duration = Duration::from_micros(20);

/// Shortest sleep. iceoryx2 hands it to the kernel as `SO_RCVTIMEO` in whole microseconds, and 0 of them is no limit at
/// all: a reader with less than 1 µs left would sleep until somebody wakes it, which for the recorder nobody does.
const SHORTEST_SLEEP: Duration = Duration::from_micros(10);
/// Longest sleep before a reader looks again by itself.
const LONGEST_SLEEP: Duration = Duration::from_millis(10);

/// Bytes between two readers' flags: a cache line.
const FLAG_STRIDE: usize = 64;
/// Readers that a session can have.
pub(crate) const FLAG_COUNT: usize = 32;

/// The page of flags, one cache line a reader, shared by all processes of a session.
#[derive(Debug, Clone)]
pub(crate) struct WakeFlags {
    map: Arc<MmapRaw>,
}

impl WakeFlags {
    /// Creates the file with every flag raised (the launcher), or maps an existing one.
    pub(crate) fn open(path: &Path, create: bool) -> std::io::Result<WakeFlags> {
        let file = OpenOptions::new().read(true).write(true).create(create).truncate(create).open(path)?;
        if create {
            file.set_len((FLAG_STRIDE * FLAG_COUNT) as u64)?;
        }
        let map = MmapRaw::map_raw(&file)?;
        if map.len() != FLAG_STRIDE * FLAG_COUNT {
            return Err(std::io::Error::other("the file of wake flags has a wrong length"));
        }
        let flags = WakeFlags { map: Arc::new(map) };
        if create {
            (0..FLAG_COUNT).for_each(|reader| flags.flag(reader).store(1, Ordering::SeqCst));
        }
        Ok(flags)
    }

    fn flag(&self, reader: usize) -> &AtomicU32 {
        assert!(reader < FLAG_COUNT, "a session has {FLAG_COUNT} readers at most");
        // SAFETY: the mapping is page-aligned, FLAG_STRIDE × FLAG_COUNT bytes long (checked when it was mapped) and
        // lives as long as `self`; `reader` is in range, so the four bytes lie inside and are aligned. Every process
        // reads and writes them through atomics only.
        unsafe { AtomicU32::from_ptr(self.map.as_mut_ptr().add(reader * FLAG_STRIDE).cast::<u32>()) }
    }
}

/// Wakes one reader.
#[derive(Debug)]
pub struct Waker {
    pub(crate) notifier: Notifier<ipc::Service>,
    pub(crate) flags: WakeFlags,
    pub(crate) reader: usize,
}

impl Waker {
    /// Wakes the reader if it sleeps. Call it after the message has been sent.
    pub fn wake(&self) {
        fence(Ordering::SeqCst);
        if self.flags.flag(self.reader).load(Ordering::Relaxed) != 0 {
            // A reader that has gone cannot be woken, and need not be.
            let _ = self.notifier.notify();
        }
    }
}

/// Lets a reader wait for its messages.
#[derive(Debug)]
pub struct Waiter {
    pub(crate) listener: Listener<ipc::Service>,
    pub(crate) flags: WakeFlags,
    pub(crate) reader: usize,
}

impl Waiter {
    /// Waits until `ready` returns true or the deadline has passed; returns whether it is ready.
    pub fn wait_until(&self, deadline: Instant, mut ready: impl FnMut() -> bool) -> bool {
        let flag = self.flags.flag(self.reader);
        flag.store(0, Ordering::Relaxed);
        let yield_end = Instant::now() + YIELD_TIME;
        loop {
            if ready() {
                return true;
            }
            if Instant::now() >= yield_end {
                break;
            }
            std::thread::yield_now();
        }
        loop {
            flag.store(1, Ordering::Relaxed);
            fence(Ordering::SeqCst);
            let is_ready = ready();
            let left = deadline.saturating_duration_since(Instant::now());
            if is_ready || left.is_zero() {
                flag.store(0, Ordering::Relaxed);
                self.drain();
                return is_ready;
            }
            // A wait that fails (a signal) is a wait that ended early; the loop looks again.
            let _ = self.listener.timed_wait(|_| {}, left.clamp(SHORTEST_SLEEP, LONGEST_SLEEP));
        }
    }

    fn drain(&self) {
        // Left-over notifications would only end the next sleep early.
        let _ = self.listener.try_wait(|_| {});
    }
}
