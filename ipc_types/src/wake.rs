//! Waiting for messages: poll for a short while, then sleep until woken.
//!
//! How long a reader polls before it sleeps is set by its [`WaitStrategy`]. No reader holds a core that
//! another part needs: it spins only while there are more cores than spinning parts; otherwise it yields
//! between polls. If a yield loses the core to another thread, it sleeps instead, for this wait and the next
//! ones ([`YieldBackoff`]).
//!
//! Waking must be free while the reader is awake. A reader about to sleep therefore raises a flag that it
//! shares with its writers, polls its queues once more, and then blocks on its iceoryx2 event; a writer sends
//! the event only if the flag is raised. The flag starts raised, so a client that ignores it is always woken.
//!
//! No wake-up is lost: the reader stores the flag before it polls the queue, the writer stores into the queue
//! before it reads the flag, and both have a sequentially consistent fence in between. At least one of them
//! sees the other's store.

use std::cell::Cell;
use std::sync::atomic::{Ordering, fence};
use std::time::{Duration, Instant};

use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::prelude::{PortFactory, ipc};

use crate::own::ProcessOwned;
use crate::scene::{Policy, Wait};
use crate::session::EventService;
use crate::shared_page::{FLAG_NEW, SharedPage};

/// How long a reader yields before it sleeps. Measured: pure spinning is a thousand times slower once
/// spinners outnumber cores; yielding for 20 µs costs nothing there and catches nearly every answer of a
/// running peer.
pub const YIELD_TIME: Duration = Duration::from_micros(20);

/// Shortest sleep. iceoryx2 passes it to the kernel as `SO_RCVTIMEO` in whole microseconds, where 0 means no
/// limit: a reader with less than 1 µs left would sleep until woken, and the recorder is never woken.
const SHORTEST_SLEEP: Duration = Duration::from_micros(10);
/// Longest sleep before a reader polls again by itself.
const LONGEST_SLEEP: Duration = Duration::from_millis(10);

/// Wakes one reader.
#[derive(Debug)]
pub struct Waker {
    pub(crate) notifier: ProcessOwned<Notifier<ipc::Service>>,
    pub(crate) page: SharedPage,
    pub(crate) reader: usize,
    pub(crate) service: EventService,
    /// Messages left to skip before the writer tries to wake again, after it found no listener.
    pub(crate) spared: Cell<u32>,
    /// Number of listeners at that time.
    pub(crate) listeners: Cell<usize>,
}

impl Waker {
    /// Number of messages to skip after a wake-up that reached no listener.
    const PATIENCE: u32 = 64;

    /// Wakes the reader if it sleeps. Call it after sending the message.
    pub fn wake(&self) {
        self.try_to_wake();
    }

    /// As [`wake`](Waker::wake); returns whether it made a system call.
    ///
    /// A reader killed in its sleep leaves its flag raised. A writer that woke no reader therefore does not
    /// retry at every message, but only when the number of listeners has changed, when the flag has been
    /// down, or after some messages.
    pub fn try_to_wake(&self) -> bool {
        fence(Ordering::SeqCst);
        let flag = self.page.flag(self.reader).load(Ordering::Relaxed);
        if flag == 0 {
            self.spared.set(0);
            return false;
        }
        let (spared, listeners) = (self.spared.get(), self.service.dynamic_config().number_of_listeners());
        if flag != FLAG_NEW && spared > 0 && listeners == self.listeners.get() {
            self.spared.set(spared - 1);
            return false;
        }
        let woken = self.notifier.notify().unwrap_or(0);
        self.spared.set(if woken == 0 { Self::PATIENCE } else { 0 });
        self.listeners.set(listeners);
        true
    }
}

/// Returns the number of cores that this thread can use; 1 if the system does not report it.
pub fn allowed_cores() -> usize {
    rustix::thread::sched_getaffinity(None).map_or(1, |cores| cores.count().max(1) as usize)
}

/// How a thread waits before it sleeps.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WaitStrategy {
    /// Polls continuously and never sleeps.
    Spin,
    /// As `Spin`, but yields between polls.
    Yield,
    /// Polls for [`YIELD_TIME`], yielding between polls while the core stays free; then sleeps.
    Hybrid,
    /// Sleeps immediately.
    Sleep,
}

impl WaitStrategy {
    /// Chooses how one of `spinning` parts waits on `cores` cores. On one core it sleeps. If the spinning
    /// parts leave no core free, they yield, or sleep under `SCHED_FIFO`, where a yield lets no other part
    /// run.
    pub fn of(wait: Wait, policy: Policy, spinning: usize, cores: usize) -> WaitStrategy {
        match (wait, policy) {
            (Wait::Event, _) => WaitStrategy::Sleep,
            (Wait::Hybrid, _) => WaitStrategy::Hybrid,
            (Wait::Spin, _) if cores <= 1 => WaitStrategy::Sleep,
            (Wait::Spin, _) if spinning < cores => WaitStrategy::Spin,
            (Wait::Spin, Policy::Other) => WaitStrategy::Yield,
            (Wait::Spin, Policy::Fifo) => WaitStrategy::Sleep,
        }
    }
}

