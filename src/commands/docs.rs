//! `trabecula docs`: documentation generated from the declarations of messages, scenes and commands.

use std::path::{Path, PathBuf};

use clap::Subcommand;
use clap_complete::Shell;
use ipc_types::reference::{every_message, message_reference};
use ipc_types::scene::reference::scene_reference;
use run_log::schema_of;

use crate::cli::command_line;
use crate::failure::Failure;
use crate::output::refuse_existing;
use crate::say;
use crate::scenes::BuiltIn;
use crate::tool;

/// Arguments of `docs`.
#[derive(Debug, Subcommand)]
pub enum DocsCommand {
    /// Print the message reference (docs/messages.md).
    Messages,
    /// Print the scene file reference (docs/scene.md).
    Scene,
    /// Print the `ros2msg` schema of a message, as stored in the logs.
    Schema {
        /// Message name, such as `State`.
        message: String,
    },
    /// Print shell completions, for example `source <(trabecula docs completions bash)`.
    Completions {
        /// Shell.
        shell: Shell,
    },
    /// Print the man page in roff: `trabecula docs man | man -l -`.
    Man,
    /// Install man pages and shell completions below a prefix, such as `~/.local` or `/usr`.
    Install {
        /// Prefix; its folders are created if missing.
        #[arg(short, long)]
        output: PathBuf,
    },
}

/// Runs the command.
///
/// # Errors
/// An unknown message, or a file that already exists (2); a full disk (1).
pub fn run(command: &DocsCommand) -> Result<(), Failure> {
    let text = match command {
        DocsCommand::Messages => message_reference(),
        DocsCommand::Scene => scene_reference() + &tool::reference(&BuiltIn::Femur.scene()?)?,
        DocsCommand::Schema { message } => schema(message)?,
        DocsCommand::Completions { shell } => completions(*shell),
        DocsCommand::Man => man_page()?,
        DocsCommand::Install { output } => return install(output),
    };
    say::verbatim(&text);
    Ok(())
}

/// Writes to the search paths below a prefix of `man`, bash-completion, fish (vendor folder) and zsh (site
/// functions).
fn install(prefix: &Path) -> Result<(), Failure> {
    let mut files: Vec<(PathBuf, Vec<u8>)> = Vec::new();
    for (place, shell) in [
        ("share/bash-completion/completions/trabecula", Shell::Bash),
        ("share/zsh/site-functions/_trabecula", Shell::Zsh),
        ("share/fish/vendor_completions.d/trabecula.fish", Shell::Fish),
    ] {
        files.push((prefix.join(place), completions(shell).into_bytes()));
    }
    let mut command = command_line();
    command.build();
    for (name, page) in pages(&command, "trabecula")? {
        files.push((prefix.join("share/man/man1").join(format!("{name}.1")), page));
    }
    let paths: Vec<&Path> = files.iter().map(|(path, _)| path.as_path()).collect();
    refuse_existing(&paths)?;
    for folder in paths.iter().filter_map(|path| path.parent()) {
        output_file::create_folder(folder).map_err(Failure::folder(folder))?;
    }
    output_file::write_all(&files)?;
    files.iter().for_each(|(path, _)| say!("{}", path.display()));
    Ok(())
}

/// Renders the man pages of a command and its subcommands, named such as `trabecula-log-export`.
fn pages(command: &clap::Command, name: &str) -> Result<Vec<(String, Vec<u8>)>, Failure> {
    let mut all = vec![(name.to_owned(), rendered(clap_mangen::Man::new(command.clone()).title(name))?)];
    for below in command.get_subcommands() {
        let is_of_users = !below.is_hide_set() && !["help", "proc"].contains(&below.get_name());
        if is_of_users {
            all.extend(pages(below, &format!("{name}-{}", below.get_name()))?);
        }
    }
    Ok(all)
}

fn completions(shell: Shell) -> String {
    let mut text = Vec::new();
    clap_complete::generate(shell, &mut command_line(), "trabecula", &mut text);
    String::from_utf8_lossy(&text).into_owned()
}

/// Renders the man page of the command, followed by one per subcommand.
fn man_page() -> Result<String, Failure> {
    let mut command = command_line();
    command.build();
    let mut text = rendered(clap_mangen::Man::new(command.clone()))?;
    for subcommand in command.get_subcommands().filter(|command| command.get_name() != "help") {
        text.extend(rendered(clap_mangen::Man::new(subcommand.clone()))?);
    }
    Ok(String::from_utf8_lossy(&text).into_owned())
}

fn rendered(page: clap_mangen::Man) -> Result<Vec<u8>, Failure> {
    let mut text = Vec::new();
    page.render(&mut text)
        .map_err(|cause| Failure::failed(format!("cannot create the man page: {cause}")))?;
    Ok(text)
}

fn schema(message: &str) -> Result<String, Failure> {
    let all = every_message();
    match all.iter().find(|description| description.short_name() == message || description.name == message) {
        Some(description) => Ok(schema_of(description).1),
        None => {
            let known: Vec<&str> = all.iter().map(|description| description.short_name()).collect();
            Err(Failure::bad_input(format!(
                "unknown message `{message}`; expected one of {}",
                known.join(", ")
            )))
        }
    }
}
