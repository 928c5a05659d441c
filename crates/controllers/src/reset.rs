//! Detects a reset of the run: removed bone comes back only then.

use messages::State;
use serde::{Deserialize, Serialize};

/// Compares the removed bone of each state with that of the previous state.
#[derive(Debug, Clone, Copy, Default, Serialize, Deserialize)]
pub(crate) struct ResetWatch {
    removed_total: u64,
}

impl ResetWatch {
    /// Takes the next state; returns whether the run was reset just before it.
    pub fn was_reset(&mut self, state: &State) -> bool {
        let before = std::mem::replace(&mut self.removed_total, state.removed_total);
        state.removed_total < before
    }
}
