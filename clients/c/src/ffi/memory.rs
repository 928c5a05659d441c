//! What a client has handed out, held beyond its end: by languages in which memory lives as long as somebody looks at it.

use std::sync::atomic::{AtomicPtr, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

use ipc_types::own::Generation;

use super::outcome::Failure;
use super::table::{Open, Texts};
use crate::client::Kept;

/// What stays of a client that has left.
#[derive(Debug)]
struct Left {
    _kept: Kept,
    _texts: Texts,
}

// SAFETY: what forbids another thread is the transport's reference count that a port and its samples share, which is not
// atomic. `Client::leave` has taken each port together with the only sample of it that there is, so both owners of such a
// count are in here, the thread that counted before has none, and the lock below orders its counting before ours. All else
// in a port is `Send` by the transport's own word (`SubscriberSharedState`, `Node`), or a value of ours that is.
unsafe impl Send for Left {}

/// A client whose memory is held.
#[derive(Debug)]
struct Held {
    handle: u64,
    holds: u64,
    /// What is to stay, once the client has left.
    left: Option<Left>,
}

#[derive(Debug)]
struct Registry {
    made_by: Generation,
    held: Mutex<Vec<Held>>,
}

/// This process's registry. A child of `fork` makes one of its own: of its parent's, another thread may have held the lock.
fn registry() -> &'static Registry {
    static CURRENT: AtomicPtr<Registry> = AtomicPtr::new(core::ptr::null_mut());
    let known = CURRENT.load(Ordering::Acquire);
    // SAFETY: null, or a registry that was leaked below, so that it is never freed.
    if let Some(registry) = unsafe { known.as_ref() }
        && registry.made_by == Generation::current()
    {
        return registry;
    }
    let new: *mut Registry =
        Box::leak(Box::new(Registry { made_by: Generation::current(), held: Mutex::default() }));
    let set = CURRENT.compare_exchange(known, new, Ordering::AcqRel, Ordering::Acquire);
    // SAFETY: both this one and one that another thread has put there first were leaked here.
    unsafe { &*set.map_or_else(|first| first, |_| new) }
}

fn held() -> MutexGuard<'static, Vec<Held>> {
    // A panic leaves the list as it is: each change of it is one assignment.
    registry().held.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Holds the memory of a connected client once more.
pub(super) fn hold(handle: u64) {
    let mut all = held();
    match all.iter_mut().find(|held| held.handle == handle) {
        Some(held) => held.holds += 1,
        None => all.push(Held { handle, holds: 1, left: None }),
    }
}

/// Takes one hold back; the last one lets go of what its client has left.
pub(super) fn release(handle: u64) -> Result<(), Failure> {
    let mut all = held();
    let index = all.iter().position(|held| held.handle == handle).ok_or(Failure::NotHeld(handle))?;
    all[index].holds -= 1;
    let last = (all[index].holds == 0).then(|| all.swap_remove(index));
    // Unmapping takes a while; nobody waits for it.
    drop(all);
    drop(last);
    Ok(())
}

/// Ends a client, but for its memory if that is held.
pub(super) fn end(handle: u64, open: Open) {
    if !open.client.is_ours() {
        // Its parent's: dropped here, it touches nothing.
        return;
    }
    let left = Left { _kept: open.client.leave(), _texts: open.texts };
    if let Some(held) = held().iter_mut().find(|held| held.handle == handle) {
        held.left = Some(left);
    }
}
