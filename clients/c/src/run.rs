//! The loop of a Rust controller.

use std::time::Duration;

use ipc_types::messages::{Command, State};

use crate::client::{Client, Connection};
use crate::error::ClientError;

/// Longest silence of a run that goes on: a paused run publishes nothing, so the loop only looks again.
const LOOK_TIME: Duration = Duration::from_secs(1);

/// What a controller does. A closure of these two arguments is one.
pub trait Controller {
    /// Answers a state. `command` comes with `sequence` and `state_tick` filled in and every mode at "none".
    fn step(&mut self, state: &State, command: &mut Command);
}

impl<F: FnMut(&State, &mut Command)> Controller for F {
    fn step(&mut self, state: &State, command: &mut Command) {
        self(state, command);
    }
}

/// Runs a controller in the session and under the name that the environment or the newest session gives, to the end of
/// the run ([`Connection::default`]).
///
/// # Errors
/// Any [`ClientError`] but [`ClientError::Ended`].
pub fn run(controller: impl Controller) -> Result<(), ClientError> {
    run_as(&Connection::default(), controller)
}

/// The same with a session and a name of its own.
///
/// # Errors
/// As [`run`].
pub fn run_as(connection: &Connection, mut controller: impl Controller) -> Result<(), ClientError> {
    let mut client = Client::connect(connection)?;
    loop {
        match client.answer(LOOK_TIME, |state, command| controller.step(state, command)) {
            Ok(()) | Err(ClientError::TimedOut(_)) => {}
            Err(ClientError::Ended) => return Ok(()),
            Err(other) => return Err(other),
        }
    }
}
