//! Writes the files that a command leaves behind: each is complete and on disk under its name, or absent, and
//! none overwrites another.
//!
//! A file is written as a draft in its folder, synced to disk and given its name; then its folder is synced
//! too. If the name exists, so does the complete file, even after a power failure. An existing file stays
//! untouched, even if it appeared after the command began. A command that fails or is killed leaves no
//! incomplete file: a draft has no name (`O_TMPFILE`) and vanishes with its process. Only on file systems
//! without unnamed files (NFS, FAT) does a killed command leave its drafts, as hidden files
//! `.trabecula-unfinished-…`, which are safe to remove.
//!
//! Errors of close are not checked: `fsync` has already reported a full or broken disk.
//!
//! **Boundary:** complete files of commands; files that are read while they are written (the logs of a run)
//! have a separate writer. **Invariant:** it replaces only its own files.
//!
//! ```
//! let folder = tempfile::tempdir().unwrap();
//! let path = folder.path().join("summary.json");
//! output_file::write(&path, "{}").unwrap();
//! // What is there stays.
//! assert!(output_file::write(&path, "other").is_err());
//! assert_eq!(std::fs::read_to_string(&path).unwrap(), "{}");
//! ```

mod draft;
mod saved;

use std::fs::File;
use std::io::{self, ErrorKind, Write};
use std::path::{Path, PathBuf};

use draft::Draft;
pub use saved::SavedFile;

/// Prefix of the names of named drafts.
pub const DRAFT_PREFIX: &str = ".trabecula-unfinished-";

/// Why a file was not written.
#[derive(Debug, thiserror::Error)]
pub enum OutputError {
    /// The name is taken.
    #[error("{}: already exists; choose another name", path.display())]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// The file cannot be created in its folder.
    #[error("{}: cannot be created ({source}); choose a writable folder", path.display())]
    Create {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// Data cannot be written or synced: disk full, over quota, or broken.
    #[error("{}: cannot be written ({source}); free space or choose another folder", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
}

impl OutputError {
    /// Maps an error of writing a file.
    pub fn write(path: &Path) -> impl FnOnce(io::Error) -> OutputError + '_ {
        move |source| OutputError::Write { path: path.into(), source }
    }
}

/// Fails if any of these names is taken, by anything, including a dangling link, or cannot be a file name.
///
/// # Errors
/// [`OutputError::Exists`] or [`OutputError::Create`], for the first such name.
pub fn refuse_existing<P: AsRef<Path>>(files: &[P]) -> Result<(), OutputError> {
    files.iter().map(AsRef::as_ref).try_for_each(|file| match file.symlink_metadata() {
        Ok(_) => Err(OutputError::Exists { path: file.to_owned() }),
        // A name that is too long would otherwise be detected only when the file gets its name, after all
        // work.
        Err(source) if source.kind() == ErrorKind::InvalidFilename => {
            Err(OutputError::Create { path: file.to_owned(), source })
        }
        Err(_) => Ok(()),
    })
}

/// A file being written. If dropped before it has its name, it leaves nothing.
#[derive(Debug)]
pub struct OutputFile {
    draft: Draft,
    path: PathBuf,
}

impl OutputFile {
    /// Creates a file.
    ///
    /// # Errors
    /// [`OutputError::Exists`], [`OutputError::Create`].
    pub fn create(path: &Path) -> Result<OutputFile, OutputError> {
        // Also checked early, so that a long job does not fail only at its end.
        refuse_existing(&[path])?;
        OutputFile::begin(path)
    }

    fn begin(path: &Path) -> Result<OutputFile, OutputError> {
        let cannot = |source| OutputError::Create { path: path.into(), source };
        if path.file_name().is_none() {
            return Err(cannot(io::Error::new(ErrorKind::InvalidInput, "not a file name")));
        }
        let draft = Draft::begin(folder_of(path)).map_err(cannot)?;
        Ok(OutputFile { draft, path: path.into() })
    }

    /// Returns a second handle to write through.
    ///
    /// # Errors
    /// The system is out of file handles.
    pub fn handle(&self) -> Result<File, OutputError> {
        self.draft.file().try_clone().map_err(OutputError::write(&self.path))
    }

