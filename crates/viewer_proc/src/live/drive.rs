//! Keyboard and gamepad as an ordinary controller: named `viewer` in the scene, latched and recorded.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};

use ipc_types::messages::{ArmMode, BurrMode, Command, Pose, State, TendonMode};
use ipc_types::messages::{MAX_BURR_SPEED_RAD_PER_S, MAX_DEPTH_M, MAX_SPEED_M_PER_S, MAX_TENSION_N};
use ipc_types::scene::{Drives, Drr, Scene};
use trabecula_client::{Client, ClientError, Connection};

use super::frame_requests::{FrameRequests, ask_frame, turns_the_c_arm};
use crate::board::Board;
use crate::calls::Call;
use crate::error::ViewerError;
use crate::info::{CONTROLLER, unit};
use crate::services::{CArm, Drive, Reply, Request};
use crate::threads;

/// Dead-man timeout: without a request for this long the insertion stops, because the client that held the
/// key is gone.
const HAND_LIMIT: Duration = Duration::from_millis(300);
/// Longest time between two polls for calls.
const POLL_PERIOD: Duration = Duration::from_millis(20);
/// Feed while the insertion is stopped: the path limit must be above 0.
const LEAST_FEED_M_PER_S: f64 = 1e-3;
const HOW: &str = "the scene has no controller for the viewer; add\n\
    [[controller]]\nname = \"viewer\"\ndrives = [\"tendon\", \"arm\", \"burr\", \"c_arm\"]\n\
    external = true\noptional = true\n\
    to it, without the parts that other controllers drive";

/// Handle to the driving thread.
pub(super) struct Driver {
    calls: Option<mpsc::Sender<Call>>,
    /// Receives frame requests; `None` if the viewer drives the C-arm and requests frames as a controller.
    frames: Option<FrameRequests>,
}

impl Driver {
    /// Starts the thread if the scene names the controller. A tick waits for an optional controller only
    /// after its first command, so the thread joins on first use.
    ///
    /// # Errors
    /// The thread, or that of frame requests, cannot be started.
    pub(super) fn start(
        session: &Path,
        scene: &Scene,
        over: Arc<AtomicBool>,
        board: Arc<Board>,
    ) -> Result<Driver, ViewerError> {
        let frames = (!turns_the_c_arm(scene))
            .then(|| FrameRequests::start(session, scene, Arc::clone(&over)))
            .transpose()?;
        let controller = scene.controller.iter().find(|controller| controller.name == CONTROLLER);
        let Some(controller) = controller.filter(|controller| controller.external) else {
            return Ok(Driver { calls: None, frames });
        };
        let (calls, called) = mpsc::channel();
        let thread = DriveThread {
            session: session.to_owned(),
            drives: controller.drives.clone(),
            optional: controller.optional,
            axis: unit(scene.tool.direction),
            dt_s: scene.dt_s(),
            drr: scene.drr.clone(),
            inputs: Inputs::default(),
            heard: Instant::now(),
        };
        threads::start("drive", move || thread.run(&called, &over, &board))?;
        Ok(Driver { calls: Some(calls), frames })
    }

    /// Forwards a `/drive` or `/frame` call.
    pub(super) fn hand_over(&self, call: Call) {
        if let (Request::Frame(_), Some(frames)) = (&call.request, &self.frames) {
            return frames.hand_over(call);
        }
        let refused = match &self.calls {
            None => Some((call, HOW)),
            Some(calls) => {
                calls.send(call).err().map(|error| (error.0, "the viewer cannot drive: the run has ended"))
            }
        };
        if let Some((call, text)) = refused {
            call.refuse(text);
        }
    }
}

/// The user's current inputs.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Inputs {
    tension_n: Option<[f64; 4]>,
    insert_m_per_s: Option<f64>,
    burr_rad_per_s: Option<f64>,
    depth_m: f64,
    sim_time_s: f64,
}

struct DriveThread {
    session: PathBuf,
    drives: Vec<Drives>,
    optional: bool,
    axis: [f64; 3],
    dt_s: f64,
    drr: Option<Drr>,
    inputs: Inputs,
    heard: Instant,
}

