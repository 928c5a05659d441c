//! `trabecula session`: lists this user's running sessions, and pauses, resumes or stops one.

use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::{Args, Subcommand};
use ipc_types::messages::ControlAction;
use ipc_types::process::session_scene;
use ipc_types::scene::Scene;
use ipc_types::session::{CONTROLLER_VARIABLE, SESSION_VARIABLE, announced_sessions};
use trabecula_client::{Client, ClientError, Connection};

use crate::failure::Failure;
use crate::say::path_text;

/// Timeout for finding a session, and then for the reply of its physics, which may still be starting.
const LIMIT: Duration = Duration::from_secs(30);

/// Arguments of `session`.
#[derive(Debug, Subcommand)]
pub enum SessionCommand {
    /// List this user's running sessions.
    List {
        /// Print one JSON object per line.
        #[arg(long)]
        json: bool,
    },
    /// Stop a run after the current tick.
    Stop(SessionSelector),
    /// Pause a run before the next tick.
    Pause(SessionSelector),
    /// Resume a paused run.
    Resume(SessionSelector),
    /// Print the environment variables that a program needs to join: `eval "$(trabecula session env)"`.
    Env(SessionSelector),
}

/// Selects a session.
#[derive(Debug, Args)]
pub struct SessionSelector {
    /// Name or folder of the session; default: `TRABECULA_SESSION`, or else this user's only running session.
    session: Option<String>,
}

/// Runs the command.
///
/// # Errors
/// No session, or several without a name given (2); a run that has ended or does not reply (1).
pub fn run(command: &SessionCommand) -> Result<(), Failure> {
    match command {
        SessionCommand::List { json } => list(*json),
        SessionCommand::Stop(named) => control(named, ControlAction::Stop),
        SessionCommand::Pause(named) => control(named, ControlAction::Pause),
        SessionCommand::Resume(named) => control(named, ControlAction::Resume),
        SessionCommand::Env(named) => env(named),
    }
}

fn list(json: bool) -> Result<(), Failure> {
    // A session that has just ended has no scene any more.
    let of = |folder: PathBuf| session_scene(&folder).ok().map(|scene| (folder, scene));
    let sessions: Vec<(PathBuf, Scene)> = announced_sessions().into_iter().filter_map(of).collect();
    if sessions.is_empty() && !json {
        say!("no running sessions");
    }
    for (folder, scene) in sessions {
        let (name, controllers) = (name_of(&folder), scene.controller_names());
        if json {
            let session = serde_json::json!({
                "session": name, "folder": path_text(&folder), "scene": scene.name, "controllers": controllers,
            });
            say!("{session}");
        } else {
            say!("{name}  {}  controllers: {}  {}", scene.name, listed(&controllers), folder.display());
        }
    }
    Ok(())
}

fn listed(names: &[String]) -> String {
    if names.is_empty() { "none".to_owned() } else { names.join(", ") }
}

fn name_of(folder: &Path) -> String {
    folder.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned())
}

fn joined(named: &SessionSelector) -> Result<Client, Failure> {
    let connection =
        Connection { session: named.session.clone(), limit: Duration::ZERO, ..Connection::observer() };
    Client::connect(&connection).map_err(Failure::bad_input)
}

fn control(named: &SessionSelector, action: ControlAction) -> Result<(), Failure> {
    let mut client = joined(named)?;
    let session = client.session_name();
    let reply = client.run_control(action.code(), 0, LIMIT).map_err(|cause| match cause {
        ClientError::Ended => Failure::failed(client.end_reason()),
        cause => Failure::failed(format!("session {session}: {cause}")),
    })?;
    say!("session {session}: {} at tick {}", action.word(), reply.tick);
    Ok(())
}

fn env(named: &SessionSelector) -> Result<(), Failure> {
    let client = joined(named)?;
    let line = |variable: &str, value: &str| {
        // A shell runs this text, so it must read the value as one word.
        let word = shlex::try_quote(value).map_err(Failure::failed)?;
        say!("export {variable}={word}");
        Ok::<(), Failure>(())
    };
    line(SESSION_VARIABLE, &client.info().folder.to_string_lossy())?;
    let mut external = client.scene().controller.iter().filter(|controller| controller.external);
    if let (Some(only), None) = (external.next(), external.next()) {
        line(CONTROLLER_VARIABLE, &only.name)?;
    }
    Ok(())
}