    /// Syncs the file to disk.
    ///
    /// # Errors
    /// [`OutputError::Write`]; then there is no file.
    pub fn finish(self) -> Result<WholeFile, OutputError> {
        let OutputFile { draft, path } = self;
        sync_file(draft.file()).map_err(OutputError::write(&path))?;
        Ok(WholeFile { draft, path })
    }

    /// Syncs the file to disk and gives it its name.
    ///
    /// # Errors
    /// As [`OutputFile::finish`] and [`WholeFile::keep`].
    pub fn keep(self) -> Result<(), OutputError> {
        self.finish()?.keep()
    }
}

impl Write for OutputFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.draft.file().write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.draft.file().flush()
    }
}

/// A file that is complete and synced but has no name yet. If dropped, it leaves nothing.
#[derive(Debug)]
pub struct WholeFile {
    draft: Draft,
    path: PathBuf,
}

impl WholeFile {
    /// Returns a path under which this process can read the file until it is kept.
    pub fn draft(&self) -> PathBuf {
        self.draft.path()
    }

    /// Returns the file's future path.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Gives the file its name and syncs the name to disk.
    ///
    /// # Errors
    /// [`OutputError::Exists`]; [`OutputError::Write`] with the system's reason, in which case there is no
    /// new file, or a power failure may remove it.
    pub fn keep(self) -> Result<(), OutputError> {
        keep_all(vec![self])
    }

    fn name(self) -> Result<PathBuf, OutputError> {
        let WholeFile { draft, path } = self;
        draft.name(&path).map_err(|cause| match cause.kind() {
            ErrorKind::AlreadyExists => OutputError::Exists { path: path.clone() },
            _ => OutputError::Write { path: path.clone(), source: cause },
        })?;
        Ok(path)
    }
}

/// Gives all files their names, or none if a name is taken. If a name is taken between the check and the
/// naming, the files before it stay, each complete.
///
/// # Errors
/// As [`WholeFile::keep`].
pub fn keep_all(files: Vec<WholeFile>) -> Result<(), OutputError> {
    refuse_existing(&files.iter().map(WholeFile::path).collect::<Vec<_>>())?;
    let named: Vec<PathBuf> = files.into_iter().map(WholeFile::name).collect::<Result<_, _>>()?;
    let mut synced: Option<&Path> = None;
    for path in &named {
        let folder = folder_of(path);
        if synced != Some(folder) {
            sync_folder(folder).map_err(OutputError::write(path))?;
        }
        synced = Some(folder);
    }
    Ok(())
}

/// Writes a complete file.
///
/// # Errors
/// Any [`OutputError`]; existing files are unchanged.
pub fn write(path: &Path, bytes: impl AsRef<[u8]>) -> Result<(), OutputError> {
    write_all(&[(path, bytes)])
}

/// Writes whole files that belong together: all of them, or none.
///
/// # Errors
/// As [`write()`] and [`keep_all`].
pub fn write_all<P: AsRef<Path>, B: AsRef<[u8]>>(files: &[(P, B)]) -> Result<(), OutputError> {
    let whole = files.iter().map(|(path, bytes)| {
        let path = path.as_ref();
        let mut file = OutputFile::create(path)?;
        file.write_all(bytes.as_ref()).map_err(OutputError::write(path))?;
        file.finish()
    });
    keep_all(whole.collect::<Result<_, _>>()?)
}

/// Creates a folder and its missing parents, and syncs them to disk.
///
/// # Errors
/// The system's error.
pub fn create_folder(path: &Path) -> io::Result<()> {
    let missing: Vec<&Path> =
        path.ancestors().filter(|folder| *folder != Path::new("")).take_while(|f| !f.exists()).collect();
    std::fs::create_dir_all(path)?;
    missing.into_iter().try_for_each(|made| sync_folder(folder_of(made)))
}

/// Syncs a file to disk. Pipes and devices have nothing to sync.
///
/// # Errors
/// The system's error.
pub fn sync_file(file: &File) -> io::Result<()> {
    match file.sync_all() {
        Err(cause) if cause.raw_os_error() == Some(rustix::io::Errno::INVAL.raw_os_error()) => Ok(()),
        outcome => outcome,
    }
}

/// Syncs the names in a folder to disk.
///
/// # Errors
/// The system's error.
pub fn sync_folder(folder: &Path) -> io::Result<()> {
    sync_file(&File::open(folder)?)
}

