//! What commands write: never over a file that is there. Every command with an output comes here.
//!
//! That refuses an input by the same rule: it is there. A command looks before its work, so that it refuses at once and has written
//! nothing, and makes its files only if they are still not there when it has something to write.

use std::path::{Path, PathBuf};

use recorder_proc::{LogError, NewFile};

use crate::failure::Failure;

/// Refuses if one of the files is there, as whatever it may be: also as a link that leads nowhere.
///
/// # Errors
/// Bad input: the first one that is there.
pub fn refuse_existing<P: AsRef<Path>>(files: &[P]) -> Result<(), Failure> {
    match files.iter().find(|file| file.as_ref().symlink_metadata().is_ok()) {
        Some(file) => Err(Failure::bad_input(LogError::Exists { path: file.as_ref().to_owned() })),
        None => Ok(()),
    }
}

/// Files that were made for a command, still empty; they are removed again unless they are kept.
#[derive(Debug)]
pub struct NewFiles(Vec<NewFile>);

impl NewFiles {
    /// Makes all files, or none.
    ///
    /// # Errors
    /// One is there already (2); one cannot be made (1).
    pub fn make<P: AsRef<Path>>(files: &[P]) -> Result<NewFiles, Failure> {
        refuse_existing(files)?;
        let made = files.iter().map(|file| NewFile::create(file.as_ref()).map(|(_, made)| made));
        made.collect::<Result<Vec<_>, _>>().map(NewFiles).map_err(|error| match error {
            LogError::Create { path, source } => {
                Failure::failed(format!("{}: cannot be written ({source})", path.display()))
            }
            other => Failure::bad_input(other),
        })
    }

    /// They hold what they should, or something that is worth having.
    ///
    /// # Errors
    /// What the disk says of one.
    pub fn keep(self) -> Result<(), Failure> {
        let kept = self.0.into_iter().try_for_each(NewFile::keep);
        kept.map_err(|error| Failure::failed(error.to_string()))
    }
}

/// Makes the files, lets them be written, and keeps them if that succeeded.
///
/// # Errors
/// As [`NewFiles::make`], and those of `write`.
pub fn write_new<P: AsRef<Path>>(
    files: &[P],
    write: impl FnOnce() -> Result<(), Failure>,
) -> Result<(), Failure> {
    let made = NewFiles::make(files)?;
    write()?;
    made.keep()
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
    const KNOWN: [&str; 19] = [
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
        "stress --output",
        "volume drilled file",
    ];

    fn collect(command: &clap::Command, path: &str, found: &mut Vec<String>) {
        for argument in command.get_arguments() {
            let id = argument.get_id().as_str();
            // What is only read is also called a file.
            let writes_file = id == "file" && matches!(path, "phantom " | "volume drilled ");
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
