//! `trabecula docs`: documentation generated from the declarations of messages, scenes and commands.

use clap::{CommandFactory, Subcommand};
use clap_complete::Shell;
use ipc_types::reference::{every_message, message_reference};
use ipc_types::scene::reference::scene_reference;
use run_log::topics::schema_of;

use crate::cli::Arguments;
use crate::failure::Failure;
use crate::say;
use crate::scenes::BuiltIn;
use crate::tool;

/// What to print.
#[derive(Debug, Subcommand)]
pub enum DocsCommand {
    /// The message reference (docs/messages.md).
    Messages,
    /// The scene file reference (docs/scene.md).
    Scene,
    /// The `ros2msg` schema of a message, as stored in the logs.
    Schema {
        /// Message name, such as `State`.
        message: String,
    },
    /// Shell completions, for example `source <(trabecula docs completions bash)`.
    Completions {
        /// Shell.
        shell: Shell,
    },
    /// The man page, in roff: `trabecula docs man | man -l -`.
    Man,
}

/// Runs the command.
///
/// # Errors
/// No such message (2).
pub fn run(command: &DocsCommand) -> Result<(), Failure> {
    let text = match command {
        DocsCommand::Messages => message_reference(),
        DocsCommand::Scene => scene_reference() + &tool::reference(&BuiltIn::Femur.scene()?)?,
        DocsCommand::Schema { message } => schema(message)?,
        DocsCommand::Completions { shell } => completions(*shell),
        DocsCommand::Man => man_page()?,
    };
    say::verbatim(&text);
    Ok(())
}

fn completions(shell: Shell) -> String {
    let mut text = Vec::new();
    clap_complete::generate(shell, &mut Arguments::command(), "trabecula", &mut text);
    String::from_utf8_lossy(&text).into_owned()
}

/// The man page of the command, followed by one per subcommand.
fn man_page() -> Result<String, Failure> {
    let mut command = Arguments::command();
    command.build();
    let mut text = Vec::new();
    let failed = |cause: std::io::Error| Failure::failed(format!("cannot create the man page: {cause}"));
    clap_mangen::Man::new(command.clone()).render(&mut text).map_err(failed)?;
    for subcommand in command.get_subcommands().filter(|command| command.get_name() != "help") {
        clap_mangen::Man::new(subcommand.clone()).render(&mut text).map_err(failed)?;
    }
    Ok(String::from_utf8_lossy(&text).into_owned())
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
