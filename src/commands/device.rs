//! `trabecula device`: drives a running session with a gamepad, a six-axis mouse or pedals.

use std::path::PathBuf;

use bridge_proc::device::{self, DeviceError, DeviceKind, DeviceOptions, DeviceSource, Summary};
use clap::{Args, Subcommand};
use ipc_types::process::EndRequest;

use super::{Choice, choice};
use crate::failure::Failure;
use crate::say::{Figures, path_text};

const KINDS: [Choice<DeviceKind>; 3] = [
    (DeviceKind::Gamepad.word(), "Two sticks, triggers and buttons", DeviceKind::Gamepad),
    (DeviceKind::SpaceMouse.word(), "Six axes, as of 3Dconnexion", DeviceKind::SpaceMouse),
    (DeviceKind::Pedal.word(), "Foot switches", DeviceKind::Pedal),
];

/// Arguments of `device`.
#[derive(Debug, Subcommand)]
pub enum DeviceCommand {
    /// Drive a session with a gamepad.
    Gamepad(DeviceArguments),
    /// Drive a session with a six-axis mouse.
    Spacemouse(DeviceArguments),
    /// Drive a session with foot switches.
    Pedal(DeviceArguments),
    /// List the gamepads, six-axis mice and pedals of this machine.
    List {
        /// Print one JSON object per line.
        #[arg(long)]
        json: bool,
    },
    /// Print the built-in mapping of a kind of device, to start from.
    Mapping {
        /// Kind of the device.
        #[arg(value_parser = choice(&KINDS))]
        kind: DeviceKind,
    },
}

/// Arguments of a device that drives a session.
#[derive(Debug, Args)]
pub struct DeviceArguments {
    /// External controller of the scene (`external = true`) to act as.
    #[arg(long)]
    controller: String,
    /// Folder of the session; default: this user's only running session.
    #[arg(long)]
    session: Option<String>,
    /// Device node under /dev/input, or a pipe with the same records; default: the only device of this kind.
    #[arg(long, value_name = "PATH", conflicts_with = "events")]
    device: Option<PathBuf>,
    /// Play a recorded file (`cat /dev/input/event3 > FILE`) in simulated time, from the first state on.
    #[arg(long, value_name = "FILE")]
    events: Option<PathBuf>,
    /// What moves what, how fast and in which frame (TOML); default: the kind's built-in mapping.
    #[arg(long, value_name = "FILE")]
    mapping: Option<PathBuf>,
    #[command(flatten)]
    figures: Figures,
}

/// Runs the command.
///
/// # Errors
/// No session, no device, or a mapping that is refused (2); a lost session or device (1).
pub fn run(command: &DeviceCommand) -> Result<(), Failure> {
    match command {
        DeviceCommand::Gamepad(arguments) => drive(DeviceKind::Gamepad, arguments),
        DeviceCommand::Spacemouse(arguments) => drive(DeviceKind::SpaceMouse, arguments),
        DeviceCommand::Pedal(arguments) => drive(DeviceKind::Pedal, arguments),
        DeviceCommand::List { json } => {
            list(*json);
            Ok(())
        }
        DeviceCommand::Mapping { kind } => {
            say!("{}", device::built_in(*kind).trim_end());
            Ok(())
        }
    }
}

fn list(json: bool) {
    let devices = device::devices();
    if devices.is_empty() && !json {
        say!("no gamepad, six-axis mouse or pedal found");
    }
    for found in devices {
        let (name, node, kind) = (found.name, path_text(&found.node), found.kind.word());
        match json {
            true => say!("{}", serde_json::json!({ "name": name, "node": node, "kind": kind })),
            false => say!("{node}  {kind}  {name}"),
        }
    }
}

fn drive(kind: DeviceKind, arguments: &DeviceArguments) -> Result<(), Failure> {
    let end = EndRequest::install().map_err(Failure::signals)?;
    let source = match (&arguments.device, &arguments.events) {
        (Some(path), _) => DeviceSource::Device(path.clone()),
        (None, Some(file)) => DeviceSource::Recording(file.clone()),
        (None, None) => DeviceSource::Found,
    };
    let options = DeviceOptions {
        session: arguments.session.clone(),
        controller: arguments.controller.clone(),
        kind,
        source,
        mapping: arguments.mapping.clone(),
    };
    let failure = |error: DeviceError| Failure::by_kind(error.is_bad_input(), error);
    let json = arguments.figures.json;
    let ready = |name: &str| {
        if !json {
            say!("{kind} {name} drives controller {}", foreign_text::foreign(&arguments.controller));
        }
    };
    let done = device::serve(&options, &end, ready).map_err(failure)?;
    arguments.figures.say(|| text(&done), || figures(&done));
    match done.gone {
        Some([device, why]) => Err(failure(DeviceError::Gone { device, why })),
        None => Ok(()),
    }
}

/// Returns median and 99th percentile of the latency, in ms; `None` for a recording.
fn latency_ms(done: &Summary) -> Option<[f64; 2]> {
    let known = done.latencies.count() > 0;
    known.then(|| [0.5, 0.99].map(|share| 1e3 * done.latencies.quantile_s(share)))
}

fn text(done: &Summary) -> String {
    let counts = format!("{} events, {} commands", done.events, done.commands);
    latency_ms(done).map_or(counts.clone(), |[median, p99]| {
        format!("{counts}; from an event to its command: median {median:.1} ms, p99 {p99:.1} ms")
    })
}

fn figures(done: &Summary) -> serde_json::Value {
    let [median, p99] = latency_ms(done).map_or([None; 2], |both| both.map(Some));
    serde_json::json!({
        "events": done.events,
        "commands": done.commands,
        "latency_p50_ms": median,
        "latency_p99_ms": p99,
    })
}
