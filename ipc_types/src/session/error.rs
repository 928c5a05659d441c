//! Why a session cannot be created or joined.

use std::io;
use std::path::{Path, PathBuf};

use foreign_text::foreign_path;
use thiserror::Error;

use super::id::SessionId;
use super::places::{PlaceError, SearchedPlaces};
use super::{ICEORYX2_VERSION, SESSION_VARIABLE};
use crate::messages::Part;
use crate::shared_memory::{MemoryShortage, refusal};

/// Why a session could not be created or joined.
#[derive(Debug, Error)]
pub enum SessionError {
    /// A file or folder of the session could not be used.
    #[error("{path}: {cause}")]
    File {
        /// The path.
        path: PathBuf,
        /// The system's reason.
        cause: io::Error,
    },
    /// No session found.
    #[error("{searched}")]
    NoSession {
        /// The places searched.
        searched: SearchedPlaces,
    },
    /// Several sessions are running and none was named.
    #[error(
        "{} sessions are running: {}; select one with `--session`, `session=` or {SESSION_VARIABLE}",
        running.len(),
        listed(running)
    )]
    SeveralSessions {
        /// Their folders.
        running: Vec<PathBuf>,
    },
    /// Not a valid session name.
    #[error(
        "`{given}` cannot be a session: expected a session's folder, or its name of {} letters and digits, \
         as printed by `trabecula run`",
        SessionId::LENGTH
    )]
    NotASession {
        /// The name given.
        given: String,
    },
    /// Other users could read or change the sessions in this folder.
    #[error(
        "{path}: {cause}; sessions need a folder that belongs to this user and is closed to others: remove \
         this one, or set XDG_RUNTIME_DIR to such a folder"
    )]
    Unfit {
        /// The folder.
        path: PathBuf,
        /// The defect.
        cause: PlaceError,
    },
    /// No random numbers for an unguessable session name.
    #[error("cannot read random numbers from the system ({cause}); a session needs a random name")]
    NoRandomness {
        /// The system's reason.
        cause: String,
    },
    /// The hub uses another version of the transport.
    #[error(
        "the hub of {path} uses iceoryx2 {theirs}, this program {ICEORYX2_VERSION}; build both from the same \
         version"
    )]
    Transport {
        /// Session folder.
        path: PathBuf,
        /// The hub's version.
        theirs: String,
    },
    /// The hub has another version.
    #[error(
        "the hub of {path} is Trabecula {theirs}, this program is {}; build both from the same version",
        env!("CARGO_PKG_VERSION")
    )]
    Version {
        /// Session folder.
        path: PathBuf,
        /// The hub's version.
        theirs: String,
    },
    /// A service's layout differs from the one this program was built with.
    #[error(
        "service `{service}`: the hub's {message} has layout {theirs}, this program was built with {ours}; \
         build both from the same version"
    )]
    Layout {
        /// Service name.
        service: String,
        /// Message name.
        message: &'static str,
        /// The hub's layout hash.
        theirs: String,
        /// This program's layout hash.
        ours: String,
    },
    /// The port is reserved for a part of the hub.
    #[error("only {writers} may write to service `{service}`")]
    Reserved {
        /// Service name.
        service: String,
        /// Parts that may write to it.
        writers: String,
    },
    /// Another program has already claimed this part of the session.
    #[error("another program is already the {part} of this session")]
    PartTaken {
        /// The part.
        part: Part,
    },
    /// The scene has no such controller.
    #[error("the scene has no controller `{name}`; it has: {known}")]
    UnknownController {
        /// The name requested.
        name: String,
        /// Names in the scene.
        known: String,
    },
    /// Another program is already connected as this controller.
    #[error(
        "a controller named `{name}` is already connected to this session; only one can use the name at a \
         time"
    )]
    ControllerTaken {
        /// The controller's name.
        name: String,
    },
    /// The service has no free slot.
    #[error("service `{service}`: {limit} programs already {what} it, which is the limit; stop one of them")]
    Crowded {
        /// Service name.
        service: String,
        /// Whether they read or write.
        what: &'static str,
        /// Number of slots.
        limit: usize,
    },
    /// Not enough shared memory.
    #[error(
        "/dev/shm: {bytes} bytes of shared memory for service `{service}` cannot be reserved ({cause}); free \
         some space or enlarge /dev/shm"
    )]
    SharedMemory {
        /// Service name.
        service: String,
        /// Bytes requested.
        bytes: u64,
        /// The system's reason.
        cause: io::Error,
    },
    /// No file can be created in shared memory.
    #[error("/dev/shm: {action} of service `{service}` failed: {cause}")]
    NoSharedMemory {
        /// Service name.
        service: String,
        /// The failed action.
        action: &'static str,
        /// The reason, and what to do about it.
        cause: String,
    },
    /// Any other iceoryx2 error.
    #[error("service `{service}`: {action} failed ({cause})")]
    Transported {
        /// Service name.
        service: String,
        /// The failed action.
        action: &'static str,
        /// iceoryx2's reason.
        cause: String,
    },
}

/// Joins session folders into one text.
fn listed(folders: &[PathBuf]) -> String {
    folders.iter().map(|folder| foreign_path(folder).to_string()).collect::<Vec<_>>().join(", ")
}

pub(crate) fn file_error(path: &Path) -> impl FnOnce(io::Error) -> SessionError + '_ {
    move |cause| SessionError::File { path: path.to_owned(), cause }
}

pub(crate) fn transported<E: core::fmt::Debug>(
    service: &str,
    action: &'static str,
) -> impl FnOnce(E) -> SessionError {
    let service = service.to_owned();
    move |cause| match refusal() {
        Some(refused) => SessionError::NoSharedMemory { service, action, cause: refused.to_string() },
        None => SessionError::Transported { service, action, cause: format!("{cause:?}") },
    }
}

pub(crate) fn short_memory(service: &str) -> impl FnOnce(MemoryShortage) -> SessionError + '_ {
    move |MemoryShortage { bytes, cause }| SessionError::SharedMemory {
        service: service.to_owned(),
        bytes,
        cause,
    }
}
