//! `trabecula session`: lists this user's running sessions, and pauses, resumes or stops one.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use clap::{Args, Subcommand};
use foreign_text::foreign_line;
use ipc_types::messages::{ControlAction, EventCode, Part, Participant, Severity};
use ipc_types::process::session_scene;
use ipc_types::scene::Scene;
use ipc_types::session::{CONTROLLER_VARIABLE, SESSION_VARIABLE, announced_sessions};
use trabecula_client::{Client, ClientError, Connection};

use crate::failure::Failure;
use crate::say::path_text;

/// Timeout for finding a session, and then for the reply of its physics, which may still be starting.
const LIMIT: Duration = Duration::from_secs(30);

/// Interval at which events are polled.
const POLL_PERIOD: Duration = Duration::from_millis(5);

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
    /// Save the log of the last seconds (`recording.ring_s`), and of the next ones, as a log of its own.
    Save {
        #[command(flatten)]
        session: SessionSelector,
        /// Simulated seconds to record from now on; default: `recording.after_s`.
        #[arg(long, value_name = "SECONDS")]
        after: Option<f64>,
    },
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
        SessionCommand::Save { session, after } => save(session, *after),
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
    let tick = send(&mut client, action, 0)?;
    say!("session {}: {} at tick {tick}", client.session_name(), action.word());
    Ok(())
}

/// Sends a request and returns the tick at which it took effect.
fn send(client: &mut Client, action: ControlAction, ticks: u64) -> Result<u64, Failure> {
    let reply = client.run_control(action.code(), ticks, LIMIT).map_err(|cause| match cause {
        ClientError::Ended => Failure::failed(client.end_reason()),
        cause => Failure::failed(format!("session {}: {cause}", client.session_name())),
    })?;
    Ok(reply.tick)
}

/// Has the recorder save its log, and prints the folder that it will have.
fn save(named: &SessionSelector, after_s: Option<f64>) -> Result<(), Failure> {
    let mut client = joined(named)?;
    let (session, dt_s) = (client.session_name(), client.info().dt_s);
    let recording = client.scene().recording.clone();
    let refused = |why: String| Err(Failure::bad_input(format!("session {session}: {why}")));
    if recording.ring_s == 0.0 {
        return refused("has no flight recorder; set `recording.ring_s` in its scene".to_owned());
    }
    let after_s = after_s.unwrap_or(recording.after_s);
    if !(0.0..=recording.ring_s).contains(&after_s) {
        let most_s = recording.ring_s;
        return refused(format!("--after is {after_s}; allowed: 0 to {most_s} (`recording.ring_s`)"));
    }
    // Queues events from now on.
    client.next_event().map_err(Failure::failed)?;
    // 0 would stand for the scene's value.
    let tick = send(&mut client, ControlAction::Save, (after_s / dt_s).ceil().max(1.0) as u64)?;
    let limit = Instant::now() + LIMIT;
    while Instant::now() < limit {
        let Some((event, text)) = client.next_event().map_err(Failure::failed)? else {
            std::thread::sleep(POLL_PERIOD);
            continue;
        };
        let is_answer = event.code() == Ok(EventCode::LogSaved) && event.tick == tick;
        if is_answer && event.sender() == Some(Participant::Part(Part::Recorder)) {
            let text = foreign_line(text);
            if event.severity() == Ok(Severity::Info) {
                say!("session {session}: {text}");
                return Ok(());
            }
            return Err(Failure::failed(format!("session {session}: {text}")));
        }
    }
    Err(Failure::failed(format!("session {session}: the recorder does not answer")))
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
