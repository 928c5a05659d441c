//! Drafts: files being written, unnamed if the file system supports that.

use std::fs::{File, Permissions};
use std::io;
use std::os::fd::AsRawFd;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use rustix::fs::{AtFlags, CWD, Mode, OFlags, linkat, openat};
use tempfile::TempPath;

use crate::{DRAFT_PREFIX, folder_of};

/// The default mode of new files, subject to the umask.
const MODE: u32 = 0o666;

/// A file that vanishes with its process unless it is given a name.
#[derive(Debug)]
pub struct Draft {
    file: File,
    /// The draft's file name, if it needs one; removed on drop.
    named: Option<TempPath>,
}

impl Draft {
    /// Creates a draft in a folder.
    pub fn begin(folder: &Path) -> io::Result<Draft> {
        let flags = OFlags::TMPFILE | OFlags::RDWR | OFlags::CLOEXEC;
        match openat(CWD, folder, flags, Mode::from_raw_mode(MODE)) {
            Ok(file) => Ok(Draft { file: file.into(), named: None }),
            // Fall back on any error: if the folder is at fault, the fallback reports it.
            Err(_) => Draft::begin_named(folder),
        }
    }

    /// Like [`begin`](Draft::begin), for file systems without unnamed files.
    pub fn begin_named(folder: &Path) -> io::Result<Draft> {
        let mut builder = tempfile::Builder::new();
        let builder = builder.prefix(DRAFT_PREFIX).permissions(Permissions::from_mode(MODE));
        let (file, named) = builder.tempfile_in(folder).map_err(plain)?.into_parts();
        Ok(Draft { file, named: Some(named) })
    }

    /// The file to write to.
    pub fn file(&self) -> &File {
        &self.file
    }

    /// Returns a path under which this process can read the draft.
    pub fn path(&self) -> PathBuf {
        match &self.named {
            Some(path) => path.to_path_buf(),
            None => format!("/proc/self/fd/{}", self.file.as_raw_fd()).into(),
        }
    }

    /// Gives the draft a name, which must be free.
    pub fn name(self, path: &Path) -> io::Result<()> {
        match self.named {
            Some(named) => named.persist_noclobber(path).map_err(|failed| plain(failed.error)),
            None => self.link(path),
        }
    }

    /// Gives the draft a temporary name in the folder of `path`.
    pub fn into_named(mut self, path: &Path) -> io::Result<TempPath> {
        match self.named.take() {
            Some(named) => Ok(named),
            None => {
                let mut builder = tempfile::Builder::new();
                let made = builder.prefix(DRAFT_PREFIX).make_in(folder_of(path), |name| self.link(name));
                Ok(made.map_err(plain)?.into_temp_path())
            }
        }
    }

    fn link(&self, path: &Path) -> io::Result<()> {
        Ok(linkat(CWD, self.path(), CWD, path, AtFlags::SYMLINK_FOLLOW)?)
    }
}

/// Returns the system's reason without the draft's name, which means nothing to the user.
pub fn plain(cause: io::Error) -> io::Error {
    match cause.get_ref().and_then(|inner| inner.source()).and_then(|inner| inner.downcast_ref::<io::Error>())
    {
        Some(source) => source.raw_os_error().map_or(source.kind().into(), io::Error::from_raw_os_error),
        None => cause.kind().into(),
    }
}
