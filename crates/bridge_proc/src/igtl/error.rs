//! Errors of the OpenIGTLink bridge.

use std::net::SocketAddr;

use thiserror::Error;
use trabecula_client::ClientError;

use crate::is_bad_input;

/// Why the bridge cannot start or continue.
#[derive(Debug, Error)]
pub enum IgtlError {
    /// The session cannot be joined, or was lost.
    #[error(transparent)]
    Client(#[from] ClientError),
    /// The port cannot be opened.
    #[error("cannot listen on {address}: {cause}; choose another port with --port")]
    Listen {
        /// The address.
        address: SocketAddr,
        /// The operating system's reason.
        cause: std::io::Error,
    },
}

impl IgtlError {
    /// Returns whether the user's input is at fault: no session, an unknown controller, a port in use.
    pub fn is_bad_input(&self) -> bool {
        match self {
            IgtlError::Listen { .. } => true,
            IgtlError::Client(error) => is_bad_input(error),
        }
    }
}
