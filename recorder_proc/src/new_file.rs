//! Files that a command makes: never over another, and none left of a command that fails.

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

    /// The file is what it should be, or what it holds is worth having.
    pub fn keep(mut self) {
        self.0 = None;
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
