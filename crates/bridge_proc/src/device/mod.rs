//! Gamepads, six-axis mice and pedals: a Linux input device as a controller.
//!
//! [`serve`] reads events, and answers every state with what the inputs then are; commands are latched,
//! recorded and replayed like any others. What the kernel reports is a change: an axis that is held sends
//! nothing, so its rate is commanded on as long as the device is there. Everything is at rest unless the
//! clutch is held, and 0.1 s after the device vanishes at the latest.
//!
//! **Boundary:** `motion`, `mapping`, `event` and `input` only compute; `source` and `list` read.

mod error;
mod event;
mod input;
mod list;
mod mapping;
mod motion;
mod source;

use std::path::PathBuf;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use ipc_types::messages::EventCode;
use ipc_types::process::EndRequest;
use ros_interface::round_trip::RoundTrips;
use trabecula_client::{Client, ClientError, Connection};

pub use error::DeviceError;
pub use list::{FoundDevice, devices};
pub use mapping::{MappingError, built_in};

use crate::own_controller;
use mapping::Mapping;
use motion::DeviceMotion;
use source::{Sign, Source};

/// How long one turn of the loop waits for a state.
const TURN: Duration = Duration::from_millis(5);
/// How long the last command waits for a state to answer.
const LAST_LIMIT: Duration = Duration::from_millis(200);

/// Kinds of devices.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DeviceKind {
    /// Two sticks, triggers and buttons.
    Gamepad,
    /// Six axes, as of 3Dconnexion.
    SpaceMouse,
    /// Foot switches, which type letters.
    Pedal,
}

impl DeviceKind {
    /// All kinds.
    pub const ALL: [DeviceKind; 3] = [DeviceKind::Gamepad, DeviceKind::SpaceMouse, DeviceKind::Pedal];

    /// Its name on the command line.
    pub const fn word(self) -> &'static str {
        match self {
            DeviceKind::Gamepad => "gamepad",
            DeviceKind::SpaceMouse => "spacemouse",
            DeviceKind::Pedal => "pedal",
        }
    }
}

impl core::fmt::Display for DeviceKind {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(self.word())
    }
}

/// Where events come from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum DeviceSource {
    /// The machine's only device of the kind.
    Found,
    /// A device node, or a pipe with the same records.
    Device(PathBuf),
    /// A file with the same records, which are played in simulated time.
    Recording(PathBuf),
}

/// Options of device input.
#[derive(Debug, Clone)]
pub struct DeviceOptions {
    /// The session's folder or name; `None`: discovered as by any client.
    pub session: Option<String>,
    /// The scene's controller to act as.
    pub controller: String,
    /// Kind of the device, which selects the built-in mapping.
    pub kind: DeviceKind,
    /// Where events come from.
    pub source: DeviceSource,
    /// A mapping file instead of the built-in mapping.
    pub mapping: Option<PathBuf>,
}

/// Statistics of device input.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Summary {
    /// Events read.
    pub events: u64,
    /// Commands sent.
    pub commands: u64,
    /// Times from an event to the first command sent after it was read; empty for a recording.
    pub latencies: RoundTrips,
    /// Which device has vanished, and why.
    pub gone: Option<[String; 2]>,
}

