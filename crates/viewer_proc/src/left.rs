//! Whether everybody has left.

use std::time::{Duration, Instant};

/// How long nobody may watch before the viewer ends: a page that is loaded again takes a second.
const LEFT_LIMIT: Duration = Duration::from_secs(5);

/// When somebody watched last.
pub(crate) struct Left(Instant);

impl Default for Left {
    fn default() -> Left {
        Left(Instant::now())
    }
}

impl Left {
    /// Whether nobody has watched for `LEFT_LIMIT`.
    pub(crate) fn is_over(&mut self, clients: usize) -> bool {
        if clients > 0 {
            self.0 = Instant::now();
        }
        self.0.elapsed() >= LEFT_LIMIT
    }
}
