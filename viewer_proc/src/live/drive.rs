//! The keyboard and gamepad as a controller like any other: named `viewer` in the scene, latched and recorded.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::time::Duration;

use ipc_types::command_check::{MAX_BURR_SPEED_RAD_PER_S, MAX_DEPTH_M, MAX_SPEED_M_PER_S, MAX_TENSION_N};
use ipc_types::messages::{ARM_INSERT, BURR_SPEED, Command, Pose, State, TENDON_SERVO_JF};
use ipc_types::scene::{Drives, Drr, Scene};
use trabecula_client::{Client, ClientError, Connection};

use crate::board::Board;
use crate::info::unit;
use crate::services::{CArm, Call, Drive, Request};

/// Name of the controller in the scene.
pub const CONTROLLER: &str = "viewer";
/// Longest time without a look at the calls.
const LOOK_TIME: Duration = Duration::from_millis(20);
/// Feed while the insertion stands: the limit of its path, which must be above 0.
const LEAST_FEED_M_PER_S: f64 = 1e-3;
const HOW: &str = "the scene has no controller for the viewer; add\n[[controller]]\nname = \"viewer\"\ndrives = [\"tendon\", \"arm\", \"burr\", \"c_arm\"]\nexternal = true\noptional = true\nto it, without what other controllers drive";

/// The way to the thread that drives.
pub(super) struct Driver {
    calls: Option<mpsc::Sender<Call>>,
}

impl Driver {
    /// Starts the thread if the scene names the controller. A tick waits for an optional one only from its first command on,
    /// so it joins when it is first used.
    pub(super) fn start(session: &Path, scene: &Scene, over: Arc<AtomicBool>, board: Arc<Board>) -> Driver {
        let controller = scene.controller.iter().find(|controller| controller.name == CONTROLLER);
        let Some(controller) = controller.filter(|controller| controller.external) else {
            return Driver { calls: None };
        };
        let (calls, called) = mpsc::channel();
        let hand = Hand {
            session: session.to_owned(),
            drives: controller.drives.clone(),
            optional: controller.optional,
            axis: unit(scene.tool.direction),
            dt_s: scene.dt_s(),
            drr: scene.drr.clone(),
            held: Held::default(),
        };
        std::thread::spawn(move || hand.run(&called, &over, &board));
        Driver { calls: Some(calls) }
    }

    /// Hands over a call of `/drive` or `/frame`.
    pub(super) fn hand_over(&self, call: Call) {
        let refused = match &self.calls {
            None => Some((call, HOW)),
            Some(calls) => {
                calls.send(call).err().map(|error| (error.0, "the viewer drives no more: the run has ended"))
            }
        };
        if let Some((call, text)) = refused {
            // The client may have left.
            let _ = call.answer.send(Err(text.to_owned()));
        }
    }
}

/// What the user holds.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Held {
    tension_n: Option<[f64; 4]>,
    insert_m_per_s: Option<f64>,
    burr_rad_per_s: Option<f64>,
    depth_m: f64,
    sim_time_s: f64,
}

struct Hand {
    session: PathBuf,
    drives: Vec<Drives>,
    optional: bool,
    axis: [f64; 3],
    dt_s: f64,
    drr: Option<Drr>,
    held: Held,
}

impl Hand {
    fn run(mut self, called: &mpsc::Receiver<Call>, over: &AtomicBool, board: &Board) {
        let first = if self.optional { self.await_first(called, over) } else { None };
        let connection = Connection {
            session: Some(self.session.display().to_string()),
            controller: Some(CONTROLLER.to_owned()),
            limit: Duration::from_secs(2),
        };
        if over.load(Ordering::Relaxed) {
            return;
        }
        match Client::connect(&connection) {
            Ok(mut client) => {
                if let Err(error) = self.drive(&mut client, first, called, over) {
                    board.notice("error", &format!("the viewer drives no more: {error}"));
                }
            }
            Err(error) => {
                let text = format!("the viewer cannot drive: {error}");
                board.notice("error", &text);
                for call in first.into_iter().chain(called.iter()) {
                    let _ = call.answer.send(Err(text.clone()));
                }
            }
        }
    }

