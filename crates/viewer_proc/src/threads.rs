//! Starts the viewer's threads. With too few processes (`RLIMIT_NPROC`) that is an error, not a panic.

use std::thread::{Builder, JoinHandle, Scope, ScopedJoinHandle};

use crate::error::ViewerError;

/// Starts a thread.
///
/// # Errors
/// [`ViewerError::Runtime`].
pub(crate) fn start<T: Send + 'static>(
    name: &str,
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<JoinHandle<T>, ViewerError> {
    Builder::new().name(name.to_owned()).spawn(work).map_err(ViewerError::Runtime)
}

/// Starts a thread that ends within a scope.
///
/// # Errors
/// As [`start`].
pub(crate) fn start_in<'scope, T: Send + 'scope>(
    scope: &'scope Scope<'scope, '_>,
    name: &str,
    work: impl FnOnce() -> T + Send + 'scope,
) -> Result<ScopedJoinHandle<'scope, T>, ViewerError> {
    Builder::new().name(name.to_owned()).spawn_scoped(scope, work).map_err(ViewerError::Runtime)
}
