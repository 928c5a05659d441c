//! Decodes and checks received messages and turns them into requests.

use messages::{
    MAX_BURR_SPEED_RAD_PER_S, MAX_DEPLOYED_M, MAX_DISPLACEMENT_M, MAX_DISPLACEMENT_RATE_M_PER_S,
    MAX_POSITION_M, MAX_ROLL_RAD, MAX_TENDONS, MAX_TENSION_N, Pose,
};
use thiserror::Error;

use crate::cdr::{self, Order};
use crate::commander::Motion;
use crate::msg::{JointState, JointTrajectory, PoseStamped, StringStamped, Time};
use crate::robot::WORLD;
use crate::topics::{Input, TUBE_JOINT_NAMES, joint_names};
use crate::trajectory::{Trajectory, Waypoint};

/// Limit on commanded joint angles and rates (`hub::command_check`); the arm checks its own range.
const MAX_JOINT_RAD: f64 = core::f64::consts::TAU;
const MAX_JOINT_RATE_RAD_PER_S: f64 = core::f64::consts::TAU;
/// Largest deviation of a quaternion's length from 1, for publishers with single precision or printed digits.
const QUATERNION_TOLERANCE: f64 = 1e-3;
/// Longest accepted message in bytes.
pub const MAX_MESSAGE_BYTES: usize = 1 << 16;

/// The request of a message.
#[derive(Debug, Clone, PartialEq)]
pub enum Request {
    /// Motion of arm, tendons or burr.
    Move(Motion),
    /// A trajectory of the arm.
    Follow(Trajectory),
    /// A change of state.
    State(StateCommand),
    /// An X-ray with the C-arm at this pose.
    Take(Pose),
}

/// CRTK's state commands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StateCommand {
    /// Accept motion commands again.
    Enable,
    /// Stop arm, burr and tendon rates, and reject motion commands.
    Disable,
    /// Pause the run.
    Pause,
    /// Resume the run.
    Resume,
    /// No effect: the arm is always homed.
    Home,
    /// Return to the initial state.
    Reset,
}

/// Each state command, its word and its effect. `docs/ros2.md` lists them (a test compares).
pub const STATE_COMMANDS: [(StateCommand, &str, &str); 6] = [
    (
        StateCommand::Enable,
        "enable",
        "motion commands are accepted (the initial state); after `FAULT` the arm holds still and the \
         fault is cleared",
    ),
    (
        StateCommand::Disable,
        "disable",
        "arm, burr and tendon rates stop, the tension stays; motion commands are refused until `enable`",
    ),
    (
        StateCommand::Pause,
        "pause",
        "the run pauses: simulated time and `/clock` stop, motion commands are refused",
    ),
    (StateCommand::Resume, "resume", "the run continues"),
    (StateCommand::Home, "home", "nothing: a simulated arm is always homed"),
    (
        StateCommand::Reset,
        "reset",
        "arm, tool and bone return to their initial state and earlier motion commands are forgotten; \
         simulated time goes on (not in CRTK)",
    ),
];

/// Why a message was rejected.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum RequestError {
    /// The bytes are not a message of the topic's type.
    #[error("not a message of the topic's type ({0})")]
    Malformed(String),
    /// The message is too long.
    #[error("{0} bytes, expected at most {MAX_MESSAGE_BYTES}")]
    TooLong(usize),
    /// An array has the wrong number of entries.
    #[error("{field}: {given} entries, expected {expected}")]
    Length {
        /// The array.
        field: &'static str,
        /// Number of entries received.
        given: usize,
        /// Number of entries expected.
        expected: usize,
    },
    /// A name is not that of a joint, or is duplicated.
    #[error("name: {given}, expected each of {expected} once, or no names")]
    Name {
        /// The name.
        given: String,
        /// All names.
        expected: String,
    },
    /// A number is out of range, infinite or not a number.
    #[error("{field}: {value}, expected {lowest} to {highest}")]
    Range {
        /// The array and its entry.
        field: String,
        /// The number.
        value: f64,
        /// Its lowest value.
        lowest: f64,
        /// Its highest value.
        highest: f64,
    },
    /// The pose is in a frame other than the world.
    #[error("header.frame_id: {0}, expected {WORLD} or an empty string")]
    Frame(String),
    /// The quaternion is not a rotation.
    #[error("orientation: length {0}, expected 1")]
    Quaternion(f64),
    /// Unknown state command.
    #[error("unknown state command {0}; expected enable, disable, pause, resume, home or reset")]
    Word(String),
    /// A trajectory without points, or with times that do not increase.
    #[error("points: expected at least one, with `time_from_start` 0 or more and increasing")]
    Times,
    /// A trajectory in an exact run, in which each state needs its own command.
    #[error("exact runs (--lockstep) need one command per state: send `servo_jp`")]
    NotStepwise,
    /// Motion while the run is paused.
    #[error("the run is paused")]
    Paused,
    /// Motion after a `disable`.
    #[error("disabled; send state_command `enable` first")]
    Disabled,
}

