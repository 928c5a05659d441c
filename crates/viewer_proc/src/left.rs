//! Ends the viewer once all its clients have disconnected.

use std::time::{Duration, Instant};

/// Time without clients after which the viewer ends; reloading the page takes about a second.
const LEFT_LIMIT: Duration = Duration::from_secs(5);

/// Time at which a client was last connected.
pub(crate) struct IdleTimer(Instant);

impl Default for IdleTimer {
    fn default() -> IdleTimer {
        IdleTimer(Instant::now())
    }
}

impl IdleTimer {
    /// Returns whether there has been no client for `LEFT_LIMIT`.
    pub(crate) fn is_over(&mut self, clients: usize) -> bool {
        if clients > 0 {
            self.0 = Instant::now();
        }
        self.0.elapsed() >= LEFT_LIMIT
    }
}
