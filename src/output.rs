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

    /// Commands with an output, and the argument that names it. Each is in the table of `tests/processes/outputs.rs`, but for `run` and
    /// `stress`, which make a folder of a new name, and `proc recorder`, which `run` starts in it.
    const KNOWN: [&str; 20] = [
        "bench soak --output",
        "calibrate --output",
        "chart drr --out",
        "chart drr --rungs",
        "chart physics --out",
        "chart stability --out",
        "drr --output",
        "log cat-files --output",
        "log compress --output",
        "log export --output",
        "log repair --output",
        "log split --output",
        "phantom file",
        "plot --output",
        "replay --record",
        "reproduce --out",
        "run --output",
        "scene init folder",
        "stress --output",
        "volume drilled file",
    ];

    fn collect(command: &clap::Command, path: &str, found: &mut Vec<String>) {
        for argument in command.get_arguments() {
            let id = argument.get_id().as_str();
            // What is only read is also called a file.
            let writes_file = (id == "file" && matches!(path, "phantom " | "volume drilled "))
                || (id == "folder" && path == "scene init ");
            if writes_file || ["output", "out", "record", "rungs"].contains(&id) {
                found.push(format!("{path}{}{id}", if writes_file { "" } else { "--" }));
            }
        }
        let of_users = |command: &&clap::Command| !command.is_hide_set() && command.get_name() != "proc";
        for command in command.get_subcommands().filter(of_users) {
            collect(command, &format!("{path}{} ", command.get_name()), found);
        }
    }

    #[test]
    fn every_command_with_an_output_is_in_the_table_of_the_tests() {
        let mut found = Vec::new();
        collect(&crate::Arguments::command(), "", &mut found);
        found.sort();
        assert_eq!(found, KNOWN);
    }
}
