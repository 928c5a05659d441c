//! Runs the FMUs of others: for controllers that come as FMUs.
//!
//! **An FMU is a program**: [`Master::new`] loads its library into this process, so use it only in a process
//! of its own. Reading the archive and its model description ([`Archived`]) runs no code of it.

mod library;
mod model;
mod unzip;

use std::path::{Path, PathBuf};

use ipc_types::text_file;

pub use library::{Master, preload};
pub use model::{ForeignModel, ForeignVariable, VariableType};

use crate::error::FmuError;

/// Longest file of an FMU, packed or not.
const MOST_BYTES: u64 = 1 << 30;
/// Most bytes of all files of an FMU.
const MOST_TOTAL_BYTES: u64 = 2 << 30;

/// An FMU's archive, checked, with its model description; nothing of it has run.
#[derive(Debug)]
pub struct Archived {
    /// What the model description says.
    pub model: ForeignModel,
    bytes: Vec<u8>,
    entries: Vec<unzip::Entry>,
}

pub(crate) fn malformed(reason: impl ToString) -> FmuError {
    FmuError::File { path: "FMU".to_owned(), reason: reason.to_string() }
}

/// Folder of a version's libraries for this machine.
fn folder_of(three: bool) -> String {
    match (three, std::env::consts::ARCH) {
        (false, "x86_64") => "linux64".to_owned(),
        (_, arch) => format!("{arch}-linux"),
    }
}

impl Archived {
    /// Reads an FMU.
    ///
    /// # Errors
    /// If it cannot be read, is not a regular file, is no ZIP archive with plain names of at most 1 GiB a
    /// file and 2 GiB in all, or has no model description for co-simulation, or no library for this machine.
    pub fn read(file: &Path) -> Result<Archived, FmuError> {
        let failed = |reason: String| FmuError::File { path: file.display().to_string(), reason };
        let read = text_file::read_bytes(file, MOST_TOTAL_BYTES);
        let bytes = read.map_err(|cause| failed(cause.to_string()))?;
        Archived::of(bytes).map_err(|error| match error {
            FmuError::File { reason, .. } => failed(reason),
            other => other,
        })
    }

    /// As [`Archived::read`], from the archive's bytes.
    ///
    /// # Errors
    /// As [`Archived::read`].
    pub fn of(bytes: Vec<u8>) -> Result<Archived, FmuError> {
        let entries = unzip::entries(&bytes)?;
        let description = entries.iter().find(|entry| entry.name == "modelDescription.xml");
        let description = description.ok_or_else(|| malformed("no modelDescription.xml"))?;
        if description.size > model::MOST_TEXT_BYTES {
            return Err(malformed("modelDescription.xml is longer than 64 MiB"));
        }
        let text = String::from_utf8(unzip::content(&bytes, description)?)
            .map_err(|_| malformed("modelDescription.xml is not UTF-8"))?;
        let model = ForeignModel::parse(&text)?;
        let library = model.library();
        if !entries.iter().any(|entry| entry.name == library) {
            return Err(malformed(format!("no {library}: it has no library for this machine")));
        }
        Ok(Archived { model, bytes, entries })
    }

    /// Returns the names and contents of all files.
    pub fn files(&self) -> impl Iterator<Item = (&str, Result<Vec<u8>, FmuError>)> {
        self.entries.iter().map(|entry| (entry.name.as_str(), unzip::content(&self.bytes, entry)))
    }

    /// Writes the libraries for this machine and the resources into an empty folder.
    ///
    /// # Errors
    /// If a file is damaged or cannot be written.
    pub fn extract(&self, folder: &Path) -> Result<(), FmuError> {
        let libraries = format!("binaries/{}/", folder_of(self.model.three));
        std::fs::create_dir_all(folder.join("resources")).map_err(malformed)?;
        for entry in &self.entries {
            let wanted = entry.name.starts_with(&libraries) || entry.name.starts_with("resources/");
            if !wanted || entry.name.ends_with('/') {
                continue;
            }
            let path: PathBuf = folder.join(&entry.name);
            let parent = path.parent().unwrap_or(folder);
            std::fs::create_dir_all(parent).map_err(malformed)?;
            std::fs::write(&path, unzip::content(&self.bytes, entry)?).map_err(malformed)?;
        }
        Ok(())
    }
}
