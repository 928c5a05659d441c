use std::path::{Path, PathBuf};
use std::time::Duration;

use ipc_types::ports::PortError;
use ipc_types::scene::SceneError;
use ipc_types::session::{SearchedPlaces, SessionError, host_is_alive};
use thiserror::Error;

/// Why a client call fails.
#[derive(Debug, Error)]
pub enum ClientError {
    /// The session cannot be joined, or one of its ports cannot be opened.
    #[error(transparent)]
    Session(SessionError),
    /// The session's scene cannot be read.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// A message cannot be sent or received.
    #[error(transparent)]
    Port(#[from] PortError),
    /// No session was announced in time.
    #[error("{searched}")]
    NoSession {
        /// The places searched.
        searched: SearchedPlaces,
    },
    /// The program's declaration of a message differs from this library's.
    #[error(
        "{message}: layout mismatch: this program was built with {given}, libtrabecula_client {version} has \
         {ours}; build both from the same version"
    )]
    Layout {
        /// Message.
        message: String,
        /// Layout the program was built with.
        given: String,
        /// Layout in this library.
        ours: String,
        /// Version of the library.
        version: &'static str,
    },
    /// The session was found but cannot be joined in this way.
    #[error("session {folder}: {cause}")]
    Joining {
        /// Session folder.
        folder: PathBuf,
        /// Cause.
        cause: Box<ClientError>,
    },
    /// The scene does not determine which controller to use.
    #[error("no controller given, and the scene has {external} external ones; choose one of: {known}")]
    WhichController {
        /// Number of external controllers.
        external: usize,
        /// Names in the scene.
        known: String,
    },
    /// An observer sends no commands.
    #[error("this client is an observer and cannot send commands; give a controller name when connecting")]
    Observer,
    /// The scene has no X-ray.
    #[error("the scene has no `[drr]`, so there are no frames")]
    NoDrr,
    /// The scene has no bone.
    #[error("the scene has no `[volume]`")]
    NoVolume,
    /// A request for a frame was refused.
    #[error("frame request {request_id} was {how}; see the session's events")]
    FrameRefused {
        /// The request.
        request_id: u64,
        /// `refused` or `busy`.
        how: &'static str,
    },
    /// Run control refused an action.
    #[error("run control refused action {action} (a step needs a paused run; actions are 1 to 6)")]
    ControlRefused {
        /// The action.
        action: u32,
    },
    /// The text of an event is not UTF-8, there is no command to send, or a message is malformed.
    #[error("{0}")]
    Misuse(&'static str),
    /// A number is invalid.
    #[error("`{name}` is {value}, expected {expected}")]
    BadArgument {
        /// Argument.
        name: &'static str,
        /// Its value.
        value: f64,
        /// Allowed values.
        expected: &'static str,
    },
    /// A `fork` child uses its parent's client.
    #[error(
        "this client belongs to the parent of this forked process; connect a new one here \
         (Python's `multiprocessing`: start method `spawn`, or connect in the child)"
    )]
    Forked,
    /// The run is over.
    #[error("the run has ended")]
    Ended,
    /// The hub is gone without announcing the end of the run.
    #[error("the hub of session {folder} is gone")]
    HubGone {
        /// Session folder.
        folder: PathBuf,
    },
    /// Nothing arrived in time.
    #[error("timed out: nothing arrived within {:.3} s", .0.as_secs_f64())]
    TimedOut(Duration),
}

impl ClientError {
    /// Adds the session to an error that does not name it. A session that is removed while it is being joined
    /// counts as not found.
    pub(crate) fn of(self, folder: &Path) -> ClientError {
        match self {
            ClientError::Session(SessionError::Transported { .. }) if !host_is_alive(folder) => {
                ClientError::NoSession { searched: SearchedPlaces::folder(folder) }
            }
            ClientError::WhichController { .. }
            | ClientError::Session(
                SessionError::UnknownController { .. }
                | SessionError::ControllerTaken { .. }
                | SessionError::Crowded { .. },
            ) => ClientError::Joining { folder: folder.to_owned(), cause: Box::new(self) },
            other => other,
        }
    }
}

impl From<SessionError> for ClientError {
    fn from(error: SessionError) -> ClientError {
        match error {
            // A session that disappears while being joined counts as not found.
            SessionError::NoSession { searched } => ClientError::NoSession { searched },
            other => ClientError::Session(other),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Such an error must not be reported as a service that cannot be opened (`DoesNotExist`).
    #[test]
    fn a_session_that_is_cleared_away_while_it_is_joined_is_no_session() {
        let cause = SessionError::Transported {
            service: "state".to_owned(),
            action: "opening",
            cause: "DoesNotExist".to_owned(),
        };
        let gone = Path::new("/nowhere/AAAAAAAAAAA");
        let error = ClientError::Session(cause).of(gone);
        assert!(matches!(&error, ClientError::NoSession { .. }), "{error:?}");
        assert!(error.to_string().contains("/nowhere/AAAAAAAAAAA"), "{error}");
    }
}
