//! Files that a command leaves behind: whole and on the disk under their names, or not there.
//!
//! A file is written under a name of its own beside its place, brought to the disk, given its name, and then its folder is brought
//! to the disk too: whoever finds the name finds the whole file, also after the machine has lost its power. A command that
//! fails leaves nothing; one that is killed leaves at most a hidden `.trabecula-…` file.
//!
//! What a close could say of a full or broken disk, `fsync` has said before.

use std::fs::{File, Permissions};
use std::io::{self, ErrorKind, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use tempfile::NamedTempFile;

/// Beginning of the names under which files are written.
const DRAFT_PREFIX: &str = ".trabecula-";

/// Why there is no file.
#[derive(Debug, thiserror::Error)]
pub enum OutputError {
    /// Something has the name already.
    #[error("{}: is there already; name a file that is not", path.display())]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// The folder takes no file.
    #[error("{}: cannot be made ({source}); choose a writable folder", path.display())]
    Create {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// Bytes cannot be written or brought to the disk: full, over a quota, broken.
    #[error("{}: cannot be written ({source}); free space or choose another folder", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
}

impl OutputError {
    fn write(path: &Path) -> impl FnOnce(io::Error) -> OutputError + '_ {
        move |source| OutputError::Write { path: path.into(), source }
    }
}

/// What to do about a file that has the name already.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Existing {
    /// It stays, and there is no new one.
    Refuse,
    /// The new one takes its place at once; until then it stays whole. For files that are written again and again.
    Replace,
}

/// A file being written. Dropped without [`keep`](OutputFile::keep) it leaves nothing.
#[derive(Debug)]
pub struct OutputFile {
    draft: NamedTempFile,
    path: PathBuf,
    existing: Existing,
}

impl OutputFile {
    /// Begins a file.
    ///
    /// # Errors
    /// [`OutputError::Exists`], [`OutputError::Create`].
    pub fn create(path: &Path, existing: Existing) -> Result<OutputFile, OutputError> {
        // Asked now too, so that nobody waits for hours to be told.
        if existing == Existing::Refuse && path.symlink_metadata().is_ok() {
            return Err(OutputError::Exists { path: path.into() });
        }
        let cannot = |source| OutputError::Create { path: path.into(), source };
        if path.file_name().is_none() {
            return Err(cannot(io::Error::new(ErrorKind::InvalidInput, "it names no file")));
        }
        let mut builder = tempfile::Builder::new();
        // As any program's files: what the umask leaves of it.
        let builder = builder.prefix(DRAFT_PREFIX).permissions(Permissions::from_mode(0o666));
        let draft = builder.tempfile_in(folder_of(path)).map_err(|cause| cannot(plain(cause)))?;
        Ok(OutputFile { draft, path: path.into(), existing })
    }

    /// Where it lies until it is kept: what has been written can be read there.
    pub fn draft(&self) -> &Path {
        self.draft.path()
    }

    /// A second handle to write through.
    ///
    /// # Errors
    /// The system has none to give.
    pub fn handle(&self) -> Result<File, OutputError> {
        self.draft.as_file().try_clone().map_err(OutputError::write(&self.path))
    }

    /// Brings the file to the disk, gives it its name, and brings that to the disk.
    ///
    /// # Errors
    /// [`OutputError::Write`], [`OutputError::Exists`]: then there is no new file.
    pub fn keep(self) -> Result<(), OutputError> {
        let OutputFile { draft, path, existing } = self;
        sync_file(draft.as_file()).map_err(OutputError::write(&path))?;
        let named = match existing {
            Existing::Refuse => draft.persist_noclobber(&path),
            Existing::Replace => draft.persist(&path),
        };
        named.map_err(|failed| match failed.error.kind() {
            ErrorKind::AlreadyExists => OutputError::Exists { path: path.clone() },
            _ => OutputError::Write { path: path.clone(), source: plain(failed.error) },
        })?;
        sync_folder(folder_of(&path)).map_err(OutputError::write(&path))
    }
}

impl Write for OutputFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.draft.as_file_mut().write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.draft.as_file_mut().flush()
    }
}

/// Writes a whole file.
///
/// # Errors
/// Any [`OutputError`]: then what was there is there still.
pub fn write(path: &Path, bytes: impl AsRef<[u8]>, existing: Existing) -> Result<(), OutputError> {
    let mut file = OutputFile::create(path, existing)?;
    file.write_all(bytes.as_ref()).map_err(OutputError::write(path))?;
    file.keep()
}

