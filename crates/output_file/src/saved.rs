//! Files that are saved repeatedly.

use std::fs::Metadata;
use std::io::{self, ErrorKind, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use rustix::fs::{CWD, RenameFlags, renameat_with};
use rustix::io::Errno;

use crate::draft::plain;
use crate::{OutputError, OutputFile, WholeFile, folder_of, refuse_existing, sync_folder};

/// A file that is saved again whenever there is more to record, always atomically. It replaces only its own
/// last version.
#[derive(Debug)]
pub struct SavedFile {
    path: PathBuf,
    /// The last version saved.
    ours: Option<Identity>,
}

/// Distinguishes a file from another with the same name, and from itself with other content.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Identity {
    device: u64,
    inode: u64,
    bytes: u64,
    modified: (i64, i64),
}

impl Identity {
    fn of(path: &Path) -> io::Result<Identity> {
        path.symlink_metadata().map(|found| Identity::from(&found))
    }
}

impl From<&Metadata> for Identity {
    fn from(found: &Metadata) -> Identity {
        Identity {
            device: found.dev(),
            inode: found.ino(),
            bytes: found.len(),
            modified: (found.mtime(), found.mtime_nsec()),
        }
    }
}

impl SavedFile {
    /// A file with nothing saved yet.
    ///
    /// # Errors
    /// [`OutputError::Exists`].
    pub fn create(path: &Path) -> Result<SavedFile, OutputError> {
        refuse_existing(&[path])?;
        Ok(SavedFile { path: path.into(), ours: None })
    }

    /// Saves the file. The previous version stays whole until then.
    ///
    /// # Errors
    /// Any [`OutputError`], with the existing file unchanged. [`OutputError::Exists`] if that is not the last
    /// version saved.
    pub fn save(&mut self, bytes: impl AsRef<[u8]>) -> Result<(), OutputError> {
        let mut file = OutputFile::begin(&self.path)?;
        file.write_all(bytes.as_ref()).map_err(OutputError::write(&self.path))?;
        let whole = file.finish()?;
        let identity = whole.draft.file().metadata().map_err(OutputError::write(&self.path))?;
        match &self.ours {
            None => whole.keep()?,
            Some(ours) => replace(whole, ours)?,
        }
        self.ours = Some(Identity::from(&identity));
        Ok(())
    }
}

impl SavedFile {
    /// Removes the last version saved, and no other file with that name.
    ///
    /// # Errors
    /// The system's error.
    pub fn remove(self) -> io::Result<()> {
        match self.ours {
            Some(ours) if Identity::of(&self.path).ok() == Some(ours) => std::fs::remove_file(&self.path),
            _ => Ok(()),
        }
    }
}

/// Replaces our last version. Swaps first and then checks what was swapped out, so that no other program can
/// interfere in between.
fn replace(file: WholeFile, ours: &Identity) -> Result<(), OutputError> {
    let WholeFile { draft, path } = file;
    let draft = draft.into_named(&path).map_err(OutputError::write(&path))?;
    let exists = || OutputError::Exists { path: path.clone() };
    let exchange = |draft: &Path| renameat_with(CWD, draft, CWD, &path, RenameFlags::EXCHANGE);
    match exchange(&draft) {
        // The old version is now in the draft's place and is removed with it.
        Ok(()) if Identity::of(&draft).ok() == Some(*ours) => {}
        Ok(()) => {
            if let Err(cause) = exchange(&draft) {
                // Another program's file: better kept under a draft's name than lost.
                let _ = draft.keep();
                return Err(OutputError::Write { path, source: cause.into() });
            }
            return Err(exists());
        }
        // Another program has removed the last version.
        Err(Errno::NOENT) => {
            draft.persist_noclobber(&path).map_err(|failed| match failed.error.kind() {
                ErrorKind::AlreadyExists => exists(),
                _ => OutputError::Write { path: path.clone(), source: plain(failed.error) },
            })?;
        }
        // File systems without exchange: check, then replace immediately.
        Err(Errno::INVAL | Errno::NOSYS | Errno::OPNOTSUPP) => {
            if Identity::of(&path).ok() != Some(*ours) {
                return Err(exists());
            }
            let named = draft.persist(&path);
            named.map_err(|failed| OutputError::Write { path: path.clone(), source: plain(failed.error) })?;
        }
        Err(cause) => return Err(OutputError::Write { path, source: cause.into() }),
    }
    sync_folder(folder_of(&path)).map_err(OutputError::write(&path))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text(path: &Path) -> String {
        std::fs::read_to_string(path).unwrap()
    }

    #[test]
    fn what_was_saved_is_replaced_and_nothing_is_left_of_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        let mut file = SavedFile::create(&path).unwrap();
        for content in ["one", "two", "three"] {
            file.save(content).unwrap();
            assert_eq!(text(&path), content);
        }
        std::fs::remove_file(&path).unwrap();
        file.save("again").unwrap();
        assert_eq!(text(&path), "again");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    /// Only the last version may be replaced, not anything that has taken its name since.
    #[test]
    fn what_somebody_put_in_the_place_of_a_saved_file_stays() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        assert!(matches!(SavedFile::create(folder.path()), Err(OutputError::Exists { .. })));
        let mut early = SavedFile::create(&path).unwrap();
        std::fs::write(&path, "first").unwrap();
        assert!(matches!(early.save("ours"), Err(OutputError::Exists { .. })));
        assert_eq!(text(&path), "first");
        std::fs::remove_file(&path).unwrap();
        let mut file = SavedFile::create(&path).unwrap();
        file.save("ours").unwrap();
        // Another file, one of the same length, our own with a line added, and a folder.
        let other = folder.path().join("other");
        std::fs::write(&other, "mine").unwrap();
        std::fs::rename(&other, &path).unwrap();
        assert!(matches!(file.save("more"), Err(OutputError::Exists { .. })));
        assert_eq!(text(&path), "mine");
        std::fs::remove_file(&path).unwrap();
        file.save("ours").unwrap();
        std::fs::write(&path, "ours and mine").unwrap();
        assert!(matches!(file.save("more"), Err(OutputError::Exists { .. })));
        assert_eq!(text(&path), "ours and mine");
        std::fs::remove_file(&path).unwrap();
        std::fs::create_dir(&path).unwrap();
        assert!(matches!(file.save("more"), Err(OutputError::Exists { .. })));
        assert!(path.is_dir());
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }
}
