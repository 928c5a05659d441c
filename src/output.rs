//! Output files of commands: never overwrite an existing file, never leave a partial one. Every command with
//! an output uses this module.
//!
//! This also keeps a command from overwriting its input. A command checks first, so that it fails at once and
//! writes nothing. An output gets its name only once it is complete, and only if the name is still free
//! (`output_file`).

use std::path::{Path, PathBuf};

use figures::{Figure, FigureError};

use crate::failure::Failure;
use crate::report::ReportError;

/// Fails if one of the files exists in any form, even as a dangling link.
pub fn refuse_existing<P: AsRef<Path>>(files: &[P]) -> Result<(), Failure> {
    Ok(output_file::refuse_existing(files)?)
}

/// Returns where to write a figure as `.png` and `.svg`, from a path with or without either extension.
///
/// # Errors
/// Bad input: the path has no file name, or one of the files exists.
pub fn figure_place(path: &Path) -> Result<FigurePlace<'_>, Failure> {
    let folder = path.parent().filter(|folder| *folder != Path::new("")).unwrap_or(Path::new("."));
    let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let stem = [".png", ".svg"].iter().find_map(|ending| name.strip_suffix(ending)).unwrap_or(&name);
    if stem.is_empty() {
        return Err(Failure::bad_input("--output has no file name"));
    }
    let files = ["png", "svg"].map(|ending| folder.join(format!("{stem}.{ending}")));
    refuse_existing(&files)?;
    Ok(FigurePlace { folder, stem: stem.to_owned(), files })
}

/// Output paths of a figure.
#[derive(Debug)]
pub struct FigurePlace<'a> {
    folder: &'a Path,
    /// File name without extension.
    stem: String,
    /// The `.png` and `.svg` file.
    pub files: [PathBuf; 2],
}

impl FigurePlace<'_> {
    /// Writes the figure.
    pub fn write(&self, figure: Result<Figure, FigureError>) -> Result<(), Failure> {
        let written = figure.and_then(|figure| figure.write(self.folder, &self.stem));
        Ok(written.map_err(ReportError::from)?)
    }
}

/// An output folder that is created before a long job, so that one that cannot be written to fails at once.
/// On drop, the folders that were created for it are removed again if they are empty.
#[derive(Debug)]
pub struct OutputFolder {
    /// Innermost first.
    created: Vec<PathBuf>,
}

impl OutputFolder {
    /// Creates the folder of a file that will be written.
    ///
    /// # Errors
    /// The folder cannot be created, or the file cannot be created in it.
    pub fn of(file: &Path) -> Result<OutputFolder, Failure> {
        let folder = output_file::folder_of(file);
        let missing = folder.ancestors().take_while(|it| *it != Path::new("") && !it.exists());
        let created = OutputFolder { created: missing.map(Path::to_owned).collect() };
        output_file::create_folder(folder).map_err(Failure::folder(folder))?;
        output_file::OutputFile::create(file)?;
        Ok(created)
    }
}

impl Drop for OutputFolder {
    fn drop(&mut self) {
        for folder in &self.created {
            // Fails if there is something in it.
            let _ = std::fs::remove_dir(folder);
        }
    }
}

/// Returns the paths of these names in a folder.
pub fn within(folder: &Path, names: &[&str]) -> Vec<PathBuf> {
    names.iter().map(|name| folder.join(name)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_created_for_nothing_is_removed_and_one_that_cannot_be_written_to_is_refused() {
        let place = tempfile::tempdir().unwrap();
        let file = place.path().join("a/b/plans.png");
        drop(OutputFolder::of(&file).unwrap());
        assert!(!place.path().join("a").exists() && place.path().exists());
        let folder = OutputFolder::of(&file).unwrap();
        output_file::write(&file, "").unwrap();
        drop(folder);
        assert!(file.exists());
        let refused = OutputFolder::of(&file.join("c/plans.png")).unwrap_err();
        assert!(refused.code == 2 && refused.message.contains("plans.png/c: cannot be created"), "{refused}");
    }

    /// Commands with an output, and the argument that names it. All are in the table of
    /// `tests/processes/outputs.rs`, except `run` and `stress`, which create a folder with a new name, and
    /// `proc recorder`, which `run` starts in it; `sweep list`, which writes nothing; and `sweep run`, which
    /// takes a new folder or its own (`tests/processes/sweeps.rs`).
    const KNOWN: [&str; 24] = [
        "calibrate --output",
        "docs install --output",
        "drr --output",
        "fmu export --output",
        "identify --output",
        "log cat-files --output",
        "log compress --output",
        "log export --output",
        "log repair --output",
        "log split --output",
        "phantom --output",
        "plan path --output",
        "plot --output",
        "replay --output",
        "run --output",
        "scene from-markups --output",
        "scene init --output",
        "scene show --output",
        "stress --output",
        "sweep gather --output",
        "sweep list --output",
        "sweep plot --output",
        "sweep run --output",
        "volume drilled --output",
    ];

    #[test]
    fn every_command_with_an_output_is_in_the_table_of_the_tests() {
        assert_eq!(test_support::outputs::outputs_of(&crate::cli::command_line()), KNOWN);
    }
}
