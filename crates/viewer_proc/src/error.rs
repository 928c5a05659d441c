//! Why a viewer cannot start or run.

use std::net::SocketAddr;

use ipc_types::ports::PortError;
use ipc_types::scene::SceneError;
use ipc_types::session::{SearchedPlaces, SessionError};
use run_log::LogError;
use trabecula_client::ClientError;

use crate::log::file::PlayError;

/// What went wrong, and what to do about it.
#[derive(Debug, thiserror::Error)]
pub enum ViewerError {
    /// Cannot listen on the port.
    #[error(
        "{address}: cannot listen on this address: {cause}; choose another port with --port, \
         or 0 for any free one"
    )]
    Port {
        /// The requested address.
        address: SocketAddr,
        /// The system's reason.
        cause: std::io::Error,
    },
    /// No random numbers for the token.
    #[error("cannot create the control token from /dev/urandom: {0}")]
    Token(std::io::Error),
    /// The runtime or a thread cannot be started.
    #[error("the viewer cannot start a thread or its server: {0}")]
    Runtime(std::io::Error),
    /// No session to view.
    #[error("{0}; or give one with --session")]
    NoSession(SearchedPlaces),
    /// The session cannot be joined.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// Its scene cannot be read.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// A message cannot be received.
    #[error(transparent)]
    Message(#[from] PortError),
    /// An error of the viewer as a controller.
    #[error(transparent)]
    Client(#[from] ClientError),
    /// A log cannot be read.
    #[error(transparent)]
    Log(#[from] LogError),
    /// A log cannot be played.
    #[error(transparent)]
    Play(#[from] PlayError),
}

impl ViewerError {
    /// Whether the user made an invalid request, as opposed to a failure.
    pub fn is_bad_input(&self) -> bool {
        match self {
            ViewerError::Port { .. }
            | ViewerError::NoSession(_)
            | ViewerError::Play(_)
            | ViewerError::Scene(_)
            | ViewerError::Session(SessionError::NoSession { .. } | SessionError::NotASession { .. }) => true,
            ViewerError::Log(error) => error.is_bad_input(),
            _ => false,
        }
    }
}