/// Returns the folder that contains a file.
pub fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|folder| *folder != Path::new("")).unwrap_or(Path::new("."))
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::{PermissionsExt, symlink};

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
        write(&path, "first").unwrap();
        assert!(matches!(write(&path, "second"), Err(OutputError::Exists { .. })));
        // A name taken in the meantime, and a dangling link.
        let late = folder.path().join("late");
        let file = OutputFile::create(&late).unwrap();
        std::fs::write(&late, "other").unwrap();
        assert!(matches!(file.keep(), Err(OutputError::Exists { .. })));
        let link = folder.path().join("link");
        symlink(folder.path().join("nowhere"), &link).unwrap();
        assert!(matches!(write(&link, "x"), Err(OutputError::Exists { .. })));
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "first");
        assert_eq!(std::fs::read_to_string(&late).unwrap(), "other");
        assert_eq!(names(folder.path()), ["a", "late", "link"]);
    }

    /// A name that was free at the start must not be overwritten if something takes it later.
    #[test]
    fn a_name_that_is_taken_behind_the_last_look_is_not_taken_over() {
        for begin in [Draft::begin, Draft::begin_named] {
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join("a");
            let whole =
                OutputFile { draft: begin(folder.path()).unwrap(), path: path.clone() }.finish().unwrap();
            std::fs::write(&path, "other").unwrap();
            assert!(matches!(whole.name(), Err(OutputError::Exists { .. })));
            assert_eq!(std::fs::read(&path).unwrap(), b"other");
            assert_eq!(names(folder.path()), ["a"]);
        }
    }

    #[test]
    fn nothing_half_written_has_the_name() {
        // With the file system's own support, and as if it had no unnamed files.
        for begin in [Draft::begin, Draft::begin_named] {
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join("a");
            let begin = || OutputFile { draft: begin(folder.path()).unwrap(), path: path.clone() };
            let mut file = begin();
            file.write_all(b"half").unwrap();
            assert!(names(folder.path()).iter().all(|name| name.starts_with(DRAFT_PREFIX)));
            drop(file);
            assert_eq!(names(folder.path()), Vec::<String>::new());
            let mut file = begin();
            file.write_all(b"whole").unwrap();
            let whole = file.finish().unwrap();
            assert!(!path.exists() && std::fs::read(whole.draft()).unwrap() == b"whole");
            whole.keep().unwrap();
            assert_eq!(std::fs::read(&path).unwrap(), b"whole");
            assert_eq!(names(folder.path()), ["a"]);
        }
    }

    #[test]
    fn files_that_belong_together_are_all_there_or_none() {
        let folder = tempfile::tempdir().unwrap();
        let [a, b, c] = ["a", "b", "c"].map(|name| folder.path().join(name));
        std::fs::write(&b, "other").unwrap();
        let all = [(&a, "1"), (&b, "2"), (&c, "3")];
        assert!(matches!(write_all(&all), Err(OutputError::Exists { path }) if path == b));
        assert_eq!(names(folder.path()), ["b"]);
        std::fs::remove_file(&b).unwrap();
        write_all(&all).unwrap();
        assert_eq!([a, b, c].map(|path| std::fs::read_to_string(path).unwrap()), ["1", "2", "3"]);
    }

    #[test]
    fn files_have_the_mode_that_the_umask_leaves() {
        let folder = tempfile::tempdir().unwrap();
        write(&folder.path().join("ours"), "").unwrap();
        std::fs::write(folder.path().join("anybodys"), "").unwrap();
        let mode = |name: &str| folder.path().join(name).metadata().unwrap().permissions().mode();
        assert_eq!(mode("ours"), mode("anybodys"));
    }

    #[test]
    fn a_reason_names_the_file_and_not_its_draft() {
        let error = write(Path::new("/proc/self/x"), "").unwrap_err().to_string();
        assert!(
            error.starts_with("/proc/self/x: cannot be created (") && !error.contains(DRAFT_PREFIX),
            "{error}"
        );
    }

    /// Regression: the system reported this only when the file got its name, after all work.
    #[test]
    fn a_name_that_is_too_long_is_refused_at_the_beginning() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a".repeat(256));
        for refused in [refuse_existing(&[&path]).unwrap_err(), OutputFile::create(&path).unwrap_err()] {
            assert!(matches!(refused, OutputError::Create { .. }), "{refused}");
        }
        write(&folder.path().join("a".repeat(255)), "").unwrap();
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