impl DriveThread {
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
                    board.notice("error", &format!("the viewer stopped driving: {error}"));
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
                let outcome = self.apply(client, &call.request).map(|()| Reply::Done);
                let _ = call.answer.send(outcome);
            }
            if self.heard.elapsed() > HAND_LIMIT {
                self.inputs.insert_m_per_s = self.inputs.insert_m_per_s.map(|_| 0.0);
            }
            match client
                .answer(POLL_PERIOD, |state, command| self.inputs.fill(state, command, self.axis, self.dt_s))
            {
                // A paused run sends no states.
                Ok(()) | Err(ClientError::TimedOut(_)) => {}
                Err(ClientError::Ended | ClientError::HubGone { .. }) => return Ok(()),
                Err(other) => return Err(other),
            }
        }
        Ok(())
    }

    fn apply(&mut self, client: &mut Client, request: &Request) -> Result<(), String> {
        match request {
            Request::Drive(drive) => {
                let inputs = self.inputs.with(drive, &self.drives)?;
                if let Some(c_arm) = &drive.c_arm {
                    allowed(&self.drives, Drives::CArm, "c_arm")?;
                    ask_frame(client, c_arm, self.drr.as_ref())?;
                }
                self.inputs = inputs;
                self.heard = Instant::now();
                Ok(())
            }
            Request::Frame(c_arm) => ask_frame(client, c_arm, self.drr.as_ref()),
            Request::Control(_)
            | Request::Playback(_)
            | Request::Series(_)
            | Request::Slice(_)
            | Request::Plan(_) => Err("not a request for the controller".to_owned()),
        }
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
    Err(format!("`{name}` is {value}; allowed: {lowest} to {highest}"))
}

