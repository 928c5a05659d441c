//! What commands write: never over a file that is there, and whole. Every command with an output comes here.
//!
//! That refuses an input by the same rule: it is there. A command looks before its work, so that it refuses at once and has written
//! nothing. What it writes gets its name when it is whole, and only if nothing has that name then (`output_file`).

use std::path::{Path, PathBuf};

use crate::failure::Failure;

/// Refuses if one of the files is there, as whatever it may be: also as a link that leads nowhere.
///
/// # Errors
/// Bad input: the first one that is there.
pub fn refuse_existing<P: AsRef<Path>>(files: &[P]) -> Result<(), Failure> {
    Ok(output_file::refuse_existing(files)?)
}

/// Files of these names in a folder.
pub fn within(folder: &Path, names: &[&str]) -> Vec<PathBuf> {
    names.iter().map(|name| folder.join(name)).collect()
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    /// Commands with an output, and the argument that names it. Each is in the table of `tests/processes/outputs.rs`, but for `run`, which
    /// makes a folder of a new name, and `proc recorder`, which `run` starts in it.
    const KNOWN: [&str; 13] = [
        "calibrate --output",
        "drr --output",
        "log cat-files --output",
        "log compress --output",
        "log export --output",
        "log repair --output",
        "log split --output",
        "phantom file",
        "plot --output",
        "replay --record",
        "run --output",
        "scene init folder",
        "volume drilled file",
    ];

    #[test]
    fn every_command_with_an_output_is_in_the_table_of_the_tests() {
        assert_eq!(test_support::outputs::outputs_of(&crate::cli::Arguments::command()), KNOWN);
    }
}