/// Drives a run until the session ends, the device vanishes or an end is requested; the last command stops
/// everything that the device moved. `ready` is called with the source's name once the session is joined.
///
/// # Errors
/// The [`DeviceError`].
pub fn serve(
    options: &DeviceOptions,
    end: &EndRequest,
    ready: impl FnOnce(&str),
) -> Result<Summary, DeviceError> {
    let mapping = Mapping::load(options.mapping.as_ref(), options.kind)?;
    let mut source = Source::open(&options.source, options.kind)?;
    let mut client = Client::connect(&Connection {
        session: options.session.clone(),
        controller: Some(options.controller.clone()),
        ..Connection::default()
    })?;
    let mut motion = motion_of(&client, mapping)?;
    ready(&source.name());
    let mut summary = Summary::default();
    loop {
        if end.is_set() {
            stop(&mut client, &mut motion, &source)?;
            return Ok(summary);
        }
        follow_c_arm(&mut client, &mut motion);
        release_after_reset(&mut client, &mut motion)?;
        let mut times_s = Vec::new();
        let mut sign = None;
        let outcome = client.answer(TURN, |state, command| {
            let now_s = source.now_s(state.sim_time_s);
            sign = Some(take(&mut source, &mut motion, now_s, &mut times_s));
            motion.fill(state, now_s, command);
        });
        match outcome {
            Ok(()) => {
                summary.commands += 1;
                if source.is_live() {
                    let now_s = since_1970_s();
                    times_s.iter().for_each(|time_s| summary.latencies.add(now_s - time_s));
                }
            }
            Err(ClientError::TimedOut(_)) => {}
            Err(ClientError::Ended) => return Ok(summary),
            Err(other) => return Err(other.into()),
        }
        // Without states, as in a pause, events are read, but no command follows them.
        let sim_time_s = client.state().map_or(0.0, |state| state.sim_time_s);
        let now_s = source.now_s(sim_time_s);
        let sign = sign.unwrap_or_else(|| take(&mut source, &mut motion, now_s, &mut times_s));
        summary.events += times_s.len() as u64;
        if let Sign::Gone(why) = sign {
            stop(&mut client, &mut motion, &source)?;
            summary.gone = Some([source.name(), why]);
            return Ok(summary);
        }
    }
}

/// Reads the events that have arrived and hands them to the motion.
fn take(source: &mut Source, motion: &mut DeviceMotion, now_s: f64, times_s: &mut Vec<f64>) -> Sign {
    let sign = source.drain(now_s, |event| {
        motion.take(&event, now_s);
        times_s.push(event.time_s);
    });
    if sign == Sign::Alive {
        motion.alive(now_s);
    }
    sign
}

fn motion_of(client: &Client, mapping: Mapping) -> Result<DeviceMotion, DeviceError> {
    let (name, drives) = own_controller(client).map_or(("", &[][..]), |own| (&own.name, &own.drives));
    let mut motion = DeviceMotion::new(mapping, drives);
    if motion.drives().is_empty() {
        return Err(DeviceError::NothingToDrive(name.to_owned()));
    }
    if motion.follows_c_arm() {
        let c_arm = client.scene().drr.as_ref().and_then(|drr| xray::from_scene::scene_c_arm(drr).ok());
        let c_arm = c_arm.ok_or(DeviceError::NoCArm)?;
        motion.turn_c_arm(c_arm.row_axis, c_arm.column_axis);
    }
    Ok(motion)
}

/// Turns the frame of the motion with the newest image.
fn follow_c_arm(client: &mut Client, motion: &mut DeviceMotion) {
    while motion.follows_c_arm()
        && let Ok(view) = client.wait_frame(0, Duration::ZERO)
    {
        let geometry = &view.frame.geometry;
        motion.turn_c_arm(geometry.row_axis, geometry.column_axis);
    }
}

/// Ends all motion after a reset, which has put the arm elsewhere.
fn release_after_reset(client: &mut Client, motion: &mut DeviceMotion) -> Result<(), DeviceError> {
    while let Some((event, _)) = client.next_event()? {
        if event.code == EventCode::Reset.code() {
            motion.release();
        }
    }
    Ok(())
}

/// Sends a command that stops everything.
fn stop(client: &mut Client, motion: &mut DeviceMotion, source: &Source) -> Result<(), DeviceError> {
    motion.release();
    let answered = client.answer(LAST_LIMIT, |state, command| {
        motion.fill(state, source.now_s(state.sim_time_s), command);
    });
    match answered {
        Ok(()) | Err(ClientError::Ended) => Ok(()),
        Err(ClientError::TimedOut(_)) => stop_paused(client, motion, source),
        Err(other) => Err(other.into()),
    }
}

/// The same, while a pause sends no states: replaces the command that the first tick after it would hold.
fn stop_paused(client: &mut Client, motion: &mut DeviceMotion, source: &Source) -> Result<(), DeviceError> {
    let Some(state) = client.state().copied() else { return Ok(()) };
    let command = client.command()?;
    motion.fill(&state, source.now_s(state.sim_time_s), command);
    Ok(client.send()?)
}

fn since_1970_s() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs_f64()
}