/// The joints that messages can command.
#[derive(Debug, Clone, Copy)]
pub struct CommandedJoints<'a> {
    /// Names of the arm's joints, from base to flange.
    pub arm: &'a [String],
    /// Number of the tool's tendons.
    pub tendons: usize,
}

/// Reads a message of a topic that commands these joints.
///
/// # Errors
/// Why the message is rejected.
pub fn read(
    topic: Input,
    bytes: &[u8],
    order: Order,
    commanded: CommandedJoints,
) -> Result<Request, RequestError> {
    let CommandedJoints { arm, tendons } = commanded;
    if bytes.len() > MAX_MESSAGE_BYTES {
        return Err(RequestError::TooLong(bytes.len()));
    }
    let joints = || decode::<JointState>(bytes, order);
    let pose = || decode::<PoseStamped>(bytes, order).and_then(|message| pose_of(&message));
    let of_arm = |field, most: f64| values(&joints()?, field, arm, -most, most);
    let names = joint_names("tendon", tendons.min(MAX_TENDONS));
    let of_tendons = |field, lowest, highest| values(&joints()?, field, &names, lowest, highest);
    let motion = match topic {
        Input::ArmServoJp => Motion::ArmServoJp(of_arm(Field::Position, MAX_JOINT_RAD)?),
        Input::ArmMoveJp => Motion::ArmMoveJp(of_arm(Field::Position, MAX_JOINT_RAD)?),
        Input::ArmServoJv => Motion::ArmServoJv(of_arm(Field::Velocity, MAX_JOINT_RATE_RAD_PER_S)?),
        Input::ArmServoCp => Motion::ArmServoCp(pose()?),
        Input::ArmMoveCp => Motion::ArmMoveCp(pose()?),
        Input::TendonServoJf => Motion::TendonServoJf(of_tendons(Field::Effort, 0.0, MAX_TENSION_N)?),
        Input::TendonServoJp => {
            Motion::TendonServoJp(of_tendons(Field::Position, -MAX_DISPLACEMENT_M, MAX_DISPLACEMENT_M)?)
        }
        Input::TendonMoveJp => {
            Motion::TendonMoveJp(of_tendons(Field::Position, -MAX_DISPLACEMENT_M, MAX_DISPLACEMENT_M)?)
        }
        Input::TendonServoJv => {
            let limit = MAX_DISPLACEMENT_RATE_M_PER_S;
            Motion::TendonServoJv(of_tendons(Field::Velocity, -limit, limit)?)
        }
        Input::BurrServoJv => {
            let names = ["burr".to_owned()];
            let [speed] = values::<1>(&joints()?, Field::Velocity, &names, 0.0, MAX_BURR_SPEED_RAD_PER_S)?;
            Motion::BurrServoJv(speed)
        }
        Input::TubeMoveJp => {
            let names = TUBE_JOINT_NAMES.map(str::to_owned);
            let goal = values(&joints()?, Field::Position, &names, -MAX_ROLL_RAD, MAX_ROLL_RAD)?;
            let ([deployed, _], [lowest, highest]) = (goal, [0.0, MAX_DEPLOYED_M]);
            if !(lowest..=highest).contains(&deployed) {
                let field = "position of `deployed`".to_owned();
                return Err(RequestError::Range { field, value: deployed, lowest, highest });
            }
            Motion::TubeMoveJp(goal)
        }
        Input::ArmTrajectory => return trajectory(decode(bytes, order)?, arm),
        Input::CArmTake => return Ok(Request::Take(pose()?)),
        Input::StateCommand => return state_command(&decode::<StringStamped>(bytes, order)?),
    };
    Ok(Request::Move(motion))
}

