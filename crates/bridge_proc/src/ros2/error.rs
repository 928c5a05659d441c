//! Errors of the ROS 2 bridge.

use thiserror::Error;
use trabecula_client::ClientError;

use crate::is_bad_input;

/// Why the bridge cannot start or continue.
#[derive(Debug, Error)]
pub enum Ros2Error {
    /// The session cannot be joined, or was lost.
    #[error(transparent)]
    Client(#[from] ClientError),
    /// DDS cannot create a participant, a topic, a publisher or a subscription.
    #[error("DDS domain {domain}: {what}: {cause}")]
    Dds {
        /// The domain.
        domain: u16,
        /// What could not be created.
        what: String,
        /// The reason.
        cause: String,
    },
    /// `--lockstep` with a run in real time.
    #[error("--lockstep: session {0} runs in real time; set `run.mode = \"lockstep\"` in its scene")]
    RealTime(String),
    /// `--lockstep` as a controller that no topic can command.
    #[error("--lockstep: controller `{0}` drives nothing that ROS 2 can command: arm, tendon, burr or tube")]
    NothingToDrive(String),
    /// The thread that publishes the bone cannot be started.
    #[error("starting a thread: {0}")]
    Thread(#[from] std::io::Error),
    /// The scene's tool cannot be described.
    #[error("robot_description: {0}")]
    Description(String),
}

impl Ros2Error {
    /// Returns whether the user's input is at fault: no session, an unknown controller.
    pub fn is_bad_input(&self) -> bool {
        match self {
            Ros2Error::Client(error) => is_bad_input(error),
            Ros2Error::RealTime(_) | Ros2Error::NothingToDrive(_) => true,
            Ros2Error::Dds { .. } | Ros2Error::Thread(_) | Ros2Error::Description(_) => false,
        }
    }
}
