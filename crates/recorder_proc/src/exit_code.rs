//! Maps a log's verdict to a command's exit code.

use ipc_types::process::{EXIT_FAILED, EXIT_GAP};
use run_log::Verdict;

/// Returns the exit code of a command that has read the log: 0 if it is intact, [`EXIT_FAILED`] if damage
/// stopped the reader, [`EXIT_GAP`] if everything present was read but something is missing.
pub fn exit_code(verdict: &Verdict) -> u8 {
    if verdict.is_intact() {
        0
    } else if verdict.is_stopped_by_damage() {
        EXIT_FAILED
    } else {
        EXIT_GAP
    }
}
