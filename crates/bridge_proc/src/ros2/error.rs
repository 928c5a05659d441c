//! Why the bridge ends otherwise than with its session.

use thiserror::Error;
use trabecula_client::ClientError;

/// Why the bridge cannot start or go on.
#[derive(Debug, Error)]
pub enum Ros2Error {
    /// The session cannot be joined, or was lost.
    #[error(transparent)]
    Client(#[from] ClientError),
    /// DDS refuses a participant, a topic, a publisher or a subscription.
    #[error("DDS domain {domain}: {what}: {cause}")]
    Dds {
        /// The domain.
        domain: u16,
        /// What was to be made.
        what: String,
        /// The reason.
        cause: String,
    },
    /// The scene's tool cannot be described.
    #[error("robot_description: {0}")]
    Description(String),
}

impl Ros2Error {
    /// Whether the user's input is at fault: no session, a controller that is not there.
    pub fn is_bad_input(&self) -> bool {
        match self {
            Ros2Error::Client(error) => matches!(
                error,
                ClientError::NoSession { .. } | ClientError::Joining { .. } | ClientError::Session(_)
            ),
            Ros2Error::Dds { .. } | Ros2Error::Description(_) => false,
        }
    }
}