    fn await_first(&self, called: &mpsc::Receiver<Call>, over: &AtomicBool) -> Option<Call> {
        while !over.load(Ordering::Relaxed) {
            match called.recv_timeout(Duration::from_millis(100)) {
                Ok(call) => return Some(call),
                Err(mpsc::RecvTimeoutError::Timeout) => {}
                Err(mpsc::RecvTimeoutError::Disconnected) => return None,
            }
        }
        None
    }

    fn drive(
        &mut self,
        client: &mut Client,
        first: Option<Call>,
        called: &mpsc::Receiver<Call>,
        over: &AtomicBool,
    ) -> Result<(), ClientError> {
        let mut first = first;
        while !over.load(Ordering::Relaxed) {
            for call in first.take().into_iter().chain(called.try_iter()) {
                let outcome = self.obey(client, &call.request);
                let _ = call.answer.send(outcome);
            }
            match client
                .answer(LOOK_TIME, |state, command| self.held.fill(state, command, self.axis, self.dt_s))
            {
                // A paused run has no states.
                Ok(()) | Err(ClientError::TimedOut(_)) => {}
                Err(ClientError::Ended | ClientError::HubGone { .. }) => return Ok(()),
                Err(other) => return Err(other),
            }
        }
        Ok(())
    }

    fn obey(&mut self, client: &mut Client, request: &Request) -> Result<(), String> {
        match request {
            Request::Drive(drive) => {
                let held = self.held.with(drive, &self.drives)?;
                if let Some(c_arm) = &drive.c_arm {
                    self.ask_frame(client, c_arm)?;
                }
                self.held = held;
                Ok(())
            }
            Request::Frame(c_arm) => self.ask_frame(client, c_arm),
            Request::Control(_) | Request::Playback(_) => Err("no request for the controller".to_owned()),
        }
    }

    fn ask_frame(&self, client: &mut Client, c_arm: &CArm) -> Result<(), String> {
        allowed(&self.drives, Drives::CArm, "c_arm")?;
        let drr = self.drr.as_ref().ok_or("the scene has no X-ray ([drr])")?;
        let pose = match c_arm.pose {
            Some(pose) => Pose { position_m: pose.position_m, orientation_xyzw: pose.orientation_xyzw },
            None => c_arm_pose(c_arm, drr)?,
        };
        client.request_frame(Some(&pose), 0).map(drop).map_err(|error| error.to_string())
    }
}

fn allowed(drives: &[Drives], part: Drives, name: &str) -> Result<(), String> {
    if drives.contains(&part) {
        return Ok(());
    }
    Err(format!(
        "the scene's controller `{CONTROLLER}` does not drive the {name}; add \"{name}\" to its `drives`"
    ))
}

fn within(name: &str, value: f64, lowest: f64, highest: f64) -> Result<f64, String> {
    if (lowest..=highest).contains(&value) {
        return Ok(value);
    }
    Err(format!("`{name}` is {value}, allowed is {lowest} to {highest}"))
}

impl Held {
    /// What is held after a request; refused as a whole.
    fn with(mut self, drive: &Drive, drives: &[Drives]) -> Result<Held, String> {
        if let Some(tension) = &drive.tendon_n {
            allowed(drives, Drives::Tendon, "tendon")?;
            let values = tension.values();
            if values.len() > 4 {
                return Err(format!("`tendon_n` has {} values, there are 4 tendons at most", values.len()));
            }
            let held = self.tension_n.get_or_insert([0.0; 4]);
            for (slot, value) in held.iter_mut().zip(values) {
                *slot = within("tendon_n", *value, 0.0, MAX_TENSION_N)?;
            }
        }
        if let Some(speed) = drive.insert_m_per_s {
            allowed(drives, Drives::Arm, "arm")?;
            self.insert_m_per_s =
                Some(within("insert_m_per_s", speed, -MAX_SPEED_M_PER_S, MAX_SPEED_M_PER_S)?);
        }
        if let Some(speed) = drive.burr_rad_per_s {
            allowed(drives, Drives::Burr, "burr")?;
            self.burr_rad_per_s = Some(within("burr_rad_per_s", speed, 0.0, MAX_BURR_SPEED_RAD_PER_S)?);
        }
        Ok(self)
    }