impl Inputs {
    /// Returns the inputs after a request, which is accepted or refused as a whole.
    fn with(mut self, drive: &Drive, drives: &[Drives]) -> Result<Inputs, String> {
        if let Some(tension) = &drive.tendon_n {
            allowed(drives, Drives::Tendon, "tendon")?;
            let values = tension.values();
            if values.len() > 4 {
                return Err(format!("`tendon_n` has {} values; there are 4 tendons", values.len()));
            }
            let tension_n = self.tension_n.get_or_insert([0.0; 4]);
            for (slot, value) in tension_n.iter_mut().zip(values) {
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

    /// Fills in the command for a state. The insertion advances at its speed; a reset restarts it.
    fn fill(&mut self, state: &State, command: &mut Command, axis: [f64; 3], dt_s: f64) {
        if state.sim_time_s < self.sim_time_s {
            *self = Inputs::default();
        }
        let passed_s = if self.sim_time_s > 0.0 { state.sim_time_s - self.sim_time_s } else { dt_s };
        self.sim_time_s = state.sim_time_s;
        if let Some(tension_n) = self.tension_n {
            command.tendon_mode = TendonMode::ServoJf.code();
            command.tendon_force_n = tension_n;
        }
        if let Some(speed) = self.insert_m_per_s {
            self.depth_m = (self.depth_m + speed * passed_s).clamp(-MAX_DEPTH_M, MAX_DEPTH_M);
            command.arm_mode = ArmMode::Insert.code();
            command.arm_axis = axis;
            command.arm_depth_m = self.depth_m;
            command.arm_speed_m_per_s = speed.abs().max(LEAST_FEED_M_PER_S);
        }
        if let Some(speed) = self.burr_rad_per_s {
            command.burr_mode = BurrMode::Speed.code();
            command.burr_speed_rad_per_s = speed;
        }
    }
}

/// Returns a C-arm's pose from its DICOM angles (DICOM PS3.3, C.8.7.5.1.2): primary 0 puts the detector in
/// front of the chest and increases toward the patient's left; secondary increases toward the head. Axes:
/// rows to the right, columns down, z to the source.
pub(super) fn c_arm_pose(c_arm: &CArm, drr: &Drr) -> Result<Pose, String> {
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

/// Returns the unit quaternion of the rotation matrix with these columns (Shepperd's method).
fn quaternion([x, y, z]: [[f64; 3]; 3]) -> [f64; 4] {
    // Four times each component squared, less 1: x, y, z, w.
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

#[cfg(test)]
mod tests {
    use super::*;

    fn drive(text: &str) -> Drive {
        serde_json::from_str(text).unwrap()
    }

    #[test]
    fn what_is_held_goes_into_the_command_and_the_insertion_goes_on_by_its_speed() {
        let all = [Drives::Tendon, Drives::Arm, Drives::Burr];
        let request = drive(r#"{"tendon_n": 5, "insert_m_per_s": 0.01, "burr_rad_per_s": 800}"#);
        let mut inputs = Inputs::default().with(&request, &all).unwrap();
        let mut state = State::zeroed();
        let mut command = Command::zeroed();
        for tick in 1..=100 {
            state.sim_time_s = f64::from(tick) * 1e-3;
            inputs.fill(&state, &mut command, [0.0, 0.0, 1.0], 1e-3);
        }
        assert!((command.arm_depth_m - 1e-3).abs() < 1e-12, "{}", command.arm_depth_m);
        assert_eq!((command.tendon_force_n[0], command.burr_speed_rad_per_s), (5.0, 800.0));
        command.sequence = 1;
        hub::command_check::check(&command, &all, 0, ipc_types::messages::Tick(1)).unwrap();
        let back = inputs.with(&drive(r#"{"insert_m_per_s": -0.02}"#), &all).unwrap();
        assert_eq!(
            (back.tension_n, back.burr_rad_per_s),
            (inputs.tension_n, inputs.burr_rad_per_s),
            "the rest stays"
        );
        state.sim_time_s = 0.0;
        inputs.fill(&state, &mut command, [0.0, 0.0, 1.0], 1e-3);
        assert_eq!((inputs.insert_m_per_s, inputs.depth_m), (None, 0.0), "a reset clears the inputs");
    }

    #[test]
    fn what_the_scene_does_not_give_or_no_tool_can_do_is_refused_and_nothing_changes() {
        let inputs = Inputs::default();
        let refused = |text: &str, drives: &[Drives], words: &str| {
            let error = inputs.with(&drive(text), drives).unwrap_err();
            assert!(error.contains(words), "{error}");
        };
        refused(r#"{"burr_rad_per_s": 1}"#, &[Drives::Tendon], "add \"burr\"");
        refused(r#"{"tendon_n": -1}"#, &[Drives::Tendon], "0 to 60");
        refused(r#"{"tendon_n": [1, 2, 3, 4, 5]}"#, &[Drives::Tendon], "4 tendons");
        refused(r#"{"insert_m_per_s": 5}"#, &[Drives::Arm], "-1 to 1");
    }

    /// Checked against the definition of the angles: AP has the detector in front of the chest, 90° at the
    /// patient's left.
    #[test]
    fn the_c_arm_turns_by_dicoms_angles() {
        let text =
            "rate_hz = 0.0\nisocentre_mm = [10.0, 0.0, 0.0]\ncolumns = 64\nrows = 64\npixel_pitch_mm = 1.0\n";
        let scene = format!(
            "name = \"x\"\n[run]\nmode = \"lockstep\"\nduration_s = 1.0\n\
             [volume]\nphantom = \"block\"\n[tool]\nburr_start_mm = [0.0, 0.0, 0.0]\n\
             direction = [0.0, 0.0, 1.0]\n\
             bend_toward = [1.0, 0.0, 0.0]\n[drr]\n{text}"
        );
        let drr = Scene::parse(&scene, Path::new("x.toml")).unwrap().drr.unwrap();
        for (primary, secondary, to_source) in [
            (0.0, 0.0, [0.0, 1.0, 0.0]),
            (90.0, 0.0, [-1.0, 0.0, 0.0]),
            (-90.0, 0.0, [1.0, 0.0, 0.0]),
            (180.0, 0.0, [0.0, -1.0, 0.0]),
            (0.0, 90.0, [0.0, 0.0, -1.0]),
        ] {
            let c_arm =
                CArm { primary_angle_deg: Some(primary), secondary_angle_deg: Some(secondary), pose: None };
            let pose = c_arm_pose(&c_arm, &drr).unwrap();
            let [x, y, z, w] = pose.orientation_xyzw;
            let axis = [2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)];
            for (found, expected) in axis.iter().zip(to_source) {
                assert!((found - expected).abs() < 1e-12, "{primary} {secondary}: {axis:?}");
            }
            assert_eq!(pose.position_m, [0.01, 0.0, 0.0]);
        }
        assert!(c_arm_pose(&CArm { primary_angle_deg: Some(400.0), ..CArm::default() }, &drr).is_err());
    }
}
