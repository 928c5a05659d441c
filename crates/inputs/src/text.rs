//! Reads text files named by command-line arguments.

use std::path::Path;

use crate::failure::Failure;

/// Reads a regular file as UTF-8; see [`ipc_types::text_file::read`].
///
/// # Errors
/// Bad input: the file cannot be read; the message names it.
pub fn read(path: &Path) -> Result<String, Failure> {
    ipc_types::text_file::read(path)
        .map_err(|cause| Failure::bad_input(format!("{}: cannot be read ({cause})", path.display())))
}
