//! Byte sources of logs.

use std::io::{Cursor, Read, Seek};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::error::LogError;

/// A readable, seekable byte source.
pub trait ReadSeek: Read + Seek + Send {}

impl<T: Read + Seek + Send> ReadSeek for T {}

/// A log that can be opened any number of times. This crate provides logs in memory ([`LogBytes`]); its users
/// provide logs in files.
pub trait LogSource {
    /// The log's name in error messages.
    fn path(&self) -> &Path;

    /// A new reader at the log's first byte.
    ///
    /// # Errors
    /// [`LogError::Open`].
    fn open(&self) -> Result<Box<dyn ReadSeek>, LogError>;
}

/// A log in memory.
#[derive(Debug, Clone)]
pub struct LogBytes {
    path: PathBuf,
    bytes: Arc<[u8]>,
}

impl LogBytes {
    /// Creates a log in memory with `path` as its name in error messages.
    pub fn new(path: impl Into<PathBuf>, bytes: impl Into<Arc<[u8]>>) -> LogBytes {
        LogBytes { path: path.into(), bytes: bytes.into() }
    }

    /// The whole log.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }
}

impl LogSource for LogBytes {
    fn path(&self) -> &Path {
        &self.path
    }

    fn open(&self) -> Result<Box<dyn ReadSeek>, LogError> {
        Ok(Box::new(Cursor::new(Arc::clone(&self.bytes))))
    }
}
