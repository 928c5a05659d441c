//! The main loop of a Rust controller.

use std::time::Duration;

use ipc_types::messages::{Command, State};

use crate::client::{Client, Connection};
use crate::error::ClientError;

/// Maximum wait for a state: a paused run publishes none, so the loop just polls again.
const LONGEST_WAIT: Duration = Duration::from_secs(1);

/// A controller. Closures with these two arguments implement it.
pub trait Controller {
    /// Answers a state. `command` has `sequence` and `state_tick` filled in and every mode at "none".
    fn step(&mut self, state: &State, command: &mut Command);
}

impl<F: FnMut(&State, &mut Command)> Controller for F {
    fn step(&mut self, state: &State, command: &mut Command) {
        self(state, command);
    }
}

/// Runs a controller until the run ends. Session and controller name come from the environment, or the only
/// running session is used ([`Connection::default`]).
///
/// # Errors
/// Any [`ClientError`] except [`ClientError::Ended`].
pub fn run(controller: impl Controller) -> Result<(), ClientError> {
    run_as(&Connection::default(), controller)
}

/// [`run`] with an explicit session and controller name.
///
/// # Errors
/// Same as [`run`].
pub fn run_as(connection: &Connection, mut controller: impl Controller) -> Result<(), ClientError> {
    let mut client = Client::connect(connection)?;
    loop {
        match client.answer(LONGEST_WAIT, |state, command| controller.step(state, command)) {
            Ok(()) | Err(ClientError::TimedOut(_)) => {}
            Err(ClientError::Ended) => return Ok(()),
            Err(other) => return Err(other),
        }
    }
}