/// Stops a thread from yielding for a while after a yield has cost it the core.
#[derive(Debug, Default)]
pub struct YieldBackoff {
    /// Number of waits that still skip yielding.
    skipped_waits: Cell<u32>,
}

impl YieldBackoff {
    /// Number of waits that skip yielding after a yield lost the core.
    const SKIPPED_WAITS: u32 = 64;

    /// Returns whether this wait may yield; counts the wait.
    pub fn core_seems_free(&self) -> bool {
        let skipped_waits = self.skipped_waits.get();
        self.skipped_waits.set(skipped_waits.saturating_sub(1));
        skipped_waits == 0
    }

    /// Yields; returns false if that took longer than a peer needs to answer, because another thread had the
    /// core.
    pub fn offer_core(&self) -> bool {
        let began = Instant::now();
        std::thread::yield_now();
        let is_free = began.elapsed() < 4 * YIELD_TIME;
        if !is_free {
            self.skipped_waits.set(Self::SKIPPED_WAITS);
        }
        is_free
    }
}

/// Lets a reader wait for its messages.
#[derive(Debug)]
pub struct Waiter {
    pub(crate) way: WaitStrategy,
    pub(crate) yield_backoff: YieldBackoff,
    pub(crate) listener: ProcessOwned<Listener<ipc::Service>>,
    pub(crate) page: SharedPage,
    pub(crate) reader: usize,
}

impl Waiter {
    /// Waits until `ready` returns true or the deadline passes; returns whether it is ready.
    pub fn wait_until(&self, deadline: Instant, mut ready: impl FnMut() -> bool) -> bool {
        let flag = self.page.flag(self.reader);
        flag.store(0, Ordering::Relaxed);
        if self.poll(deadline, &mut ready) {
            return true;
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
            // A failed wait (a signal) is just an early wake-up; the loop polls again.
            let _ = self.listener.timed_wait(|_| {}, left.clamp(SHORTEST_SLEEP, LONGEST_SLEEP));
        }
    }

    /// Polls without sleeping, as its [`WaitStrategy`] prescribes; returns whether it is ready.
    fn poll(&self, deadline: Instant, ready: &mut impl FnMut() -> bool) -> bool {
        let end = match self.way {
            WaitStrategy::Sleep => return ready(),
            WaitStrategy::Hybrid if !self.yield_backoff.core_seems_free() => return ready(),
            WaitStrategy::Hybrid => Instant::now() + YIELD_TIME,
            WaitStrategy::Spin | WaitStrategy::Yield => deadline,
        };
        loop {
            if ready() {
                return true;
            }
            if Instant::now() >= end {
                return false;
            }
            match self.way {
                WaitStrategy::Spin => std::hint::spin_loop(),
                WaitStrategy::Yield => std::thread::yield_now(),
                WaitStrategy::Hybrid | WaitStrategy::Sleep => {
                    if !self.yield_backoff.offer_core() {
                        return ready();
                    }
                }
            }
        }
    }

    fn drain(&self) {
        // Leftover notifications would only end the next sleep early.
        let _ = self.listener.try_wait(|_| {});
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_spins_on_one_core_and_spinning_parts_leave_others_a_core() {
        for policy in [Policy::Other, Policy::Fifo] {
            for (wait, one) in [
                (Wait::Spin, WaitStrategy::Sleep),
                (Wait::Event, WaitStrategy::Sleep),
                (Wait::Hybrid, WaitStrategy::Hybrid),
            ] {
                assert_eq!(WaitStrategy::of(wait, policy, 2, 1), one);
            }
            assert_eq!(WaitStrategy::of(Wait::Spin, policy, 2, 3), WaitStrategy::Spin);
        }
        assert_eq!(WaitStrategy::of(Wait::Spin, Policy::Other, 2, 2), WaitStrategy::Yield);
        assert_eq!(WaitStrategy::of(Wait::Spin, Policy::Fifo, 2, 2), WaitStrategy::Sleep);
    }

    #[test]
    fn a_core_that_was_taken_is_not_waited_on_for_a_while() {
        let yield_backoff = YieldBackoff::default();
        assert!(yield_backoff.core_seems_free());
        yield_backoff.skipped_waits.set(2);
        assert_eq!([(); 4].map(|()| yield_backoff.core_seems_free()), [false, false, true, true]);
    }
}
