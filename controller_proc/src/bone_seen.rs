//! How a controller notices that the run was set back to its beginning: only then does bone come back.

use ipc_types::messages::State;

/// Bone that was removed when the last state came.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct BoneSeen {
    removed_total: u64,
}

impl BoneSeen {
    /// Takes the next state; whether the run was set back before it.
    pub fn is_back(&mut self, state: &State) -> bool {
        let before = std::mem::replace(&mut self.removed_total, state.removed_total);
        state.removed_total < before
    }
}
