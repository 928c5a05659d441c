//! Why the bridge ends otherwise than with its session.

use std::net::SocketAddr;

use thiserror::Error;
use trabecula_client::ClientError;

/// Why the bridge cannot start or go on.
#[derive(Debug, Error)]
pub enum IgtlError {
    /// The session cannot be joined, or was lost.
    #[error(transparent)]
    Client(#[from] ClientError),
    /// The address cannot be listened at.
    #[error("cannot listen at {address}: {cause}; --port names another port")]
    Listen {
        /// The address.
        address: SocketAddr,
        /// The operating system's reason.
        cause: std::io::Error,
    },
}

impl IgtlError {
    /// Whether the user's input is at fault: no session, a controller that is not there, a port in use.
    pub fn is_bad_input(&self) -> bool {
        match self {
            IgtlError::Listen { .. } => true,
            IgtlError::Client(error) => matches!(
                error,
                ClientError::NoSession { .. } | ClientError::Joining { .. } | ClientError::Session(_)
            ),
        }
    }
}
