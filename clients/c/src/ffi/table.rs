//! The clients of this thread, by handle.

use std::cell::RefCell;
use std::ffi::CString;
use std::sync::atomic::{AtomicU64, Ordering};

use super::outcome::Failure;
use crate::client::Client;
use crate::error::ClientError;

/// A client and the texts that its caller holds pointers to.
#[derive(Debug)]
pub(super) struct Slot {
    handle: u64,
    pub(super) client: Client,
    pub(super) folder: CString,
    pub(super) controller: CString,
    pub(super) scene_toml: CString,
}

thread_local! {
    static SLOTS: RefCell<Vec<Slot>> = const { RefCell::new(Vec::new()) };
}

/// Handles differ over all threads; 0 is none.
static NEXT_HANDLE: AtomicU64 = AtomicU64::new(1);

/// Puts a client into this thread's table.
pub(super) fn insert(client: Client) -> Result<u64, Failure> {
    let handle = NEXT_HANDLE.fetch_add(1, Ordering::Relaxed);
    let text = |text: String| CString::new(text).unwrap_or_default();
    let info = client.info();
    let scene = std::fs::read_to_string(info.folder.join("scene.toml"));
    let slot = Slot {
        handle,
        folder: text(info.folder.to_string_lossy().into_owned()),
        controller: text(info.controller.as_ref().map_or_else(String::new, |(name, _)| name.clone())),
        scene_toml: text(scene.unwrap_or_default()),
        client,
    };
    SLOTS.try_with(|slots| slots.borrow_mut().push(slot)).map_err(|_| Failure::Handle(handle))?;
    Ok(handle)
}

/// Does something with a client of this thread.
pub(super) fn with<T>(
    handle: u64,
    body: impl FnOnce(&mut Slot) -> Result<T, ClientError>,
) -> Result<T, Failure> {
    let found = SLOTS.try_with(|slots| {
        let mut slots = slots.borrow_mut();
        let slot = slots.iter_mut().find(|slot| slot.handle == handle).ok_or(Failure::Handle(handle))?;
        Ok(body(slot)?)
    });
    found.unwrap_or(Err(Failure::Handle(handle)))
}

/// Takes a client out of the table; it ends with the return value.
pub(super) fn remove(handle: u64) -> Result<Slot, Failure> {
    let found = SLOTS.try_with(|slots| {
        let mut slots = slots.borrow_mut();
        let index = slots.iter().position(|slot| slot.handle == handle)?;
        Some(slots.swap_remove(index))
    });
    found.ok().flatten().ok_or(Failure::Handle(handle))
}
