//! Files that a command makes: never over another, none left of a command that fails, and on the disk when it succeeds.

use std::fs::File;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use crate::error::LogError;

/// A file that was made and is removed again unless it is kept.
#[derive(Debug)]
pub struct NewFile(Option<PathBuf>);

impl NewFile {
    /// Creates a file.
    ///
    /// # Errors
    /// [`LogError::Exists`], [`LogError::Create`].
    pub fn create(path: &Path) -> Result<(File, NewFile), LogError> {
        let file = File::create_new(path).map_err(|source| match source.kind() {
            ErrorKind::AlreadyExists => LogError::Exists { path: path.into() },
            _ => LogError::Create { path: path.into(), source },
        })?;
        Ok((file, NewFile(Some(path.into()))))
    }

    /// The file is what it should be, or what it holds is worth having: it and its name are brought to the disk.
    ///
    /// # Errors
    /// [`LogError::Write`]: what the disk says; then there is no file.
    pub fn keep(mut self) -> Result<(), LogError> {
        if let Some(path) = &self.0 {
            let synced = File::open(path).and_then(|file| output_file::sync_file(&file));
            let synced = synced.and_then(|()| output_file::sync_folder(output_file::folder_of(path)));
            synced.map_err(|source| LogError::Write { path: path.clone(), source })?;
        }
        self.0 = None;
        Ok(())
    }
}

impl Drop for NewFile {
    fn drop(&mut self) {
        if let Some(path) = &self.0 {
            // Nobody is left to be told.
            let _ = std::fs::remove_file(path);
        }
    }
}
