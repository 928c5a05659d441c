//! Files that a command leaves behind: whole and on the disk under their names, or not there, and never over another.
//!
//! A file is written as a draft in its folder, brought to the disk, given its name, and then its folder is brought to the disk too:
//! whoever finds the name finds the whole file, also after the machine has lost its power. A name that something else has is not
//! taken, also if it was free when the command began. A command that fails or is killed leaves nothing of a file that is not whole:
//! a draft has no name (`O_TMPFILE`) and goes with its process. Only on file systems that have no such files (NFS, FAT) a killed
//! command leaves its drafts as hidden files `.trabecula-unfinished-…`, which whoever likes may remove.
//!
//! What a close could say of a full or broken disk, `fsync` has said before.
//!
//! **Boundary:** whole files of commands; what is written while others read it (the logs of a run) has its own writer. **Invariant:** it
//! replaces nothing but what it has written itself.
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

/// Beginning of the names of drafts that have one.
pub const DRAFT_PREFIX: &str = ".trabecula-unfinished-";

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
    /// Bytes of a file cannot be written.
    pub fn write(path: &Path) -> impl FnOnce(io::Error) -> OutputError + '_ {
        move |source| OutputError::Write { path: path.into(), source }
    }
}

/// Refuses if one of the files is there, as whatever it may be: also as a link that leads nowhere.
///
/// # Errors
/// [`OutputError::Exists`] of the first one that is there.
pub fn refuse_existing<P: AsRef<Path>>(files: &[P]) -> Result<(), OutputError> {
    match files.iter().find(|file| file.as_ref().symlink_metadata().is_ok()) {
        Some(file) => Err(OutputError::Exists { path: file.as_ref().to_owned() }),
        None => Ok(()),
    }
}

/// A file being written. Dropped before it has its name it leaves nothing.
#[derive(Debug)]
pub struct OutputFile {
    draft: Draft,
    path: PathBuf,
}

impl OutputFile {
    /// Begins a file.
    ///
    /// # Errors
    /// [`OutputError::Exists`], [`OutputError::Create`].
    pub fn create(path: &Path) -> Result<OutputFile, OutputError> {
        // Asked now too, so that nobody waits for hours to be told.
        refuse_existing(&[path])?;
        OutputFile::begin(path)
    }

    fn begin(path: &Path) -> Result<OutputFile, OutputError> {
        let cannot = |source| OutputError::Create { path: path.into(), source };
        if path.file_name().is_none() {
            return Err(cannot(io::Error::new(ErrorKind::InvalidInput, "it names no file")));
        }
        let draft = Draft::begin(folder_of(path)).map_err(cannot)?;
        Ok(OutputFile { draft, path: path.into() })
    }

    /// A second handle to write through.
    ///
    /// # Errors
    /// The system has none to give.
    pub fn handle(&self) -> Result<File, OutputError> {
        self.draft.file().try_clone().map_err(OutputError::write(&self.path))
    }

    /// Brings the file to the disk.
    ///
    /// # Errors
    /// [`OutputError::Write`]: then there is no file.
    pub fn finish(self) -> Result<WholeFile, OutputError> {
        let OutputFile { draft, path } = self;
        sync_file(draft.file()).map_err(OutputError::write(&path))?;
        Ok(WholeFile { draft, path })
    }

    /// Brings the file to the disk and gives it its name.
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

/// A file that is whole and on the disk, and has not its name yet. Dropped it leaves nothing.
#[derive(Debug)]
pub struct WholeFile {
    draft: Draft,
    path: PathBuf,
}

impl WholeFile {
    /// Where this process can read it until it is kept.
    pub fn draft(&self) -> PathBuf {
        self.draft.path()
    }

    /// Where it will lie.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Gives the file its name, and brings that to the disk.
    ///
    /// # Errors
    /// [`OutputError::Exists`]; [`OutputError::Write`], what the system says: then there is no new file, or it may be gone if the
    /// machine loses its power.
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

/// Gives files their names: all of them, or none if one of the names is taken. Should one be taken in that very moment, the files
/// before it stay, each whole.
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

/// Writes a whole file.
///
/// # Errors
/// Any [`OutputError`]: then what was there is there still.
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
        // One that came meanwhile, and a link that leads nowhere.
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

    /// The name was asked for at the start, and then taken whatever had come there.
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
        // As the file system has it, and as one that has no files without a name.
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