/// Returns a message's stamp, with which the header of every input begins; `None` if it is truncated.
pub fn stamp(bytes: &[u8], order: Order) -> Option<Time> {
    cdr::decode(bytes, order).ok()
}

fn decode<T: serde::de::DeserializeOwned>(bytes: &[u8], order: Order) -> Result<T, RequestError> {
    cdr::decode(bytes, order).map_err(|error| RequestError::Malformed(error.to_string()))
}

fn trajectory(message: JointTrajectory, arm: &[String]) -> Result<Request, RequestError> {
    let mut points = Vec::with_capacity(message.points.len());
    for point in message.points {
        let named = JointState {
            name: message.joint_names.clone(),
            position: point.positions,
            ..JointState::default()
        };
        let joints_rad = values(&named, Field::Position, arm, -MAX_JOINT_RAD, MAX_JOINT_RAD)?;
        points.push(Waypoint { time_s: point.time_from_start.seconds(), joints_rad });
    }
    Trajectory::new(points).map(Request::Follow).ok_or(RequestError::Times)
}

fn state_command(message: &StringStamped) -> Result<Request, RequestError> {
    let asked = message.string.trim();
    let found = STATE_COMMANDS.iter().find(|(_, word, _)| *word == asked);
    let (command, ..) = found.ok_or_else(|| RequestError::Word(foreign_text::foreign(asked).to_string()))?;
    Ok(Request::State(*command))
}

#[derive(Debug, Clone, Copy)]
enum Field {
    Position,
    Velocity,
    Effort,
}

impl Field {
    fn of(self, message: &JointState) -> (&'static str, &[f64]) {
        match self {
            Field::Position => ("position", &message.position),
            Field::Velocity => ("velocity", &message.velocity),
            Field::Effort => ("effort", &message.effort),
        }
    }
}

/// Returns the field's numbers in the order of `names`. The message may name its joints in any order or, like
/// many CRTK programs, not at all. Entries after the last name are 0.
fn values<const N: usize>(
    message: &JointState,
    field: Field,
    names: &[String],
    lowest: f64,
    highest: f64,
) -> Result<[f64; N], RequestError> {
    let (label, given) = field.of(message);
    let expected = names.len().min(N);
    let wrong = |field, given| RequestError::Length { field, given, expected };
    if given.len() != expected {
        return Err(wrong(label, given.len()));
    }
    if !message.name.is_empty() && message.name.len() != expected {
        return Err(wrong("name", message.name.len()));
    }
    let mut sorted = [0.0; N];
    let mut seen = [false; N];
    for (index, &value) in given.iter().enumerate() {
        let place = match message.name.get(index) {
            None => Some(index),
            Some(name) => names.iter().position(|known| known == name),
        };
        let place = place.filter(|&place| !seen[place]).ok_or_else(|| {
            let given = message.name.get(index).map_or("", String::as_str);
            RequestError::Name { given: foreign_text::foreign(given).to_string(), expected: names.join(", ") }
        })?;
        // Written so that NaN fails.
        if !(lowest..=highest).contains(&value) {
            return Err(RequestError::Range { field: format!("{label}[{index}]"), value, lowest, highest });
        }
        (sorted[place], seen[place]) = (value, true);
    }
    Ok(sorted)
}

