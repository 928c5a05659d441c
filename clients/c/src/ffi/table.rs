//! This thread's clients, by handle.

use std::cell::RefCell;
use std::ffi::CString;
use std::sync::atomic::{AtomicU64, Ordering};

use super::memory;
use super::outcome::Failure;
use crate::client::Client;
use crate::error::ClientError;

/// Texts to which the client's caller has pointers.
#[derive(Debug)]
pub(super) struct Texts {
    pub(super) folder: CString,
    pub(super) controller: CString,
    pub(super) scene_toml: CString,
    /// The session's name, for errors.
    pub(super) name: String,
}

/// A connected client.
#[derive(Debug)]
pub(super) struct Open {
    pub(super) client: Client,
    pub(super) texts: Texts,
}

/// A slot in the table. Held memory outlives it, regardless of how the slot ends (trb_disconnect, the thread,
/// the program).
#[derive(Debug)]
struct Slot {
    handle: u64,
    open: Option<Open>,
}

impl Drop for Slot {
    fn drop(&mut self) {
        if let Some(open) = self.open.take() {
            memory::end(self.handle, open);
        }
    }
}

thread_local! {
    static SLOTS: RefCell<Vec<Slot>> = const { RefCell::new(Vec::new()) };
}

/// Handles are unique across all threads; 0 is never used.
static NEXT_HANDLE: AtomicU64 = AtomicU64::new(1);

/// Runs `body` on this thread's table. The table can only be in use if the caller is a signal handler.
fn with_slots<T>(handle: u64, body: impl FnOnce(&mut Vec<Slot>) -> Result<T, Failure>) -> Result<T, Failure> {
    let done = SLOTS.try_with(|slots| body(&mut *slots.try_borrow_mut().map_err(|_| Failure::Busy)?));
    // An ending thread has no table any more.
    done.unwrap_or(Err(Failure::Handle(handle)))
}

/// Adds a client to this thread's table.
pub(super) fn insert(client: Client) -> Result<u64, Failure> {
    let handle = NEXT_HANDLE.fetch_add(1, Ordering::Relaxed);
    let text = |text: String| CString::new(text).unwrap_or_default();
    let info = client.info();
    let scene = std::fs::read_to_string(info.folder.join("scene.toml"));
    let texts = Texts {
        folder: text(info.folder.to_string_lossy().into_owned()),
        controller: text(info.controller.as_ref().map_or_else(String::new, |(name, _)| name.clone())),
        scene_toml: text(scene.unwrap_or_default()),
        name: client.session_name(),
    };
    let slot = Slot { handle, open: Some(Open { client, texts }) };
    with_slots(handle, |slots| {
        slots.push(slot);
        Ok(handle)
    })
}

/// Runs `body` on a client of this thread and process.
pub(super) fn with<T>(
    handle: u64,
    body: impl FnOnce(&mut Open) -> Result<T, ClientError>,
) -> Result<T, Failure> {
    with_slots(handle, |slots| {
        let slot = slots.iter_mut().find(|slot| slot.handle == handle);
        let open = slot.and_then(|slot| slot.open.as_mut()).ok_or(Failure::Handle(handle))?;
        open.client.check_process()?;
        body(open).map_err(|cause| match cause {
            ClientError::TimedOut(_) => Failure::Client(cause),
            ClientError::Ended => Failure::Ended(open.client.end_reason()),
            cause => Failure::Joined { session: open.texts.name.clone(), cause },
        })
    })
}

/// Ends a client.
pub(super) fn remove(handle: u64) -> Result<(), Failure> {
    with(handle, |_| Ok(()))?;
    let slot = with_slots(handle, |slots| {
        let index = slots.iter().position(|slot| slot.handle == handle).ok_or(Failure::Handle(handle))?;
        Ok(slots.swap_remove(index))
    })?;
    drop(slot);
    Ok(())
}