    /// The command that answers a state. The insertion goes on by its speed; a reset begins it anew.
    fn fill(&mut self, state: &State, command: &mut Command, axis: [f64; 3], dt_s: f64) {
        if state.sim_time_s < self.sim_time_s {
            *self = Held::default();
        }
        let passed_s = if self.sim_time_s > 0.0 { state.sim_time_s - self.sim_time_s } else { dt_s };
        self.sim_time_s = state.sim_time_s;
        if let Some(tension_n) = self.tension_n {
            command.tendon_mode = TENDON_SERVO_JF;
            command.tendon_force_n = tension_n;
        }
        if let Some(speed) = self.insert_m_per_s {
            self.depth_m = (self.depth_m + speed * passed_s).clamp(-MAX_DEPTH_M, MAX_DEPTH_M);
            command.arm_mode = ARM_INSERT;
            command.arm_axis = axis;
            command.arm_depth_m = self.depth_m;
            command.arm_speed_m_per_s = speed.abs().max(LEAST_FEED_M_PER_S);
        }
        if let Some(speed) = self.burr_rad_per_s {
            command.burr_mode = BURR_SPEED;
            command.burr_speed_rad_per_s = speed;
        }
    }
}

/// Pose of a C-arm by DICOM's angles: primary 0 has the detector in front of the chest and grows towards the patient's
/// left, secondary grows towards the head (DICOM PS3.3, C.8.7.5.1.2). Axes: rows to the right, columns down, z to the
/// source.
fn c_arm_pose(c_arm: &CArm, drr: &Drr) -> Result<Pose, String> {
    let angle = |given: Option<f64>, scene: f64, name: &str| {
        within(name, given.unwrap_or(scene), -180.0, 180.0).map(f64::to_radians)
    };
    let primary = angle(c_arm.primary_angle_deg, drr.primary_angle_deg, "primary_angle_deg")?;
    let secondary = angle(c_arm.secondary_angle_deg, drr.secondary_angle_deg, "secondary_angle_deg")?;
    let ((sp, cp), (ss, cs)) = (primary.sin_cos(), secondary.sin_cos());
    let row = [cp, sp, 0.0];
    let column = [sp * ss, -cp * ss, -cs];
    let to_source = [-sp * cs, cp * cs, -ss];
    Ok(Pose {
        position_m: drr.isocentre_mm.map(|x| x * 1e-3),
        orientation_xyzw: quaternion([row, column, to_source]),
    })
}

/// Unit quaternion of a rotation given by its columns (Shepperd's method).
fn quaternion([x, y, z]: [[f64; 3]; 3]) -> [f64; 4] {
    // Four times the square of each component, less 1: x, y, z, w.
    let squares = [x[0] - y[1] - z[2], y[1] - x[0] - z[2], z[2] - x[0] - y[1], x[0] + y[1] + z[2]];
    let largest = (0..4).max_by(|a, b| squares[*a].total_cmp(&squares[*b])).unwrap_or(3);
    let products = [
        [1.0 + squares[0], y[0] + x[1], z[0] + x[2], y[2] - z[1]],
        [y[0] + x[1], 1.0 + squares[1], z[1] + y[2], z[0] - x[2]],
        [z[0] + x[2], z[1] + y[2], 1.0 + squares[2], x[1] - y[0]],
        [y[2] - z[1], z[0] - x[2], x[1] - y[0], 1.0 + squares[3]],
    ][largest];
    let length = products.iter().map(|p| p * p).sum::<f64>().sqrt();
    products.map(|p| p / length)
}
