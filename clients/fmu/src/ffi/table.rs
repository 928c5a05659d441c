//! The instances of this process.

use core::ffi::c_void;
use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicPtr, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use super::status;
use crate::error::FmuError;
use crate::instance::Instance;

/// An instance or an FMU state as the caller holds it: a number, never an address.
pub type Handle = *mut c_void;

/// Tells the caller a message: its environment, the instance's name, the status and the text.
pub(super) type LogMessage = Box<dyn Fn(*mut c_void, i32, &str) + Send + Sync>;

struct Entry {
    instance: Mutex<Instance>,
    log: LogMessage,
    environment: AtomicPtr<c_void>,
}

static INSTANCES: Mutex<BTreeMap<usize, Arc<Entry>>> = Mutex::new(BTreeMap::new());
static NEXT: AtomicUsize = AtomicUsize::new(1);

/// Returns a number as a handle.
pub(super) fn handle(number: u64) -> Handle {
    core::ptr::without_provenance_mut(number as usize)
}

/// Returns a handle's number.
pub(super) fn number(handle: Handle) -> u64 {
    handle.addr() as u64
}

fn instances() -> std::sync::MutexGuard<'static, BTreeMap<usize, Arc<Entry>>> {
    // A panic leaves the map intact: each change is a single call.
    INSTANCES.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Creates an instance; null, with a message to the caller, if that fails.
pub(super) fn create(
    log: LogMessage,
    environment: *mut c_void,
    make: impl FnOnce() -> Result<Instance, FmuError>,
) -> Handle {
    match caught(make) {
        Ok(instance) => {
            let entry =
                Entry { instance: Mutex::new(instance), log, environment: AtomicPtr::new(environment) };
            let number = NEXT.fetch_add(1, Ordering::Relaxed);
            instances().insert(number, Arc::new(entry));
            handle(number as u64)
        }
        Err(error) => {
            log(environment, status::ERROR, &error.to_string());
            core::ptr::null_mut()
        }
    }
}

/// Frees an instance; an unknown one is ignored.
pub(super) fn free(handle: Handle) {
    let entry = instances().remove(&handle.addr());
    // Outside the lock: ending a simulation's thread takes a while.
    _ = caught(move || {
        drop(entry);
        Ok(())
    });
}

fn caught<R>(work: impl FnOnce() -> Result<R, FmuError>) -> Result<R, FmuError> {
    // What a panic leaves half done stays inside the instance, whose next calls fail or work on plain values.
    catch_unwind(AssertUnwindSafe(work)).unwrap_or(Err(FmuError::Defect))
}

/// Works with an instance; returns the status, and tells the caller of a failure.
pub(super) fn with(handle: Handle, work: impl FnOnce(&mut Instance) -> Result<(), FmuError>) -> i32 {
    let Some(entry) = instances().get(&handle.addr()).cloned() else { return status::ERROR };
    let done = {
        let mut instance = entry.instance.lock().unwrap_or_else(PoisonError::into_inner);
        caught(|| work(&mut instance))
    };
    match done {
        Ok(()) => status::OK,
        Err(error) => {
            let status = if matches!(error, FmuError::Defect) { status::FATAL } else { status::ERROR };
            // Outside the instance's lock, because the caller may use the instance in its log function.
            (entry.log)(entry.environment.load(Ordering::Relaxed), status, &error.to_string());
            status
        }
    }
}
