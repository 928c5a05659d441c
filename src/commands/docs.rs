//! `trabecula docs messages|scene|schema`: what the declarations of messages and scenes say.

use std::io::{ErrorKind, Write, stdout};

use clap::Subcommand;
use ipc_types::reference::{every_message, message_reference};
use ipc_types::scene_reference::scene_reference;
use recorder_proc::topics::schema_of;

use crate::failure::Failure;

/// What to print.
#[derive(Debug, Subcommand)]
pub enum DocsCommand {
    /// The message reference, as in docs/messages.md.
    Messages,
    /// The reference of scene files, as in docs/scene.md.
    Scene,
    /// The `ros2msg` schema of a message, as it stands in the logs.
    Schema {
        /// Message, such as `State`.
        message: String,
    },
}

/// Runs the command.
///
/// # Errors
/// No such message (2).
pub fn run(command: &DocsCommand) -> Result<(), Failure> {
    let text = match command {
        DocsCommand::Messages => message_reference(),
        DocsCommand::Scene => scene_reference().map_err(|cause| Failure::failed(cause.to_string()))?,
        DocsCommand::Schema { message } => schema(message)?,
    };
    match stdout().write_all(text.as_bytes()) {
        // A reader that has had enough (`| head`) is no failure.
        Err(cause) if cause.kind() != ErrorKind::BrokenPipe => {
            Err(Failure::failed(format!("standard output: {cause}")))
        }
        _ => Ok(()),
    }
}

fn schema(message: &str) -> Result<String, Failure> {
    let all = every_message();
    match all.iter().find(|description| description.short_name() == message || description.name == message) {
        Some(description) => Ok(schema_of(description).1),
        None => {
            let known: Vec<&str> = all.iter().map(|description| description.short_name()).collect();
            Err(Failure::bad_input(format!("no message `{message}`; there are {}", known.join(", "))))
        }
    }
}