/// Makes a folder and what is missing above it, all on the disk.
///
/// # Errors
/// The system's.
pub fn create_folder(path: &Path) -> io::Result<()> {
    let missing: Vec<&Path> =
        path.ancestors().filter(|folder| *folder != Path::new("")).take_while(|f| !f.exists()).collect();
    std::fs::create_dir_all(path)?;
    missing.into_iter().try_for_each(|made| sync_folder(folder_of(made)))
}

/// Brings a file to the disk. What has no disk (a pipe, a device) has nothing to bring there.
///
/// # Errors
/// The system's.
pub fn sync_file(file: &File) -> io::Result<()> {
    match file.sync_all() {
        Err(cause) if cause.raw_os_error() == Some(rustix::io::Errno::INVAL.raw_os_error()) => Ok(()),
        outcome => outcome,
    }
}

/// Brings the names in a folder to the disk.
///
/// # Errors
/// The system's.
pub fn sync_folder(folder: &Path) -> io::Result<()> {
    sync_file(&File::open(folder)?)
}

/// The folder that a file lies in.
pub fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|folder| *folder != Path::new("")).unwrap_or(Path::new("."))
}

/// The system's reason without the name of the draft, which means nothing to whoever reads it.
fn plain(cause: io::Error) -> io::Error {
    match cause.get_ref().and_then(|inner| inner.source()).and_then(|inner| inner.downcast_ref::<io::Error>())
    {
        Some(source) => source.raw_os_error().map_or(source.kind().into(), io::Error::from_raw_os_error),
        None => cause.kind().into(),
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        let entries = std::fs::read_dir(folder).unwrap().flatten();
        let mut names: Vec<String> =
            entries.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect();
        names.sort();
        names
    }

    #[test]
    fn a_file_that_is_there_is_never_written_over() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        write(&path, "first", Existing::Refuse).unwrap();
        assert!(matches!(write(&path, "second", Existing::Refuse), Err(OutputError::Exists { .. })));
        // One that came meanwhile, and a link that leads nowhere.
        let late = folder.path().join("late");
        let file = OutputFile::create(&late, Existing::Refuse).unwrap();
        std::fs::write(&late, "other").unwrap();
        assert!(matches!(file.keep(), Err(OutputError::Exists { .. })));
        let link = folder.path().join("link");
        symlink(folder.path().join("nowhere"), &link).unwrap();
        assert!(matches!(write(&link, "x", Existing::Refuse), Err(OutputError::Exists { .. })));
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "first");
        assert_eq!(std::fs::read_to_string(&late).unwrap(), "other");
        assert_eq!(names(folder.path()), ["a", "late", "link"]);
    }

    #[test]
    fn nothing_half_written_has_the_name() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        let mut file = OutputFile::create(&path, Existing::Refuse).unwrap();
        file.write_all(b"half").unwrap();
        assert!(!path.exists() && std::fs::read(file.draft()).unwrap() == b"half");
        drop(file);
        assert_eq!(names(folder.path()), Vec::<String>::new());
        // The old one stays whole until the new one is.
        write(&path, "old", Existing::Replace).unwrap();
        let mut file = OutputFile::create(&path, Existing::Replace).unwrap();
        file.write_all(b"new and longer").unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "old");
        file.keep().unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "new and longer");
        assert_eq!(names(folder.path()), ["a"]);
    }

    #[test]
    fn files_have_the_mode_that_the_umask_leaves() {
        let folder = tempfile::tempdir().unwrap();
        write(&folder.path().join("ours"), "", Existing::Refuse).unwrap();
        std::fs::write(folder.path().join("anybodys"), "").unwrap();
        let mode = |name: &str| folder.path().join(name).metadata().unwrap().permissions().mode();
        assert_eq!(mode("ours"), mode("anybodys"));
    }

    #[test]
    fn a_reason_names_the_file_and_not_its_draft() {
        let error = write(Path::new("/proc/self/x"), "", Existing::Refuse).unwrap_err().to_string();
        assert!(
            error.starts_with("/proc/self/x: cannot be made (") && !error.contains(DRAFT_PREFIX),
            "{error}"
        );
    }

    #[test]
    fn folders_are_made_with_what_is_missing_above() {
        let folder = tempfile::tempdir().unwrap();
        let deep = folder.path().join("a/b/c");
        create_folder(&deep).unwrap();
        create_folder(&deep).unwrap();
        assert!(deep.is_dir());
        std::fs::write(folder.path().join("file"), "").unwrap();
        assert!(create_folder(&folder.path().join("file/below")).is_err());
    }
}
