//! Keeps the messages that a client gave to its caller mapped after the client's end, for languages in which
//! memory lives as long as it is referenced.

use std::sync::atomic::{AtomicPtr, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

use ipc_types::own::Generation;

use super::outcome::Failure;
use super::table::{Open, Texts};
use crate::client::Kept;

/// Memory of a client that has left.
#[derive(Debug)]
struct Left {
    _kept: Kept,
    _texts: Texts,
}

// SAFETY: the only obstacle to another thread is the transport's non-atomic reference count, which a port and
// its samples share. `Client::leave` took each port together with its only sample, so both owners of each
// count are in here and the previous thread has none; the lock below orders its counting before ours.
// Everything else in a port is `Send`, declared by the transport (`SubscriberSharedState`, `Node`) or as a
// value of ours.
unsafe impl Send for Left {}

/// A client whose memory is held.
#[derive(Debug)]
struct Held {
    handle: u64,
    holds: u64,
    /// Memory to keep once the client has left.
    left: Option<Left>,
}

#[derive(Debug)]
struct Registry {
    made_by: Generation,
    held: Mutex<Vec<Held>>,
}

/// Returns this process's registry. A `fork` child creates its own, because another thread may have held the
/// lock of its parent's registry.
fn registry() -> &'static Registry {
    static CURRENT: AtomicPtr<Registry> = AtomicPtr::new(core::ptr::null_mut());
    let known = CURRENT.load(Ordering::Acquire);
    // SAFETY: null, or a registry leaked below, so it is never freed.
    if let Some(registry) = unsafe { known.as_ref() }
        && registry.made_by == Generation::current()
    {
        return registry;
    }
    let new: *mut Registry =
        Box::leak(Box::new(Registry { made_by: Generation::current(), held: Mutex::default() }));
    let set = CURRENT.compare_exchange(known, new, Ordering::AcqRel, Ordering::Acquire);
    // SAFETY: both this registry and one that another thread stored first were leaked here.
    unsafe { &*set.map_or_else(|first| first, |_| new) }
}

fn held() -> MutexGuard<'static, Vec<Held>> {
    // A panic leaves the list intact: each change is a single assignment.
    registry().held.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Adds a hold on the memory of a connected client.
pub(super) fn hold(handle: u64) {
    let mut all = held();
    match all.iter_mut().find(|held| held.handle == handle) {
        Some(held) => held.holds += 1,
        None => all.push(Held { handle, holds: 1, left: None }),
    }
}

/// Drops one hold; dropping the last one frees the client's memory.
pub(super) fn release(handle: u64) -> Result<(), Failure> {
    let mut all = held();
    let index = all.iter().position(|held| held.handle == handle).ok_or(Failure::NotHeld(handle))?;
    all[index].holds -= 1;
    let last = (all[index].holds == 0).then(|| all.swap_remove(index));
    // Outside the lock, because unmapping takes a while.
    drop(all);
    drop(last);
    Ok(())
}

/// Ends a client, but keeps its memory if it is held.
pub(super) fn end(handle: u64, open: Open) {
    if !open.client.is_ours() {
        // The parent's: dropping it here has no effect.
        return;
    }
    let left = Left { _kept: open.client.leave(), _texts: open.texts };
    if let Some(held) = held().iter_mut().find(|held| held.handle == handle) {
        held.left = Some(left);
    }
}