fn pose_of(message: &PoseStamped) -> Result<Pose, RequestError> {
    let frame = message.header.frame_id.trim_start_matches('/');
    if !frame.is_empty() && frame != WORLD {
        return Err(RequestError::Frame(foreign_text::foreign(frame).to_string()));
    }
    let position_m: [f64; 3] = message.pose.position.into();
    for (axis, value) in ["x", "y", "z"].into_iter().zip(position_m) {
        let (lowest, highest) = (-MAX_POSITION_M, MAX_POSITION_M);
        if !(lowest..=highest).contains(&value) {
            return Err(RequestError::Range { field: format!("position.{axis}"), value, lowest, highest });
        }
    }
    let turn = message.pose.orientation;
    let given = [turn.x, turn.y, turn.z, turn.w];
    let length = given.iter().map(|part| part * part).sum::<f64>().sqrt();
    // Written so that NaN fails.
    let is_rotation = (length - 1.0).abs() <= QUATERNION_TOLERANCE;
    if !is_rotation {
        return Err(RequestError::Quaternion(length));
    }
    Ok(Pose { position_m, orientation_xyzw: given.map(|part| part / length) })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::msg::{Header, JointTrajectoryPoint, Quaternion, RosPose, Vector3};
    use crate::topics::ARM_JOINT_NAMES;

    fn ask<T: serde::Serialize>(topic: Input, message: &T) -> Result<Request, RequestError> {
        let arm = ARM_JOINT_NAMES.map(str::to_owned);
        read(topic, &cdr::encode(message).unwrap(), Order::Little, CommandedJoints { arm: &arm, tendons: 1 })
    }

    fn joints(name: &[&str], position: &[f64]) -> JointState {
        let name = name.iter().map(|name| (*name).to_owned()).collect();
        JointState { name, position: position.to_vec(), ..JointState::default() }
    }

    #[test]
    fn joints_come_by_their_names_or_in_their_order() {
        let in_order = joints(&[], &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
        let wanted = Ok(Request::Move(Motion::ArmServoJp([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 0.0])));
        assert_eq!(ask(Input::ArmServoJp, &in_order), wanted);
        let mut backwards = ARM_JOINT_NAMES;
        backwards.reverse();
        let message = joints(&backwards, &[6.0, 5.0, 4.0, 3.0, 2.0, 1.0]);
        assert_eq!(ask(Input::ArmServoJp, &message), wanted);
    }

    #[test]
    fn wrong_names_lengths_and_numbers_are_refused_with_the_field() {
        let told = |topic, message: &JointState| ask(topic, message).unwrap_err().to_string();
        assert_eq!(told(Input::ArmMoveJp, &joints(&[], &[0.0; 5])), "position: 5 entries, expected 6");
        assert!(
            told(Input::ArmMoveJp, &joints(&["a"; 6], &[0.0; 6])).starts_with("name: a, expected each of")
        );
        let mut twice = ARM_JOINT_NAMES;
        twice[1] = twice[0];
        assert!(told(Input::ArmMoveJp, &joints(&twice, &[0.0; 6])).contains("shoulder_pan_joint"));
        let mut values = [0.0; 6];
        values[3] = f64::NAN;
        assert!(told(Input::ArmServoJp, &joints(&[], &values)).starts_with("position[3]: NaN, expected"));
        let force = JointState { effort: vec![-1.0], ..JointState::default() };
        assert_eq!(told(Input::TendonServoJf, &force), "effort[0]: -1, expected 0 to 60");
        let rate = |rate: f64| JointState { velocity: vec![rate], ..JointState::default() };
        let fast = told(Input::TendonServoJv, &rate(0.006));
        assert_eq!(fast, "velocity[0]: 0.006, expected -0.005 to 0.005");
        let wanted = Ok(Request::Move(Motion::TendonServoJv([-0.004, 0.0, 0.0, 0.0])));
        assert_eq!(ask(Input::TendonServoJv, &rate(-0.004)), wanted);
        let tube = |values: [f64; 2]| joints(&["roll", "deployed"], &values);
        assert_eq!(
            ask(Input::TubeMoveJp, &tube([-0.5, 0.02])),
            Ok(Request::Move(Motion::TubeMoveJp([0.02, -0.5])))
        );
        let [short, far] =
            [tube([0.0, -0.01]), tube([0.0, 0.6])].map(|message| told(Input::TubeMoveJp, &message));
        assert_eq!(short, "position of `deployed`: -0.01, expected 0 to 0.5");
        assert_eq!(far, "position of `deployed`: 0.6, expected 0 to 0.5");
        assert!(told(Input::TubeMoveJp, &tube([7.0, 0.0])).starts_with("position[0]: 7, expected -6.28"));
    }

    #[test]
    fn a_trajectory_names_its_joints_and_its_times_increase() {
        let point = |seconds: i32, positions: Vec<f64>| JointTrajectoryPoint {
            positions,
            time_from_start: Time { sec: seconds, nanosec: 500_000_000 },
            ..JointTrajectoryPoint::default()
        };
        let mut message = JointTrajectory {
            joint_names: ARM_JOINT_NAMES.iter().rev().map(|name| (*name).to_owned()).collect(),
            points: vec![point(0, vec![6.0, 5.0, 4.0, 3.0, 2.0, 1.0]), point(2, vec![0.0; 6])],
            ..JointTrajectory::default()
        };
        let Ok(Request::Follow(found)) = ask(Input::ArmTrajectory, &message) else { panic!() };
        assert_eq!(found.at(&[0.0; 7], 0.5), [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 0.0]);
        message.points.swap(0, 1);
        assert_eq!(ask(Input::ArmTrajectory, &message), Err(RequestError::Times));
        message.points[0].positions.pop();
        let short = ask(Input::ArmTrajectory, &message).unwrap_err().to_string();
        assert_eq!(short, "position: 5 entries, expected 6");
    }

    #[test]
    fn a_pose_is_in_the_world_and_a_rotation() {
        let mut message = PoseStamped {
            header: Header::default(),
            pose: RosPose {
                position: Vector3 { x: 0.1, y: 0.0, z: 0.0 },
                orientation: Quaternion { x: 0.0, y: 0.0, z: 0.0, w: 1.0005 },
            },
        };
        let Ok(Request::Move(Motion::ArmServoCp(pose))) = ask(Input::ArmServoCp, &message) else { panic!() };
        assert_eq!(pose.orientation_xyzw, [0.0, 0.0, 0.0, 1.0]);
        message.pose.orientation.w = 0.0;
        assert_eq!(ask(Input::ArmMoveCp, &message), Err(RequestError::Quaternion(0.0)));
        message.pose.orientation.w = 1.0;
        message.header.frame_id = "UR5/base".into();
        assert_eq!(ask(Input::ArmMoveCp, &message), Err(RequestError::Frame("UR5/base".into())));
    }

    #[test]
    fn state_commands_are_words() {
        let stamped = StringStamped {
            header: Header { stamp: Time { sec: 7, nanosec: 9 }, frame_id: "x".into() },
            string: "pause".into(),
        };
        let bytes = cdr::encode(&stamped).unwrap();
        assert_eq!(stamp(&bytes, Order::Little), Some(stamped.header.stamp));
        assert_eq!(stamp(&bytes[..7], Order::Little), None);
        let say = |word: &str| {
            ask(Input::StateCommand, &StringStamped { header: Header::default(), string: word.into() })
        };
        assert_eq!(say("pause"), Ok(Request::State(StateCommand::Pause)));
        assert_eq!(
            say("fly").unwrap_err().to_string(),
            "unknown state command fly; expected enable, disable, pause, resume, home or reset"
        );
    }

    proptest! {
        #[test]
        fn no_bytes_do_harm(bytes in proptest::collection::vec(any::<u8>(), 0..400), topic in 0..crate::topics::INPUTS.len(), big: bool) {
            let topic = crate::topics::INPUTS[topic].topic;
            let order = if big { Order::Big } else { Order::Little };
            let names = ARM_JOINT_NAMES.map(str::to_owned);
            let joints = CommandedJoints { arm: &names, tendons: 2 };
            if let Ok(Request::Move(Motion::ArmServoJp(values))) = read(topic, &bytes, order, joints) {
                prop_assert!(values.iter().all(|value| value.is_finite()));
            }
        }
    }
}
