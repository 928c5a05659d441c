//! Why a session cannot be made or joined.

use std::io;
use std::path::{Path, PathBuf};

use thiserror::Error;

use super::ICEORYX2_VERSION;
use super::id::SessionId;
use super::places::{Searched, Unfit};
use crate::messages::Part;
use crate::shared_memory::{Short, refusal};

/// Why a session could not be made or joined.
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
    /// No session is at this place.
    #[error("{searched}")]
    NoSession {
        /// Where it was looked for.
        searched: Searched,
    },
    /// No session has, or will ever have, such a name.
    #[error(
        "`{given}` can be no session: the name of a session, and of its folder, is {} letters and digits, as `trabecula run` prints it",
        SessionId::LENGTH
    )]
    NotASession {
        /// What was given.
        given: String,
    },
    /// Somebody else could read or change the sessions in this folder.
    #[error(
        "{path}: {cause}; sessions lie in a folder of this user's own that only this user may enter: remove this one, or set \
         XDG_RUNTIME_DIR to one that is"
    )]
    Unfit {
        /// The folder.
        path: PathBuf,
        /// What is wrong with it.
        cause: Unfit,
    },
    /// A session needs a name that nobody can guess.
    #[error(
        "the system's generator of random numbers cannot be read ({cause}); a session needs a random name"
    )]
    NoRandomness {
        /// The system's reason.
        cause: String,
    },
    /// The hub speaks another version of the transport.
    #[error(
        "the hub of {path} uses iceoryx2 {theirs}, this program {ICEORYX2_VERSION}; build both from one version"
    )]
    Transport {
        /// Session folder.
        path: PathBuf,
        /// The hub's version.
        theirs: String,
    },
    /// The hub is of another version.
    #[error(
        "the hub of {path} is Trabecula {theirs}, this program is {}; build both from one version",
        env!("CARGO_PKG_VERSION")
    )]
    Version {
        /// Session folder.
        path: PathBuf,
        /// The hub's version.
        theirs: String,
    },
    /// A service has another layout than this program was built with.
    #[error(
        "service `{service}`: the hub's {message} has layout {theirs}, this program was built with {ours}; build both from one version"
    )]
    Layout {
        /// Service name.
        service: String,
        /// Message name.
        message: &'static str,
        /// Layout hash of the hub.
        theirs: String,
        /// Layout hash of this program.
        ours: String,
    },
    /// A port that belongs to a part of the hub.
    #[error("service `{service}` is written by {writers} alone, which this program is not")]
    Reserved {
        /// Service name.
        service: String,
        /// Who may write it.
        writers: String,
    },
    /// The session has this part already.
    #[error("{part} of this session is another program; there is one of each")]
    PartTaken {
        /// Which.
        part: Part,
    },
    /// The scene names no such controller.
    #[error("the scene has no controller `{name}`; it has: {known}")]
    UnknownController {
        /// Name asked for.
        name: String,
        /// Names of the scene.
        known: String,
    },
    /// Another controller already writes this service.
    #[error(
        "a controller named `{name}` is already connected to this session; a name drives one controller at a time"
    )]
    ControllerTaken {
        /// Its name.
        name: String,
    },
    /// No more programs can be connected to a service.
    #[error("service `{service}`: {limit} programs {what} it already, which is the most; end one of them")]
    Crowded {
        /// Service name.
        service: String,
        /// Whether they read or write.
        what: &'static str,
        /// How many there may be.
        limit: usize,
    },
    /// Shared memory is short.
    #[error(
        "/dev/shm: {bytes} bytes of shared memory for service `{service}` cannot be reserved ({cause}); free some or enlarge it"
    )]
    SharedMemory {
        /// Service name.
        service: String,
        /// Bytes asked for.
        bytes: u64,
        /// The system's reason.
        cause: io::Error,
    },
    /// Shared memory takes no files.
    #[error("/dev/shm: {action} of service `{service}` failed: {cause}")]
    NoSharedMemory {
        /// Service name.
        service: String,
        /// What was tried.
        action: &'static str,
        /// Why, and what to do.
        cause: String,
    },
    /// iceoryx2 refused something else.
    #[error("service `{service}`: {action} failed ({cause})")]
    Transported {
        /// Service name.
        service: String,
        /// What was tried.
        action: &'static str,
        /// iceoryx2's reason.
        cause: String,
    },
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

pub(crate) fn short_memory(service: &str) -> impl FnOnce(Short) -> SessionError + '_ {
    move |Short { bytes, cause }| SessionError::SharedMemory { service: service.to_owned(), bytes, cause }
}
