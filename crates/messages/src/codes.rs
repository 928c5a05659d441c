//! The codes of `uint32` fields, each as an enum.
//!
//! A message carries a plain number, because any program can write any number. The receiver converts it once
//! when it takes the message off a port ([`Command::tendon_mode`](crate::Command::tendon_mode),
//! [`RunControl::action`](crate::RunControl::action), …) and decides there how to treat an unknown code; from
//! there on it is an enum. Clients of every language write the constants into the fields; enum and constants
//! come from one declaration.

use core::fmt::{self, Display, Formatter};

use thiserror::Error;

use crate::part::Part;
use crate::participant::Participant;
use crate::{
    AppliedCommand, Command, Contact, DrrReply, DrrRequest, Event, LatchedCommand, Progress, RunControl,
    RunControlReply, RunStatus, SensorReading, State,
};

/// One code of a field: its constant's name, its number, and its name in messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Code {
    /// Name of the constant, in every language.
    pub constant: &'static str,
    /// The number on the wire.
    pub number: u32,
    /// Its name in messages.
    pub word: &'static str,
}

/// A field's codes and the name of their enum.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CodeSet {
    /// Name of the enum.
    pub name: &'static str,
    /// Documentation of the enum.
    pub doc: &'static str,
    /// All codes, ascending.
    pub codes: &'static [Code],
}

/// A field of a message that holds a code.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CodeField {
    /// Name of the message.
    pub message: &'static str,
    /// Name of the field.
    pub field: &'static str,
    /// Name of the enum of its codes.
    pub codes: &'static str,
}

/// A field holds a number that is not one of its codes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[error("`{field}` is {number}, expected {}", Expected(.known))]
pub struct UnknownCode {
    /// Name of the field.
    pub field: &'static str,
    /// The invalid number.
    pub number: u32,
    /// The codes that the field may hold.
    pub known: &'static [Code],
}

/// Displays codes as a choice: `0 none, 1 servo_jf or 2 servo_jp`.
struct Expected<'c>(&'c [Code]);

impl Display for Expected<'_> {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let last = self.0.len().saturating_sub(1);
        for (index, code) in self.0.iter().enumerate() {
            let separator = match index {
                0 => "",
                _ if index == last => " or ",
                _ => ", ",
            };
            write!(f, "{separator}{} {}", code.number, code.word)?;
        }
        Ok(())
    }
}

/// Declares the codes of a field: the enum, and each code's wire constant.
macro_rules! codes {
    (
        $(#[doc = $doc:literal])*
        pub enum $name:ident of $field:literal {
            $( $(#[doc = $code_doc:literal])* $variant:ident = $constant:ident, $number:literal, $word:literal; )*
        }
    ) => {
        $(#[doc = $doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
        #[repr(u32)]
        pub enum $name {
            $( $(#[doc = $code_doc])* $variant = $number, )*
        }

        $(
            #[doc = concat!("[`", stringify!($name), "::", stringify!($variant), "`] on the wire.")]
            pub const $constant: u32 = $name::$variant.code();
        )*

        impl $name {
            /// All codes, ascending.
            pub const CODES: &'static [Code] = &[$(
                Code { constant: stringify!($constant), number: $number, word: $word },
            )*];

            /// The codes with the enum's name and documentation.
            pub const SET: CodeSet =
                CodeSet { name: stringify!($name), doc: concat!($($doc),*), codes: $name::CODES };

            /// Returns the number on the wire.
            pub const fn code(self) -> u32 {
                self as u32
            }

            /// Returns its name in messages.
            pub const fn word(self) -> &'static str {
                match self {
                    $( $name::$variant => $word, )*
                }
            }
        }

        impl TryFrom<u32> for $name {
            type Error = UnknownCode;

            fn try_from(number: u32) -> Result<$name, UnknownCode> {
                match number {
                    $( $number => Ok($name::$variant), )*
                    _ => Err(UnknownCode { field: $field, number, known: $name::CODES }),
                }
            }
        }
    };
}

codes! {
    /// Kind of sensor that a [`SensorReading`] comes from.
    pub enum SensorKind of "kind" {
        /// Curvature along the tool by fibre-Bragg gratings.
        Fbg = SENSOR_FBG, 1, "fbg";
        /// Pose by an electromagnetic or optical tracker.
        Tracker = SENSOR_TRACKER, 2, "tracker";
        /// Angles of the arm's joints.
        Encoders = SENSOR_ENCODERS, 3, "encoders";
        /// Tensions of the tendons.
        LoadCell = SENSOR_LOAD_CELL, 4, "load_cell";
        /// Force and torque at the flange.
        ForceTorque = SENSOR_FORCE_TORQUE, 5, "force_torque";
        /// Clearance of the tool from the critical structures of the scene.
        Clearance = SENSOR_CLEARANCE, 6, "clearance";
    }
}

codes! {
    /// Values of [`Command::tendon_mode`]: how the tendons are driven; CRTK verbs.
    pub enum TendonMode of "tendon_mode" {
        /// This command does not drive the tendons.
        None = TENDON_NONE, 0, "none";
        /// Tensions, held until the next command.
        ServoJf = TENDON_SERVO_JF, 1, "servo_jf";
        /// Displacements, held until the next command.
        ServoJp = TENDON_SERVO_JP, 2, "servo_jp";
        /// Displacement goals, reached with limited speed, acceleration and jerk.
        MoveJp = TENDON_MOVE_JP, 3, "move_jp";
        /// Rates of the displacements, held until the next command; a tendon stops at the end of its range.
        ServoJv = TENDON_SERVO_JV, 4, "servo_jv";
    }
}

codes! {
    /// Values of [`Command::arm_mode`] (requested) and [`State::arm_mode`] (in effect): how the arm is
    /// driven; CRTK verbs and a few more.
    pub enum ArmMode of "arm_mode" {
        /// This command does not drive the arm.
        None = ARM_NONE, 0, "none";
        /// Joint angles, tracked within the arm's limits.
        ServoJp = ARM_SERVO_JP, 1, "servo_jp";
        /// Joint goal, jerk-limited.
        MoveJp = ARM_MOVE_JP, 2, "move_jp";
        /// Tool base pose, tracked within the arm's limits.
        ServoCp = ARM_SERVO_CP, 3, "servo_cp";
        /// Tool base goal, reached along a straight line, jerk-limited.
        MoveCp = ARM_MOVE_CP, 4, "move_cp";
        /// Stop within the arm's limits and stay there.
        Hold = ARM_HOLD, 5, "hold";
        /// Joint velocities, held until the next command; a joint stops at the end of its range.
        ServoJv = ARM_SERVO_JV, 6, "servo_jv";
        /// Insert along an axis at a given feed rate, without rotating.
        Insert = ARM_INSERT, 7, "insert";
        /// Tool base goal with a remote centre of motion: the tool's axis passes through the pivot throughout
        /// the motion.
        Rcm = ARM_RCM, 8, "rcm";
    }
}

codes! {
    /// Values of [`Command::burr_mode`]: how the burr is driven.
    pub enum BurrMode of "burr_mode" {
        /// This command does not drive the burr.
        None = BURR_NONE, 0, "none";
        /// Run the burr at `burr_speed_rad_per_s`.
        Speed = BURR_SPEED, 1, "speed";
    }
}

codes! {
    /// Values of [`Command::tube_mode`]: how a tube that slides in an outer one is driven.
    pub enum TubeMode of "tube_mode" {
        /// This command does not drive the tube.
        None = TUBE_NONE, 0, "none";
        /// Length and roll, reached with limited speed, acceleration and jerk.
        MoveJp = TUBE_MOVE_JP, 1, "move_jp";
        /// Stop within the drive's limits and stay there.
        Hold = TUBE_HOLD, 2, "hold";
    }
}

codes! {
    /// Values of [`Command::body_mode`]: how a rigid body of the scene is driven; CRTK verbs.
    pub enum BodyMode of "body_mode" {
        /// This command does not drive a body.
        None = BODY_NONE, 0, "none";
        /// A wrench on a free body, held until the next command.
        ServoCf = BODY_SERVO_CF, 1, "servo_cf";
        /// The pose of a driven body, reached within the tick and held until the next command.
        ServoCp = BODY_SERVO_CP, 2, "servo_cp";
    }
}

codes! {
    /// [`State::arm_status`]: progress of the arm's motion.
    pub enum ArmStatus of "arm_status" {
        /// Moving.
        Moving = ARM_MOVING, 0, "moving";
        /// At its goal and at rest.
        Done = ARM_DONE, 1, "at its goal and at rest";
        /// The arm aborted its motion and stopped, or stopped a joint at the end of its range; an event gives
        /// the reason.
        Fault = ARM_FAULT, 2, "motion aborted or a joint stopped at the end of its range";
    }
}

codes! {
    /// [`State::arm_protective_stop`]: whether the arm stopped because the tool pressed too hard on its
    /// flange.
    pub enum ArmProtectiveStop of "arm_protective_stop" {
        /// Not stopped.
        None = PROTECTIVE_STOP_NONE, 0, "none";
        /// The arm stands still and accepts only `hold`.
        Stopped = PROTECTIVE_STOP_STOPPED, 1, "stopped";
        /// Released by `hold`: the arm can move away; the force is not yet below the limit.
        Released = PROTECTIVE_STOP_RELEASED, 2, "released";
    }
}

codes! {
    /// [`LatchedCommand::source`], [`AppliedCommand::source`]: the origin of the command in effect.
    pub enum CommandSource of "source" {
        /// No command has arrived yet; nothing is driven.
        None = SOURCE_NONE, 0, "none";
        /// A command that arrived in time for this tick.
        Fresh = SOURCE_FRESH, 1, "fresh";
        /// The previous command, held.
        Held = SOURCE_HELD, 2, "held";
        /// The scene's safe command: burr off, tension held, arm and tube held.
        Safe = SOURCE_SAFE, 3, "safe command";
    }
}

codes! {
    /// [`Contact::part`]: the part of the tool in contact.
    pub enum ContactPart of "part" {
        /// A sphere of the rigid shaft.
        Shaft = PART_SHAFT, 0, "shaft";
        /// A segment sphere.
        Segment = PART_SEGMENT, 1, "segment";
        /// The burr.
        Burr = PART_BURR, 2, "burr";
    }
}

codes! {
    /// [`RunControl::action`]: the requested action.
    pub enum ControlAction of "action" {
        /// Pause before the next tick until resumed; pending steps are cancelled.
        Pause = CONTROL_PAUSE, 1, "pause";
        /// Resume.
        Resume = CONTROL_RESUME, 2, "resume";
        /// While paused, run `ticks` ticks.
        Step = CONTROL_STEP, 3, "step";
        /// Reset the simulation to its initial state.
        Reset = CONTROL_RESET, 4, "reset";
        /// End the run.
        Stop = CONTROL_STOP, 5, "stop";
        /// Save the log of the last seconds and of the next `ticks` ticks (`recording.ring_s`).
        Save = CONTROL_SAVE, 6, "save";
    }
}

codes! {
    /// [`RunControlReply::status`]: the outcome of the request.
    pub enum ControlStatus of "status" {
        /// Done.
        Done = CONTROL_DONE, 0, "done";
        /// Unknown action, or not allowed now (a step while running).
        Refused = CONTROL_REFUSED, 1, "refused";
    }
}

codes! {
    /// [`DrrRequest::use_geometry`]: the C-arm geometry that the frame uses.
    pub enum GeometryChoice of "use_geometry" {
        /// The scene's C-arm.
        Scene = GEOMETRY_SCENE, 0, "the scene's C-arm";
        /// The C-arm in [`DrrRequest::geometry`].
        Request = GEOMETRY_REQUEST, 1, "`geometry`";
    }
}

codes! {
    /// [`DrrReply::status`]: the outcome of a frame request.
    pub enum DrrStatus of "status" {
        /// The frame follows.
        Accepted = DRR_ACCEPTED, 0, "accepted";
        /// Refused, for example an invalid geometry; no frame follows.
        Refused = DRR_REFUSED, 1, "refused";
        /// Too many requests are waiting; no frame follows.
        Busy = DRR_BUSY, 2, "busy";
    }
}

codes! {
    /// [`RunStatus::phase`]: the phase of the run. Phases only increase, except when a pause ends.
    pub enum Phase of "phase" {
        /// Waiting for the parts to connect.
        Connecting = PHASE_CONNECTING, 0, "connecting";
        /// Ticks are running.
        Running = PHASE_RUNNING, 1, "running";
        /// No ticks until resumed.
        Paused = PHASE_PAUSED, 2, "paused";
        /// The last tick is done; every part ends.
        Ended = PHASE_ENDED, 3, "ended";
    }
}

codes! {
    /// [`Event::severity`].
    pub enum Severity of "severity" {
        /// Information.
        Info = SEVERITY_INFO, 0, "information";
        /// Something was refused or lost; the run continues.
        Warning = SEVERITY_WARNING, 1, "warning";
        /// The run ends.
        Error = SEVERITY_ERROR, 2, "error";
    }
}

codes! {
    /// [`Event::code`]: the kind of event.
    pub enum EventCode of "code" {
        /// A command was refused; `text` names the field and the reason.
        CommandRefused = EVENT_COMMAND_REFUSED, 1, "command_refused";
        /// A controller was late; its last command is held.
        CommandHeld = EVENT_COMMAND_HELD, 2, "command_held";
        /// A controller has been late for longer than the scene allows; the safe command applies.
        SafeCommand = EVENT_SAFE_COMMAND, 3, "safe_command";
        /// Messages were lost; `text` gives the kind and number.
        MessagesLost = EVENT_MESSAGES_LOST, 4, "messages_lost";
        /// A part of the run connected, or the run was paused, resumed or stopped.
        Run = EVENT_RUN, 5, "run";
        /// A controller's own message.
        Controller = EVENT_CONTROLLER, 6, "controller";
        /// A frame request was refused.
        RequestRefused = EVENT_REQUEST_REFUSED, 7, "request_refused";
        /// A capacity was reached during the run; `text` names it and the consequence.
        CapacityReached = EVENT_CAPACITY_REACHED, 8, "capacity_reached";
        /// The run waits for a controller; `text` names it and the time limit.
        Waiting = EVENT_WAITING, 9, "waiting";
        /// The run ends: a controller did not join in time.
        ControllerMissing = EVENT_CONTROLLER_MISSING, 10, "controller_missing";
        /// The run ends: in lockstep, a controller did not answer in time.
        ControllerLate = EVENT_CONTROLLER_LATE, 11, "controller_late";
        /// The simulation was reset before this tick; `text` gives the tick that began from the initial
        /// state.
        Reset = EVENT_RESET, 12, "reset";
        /// The run ends: the simulation could not compute a tick, or its result is not a valid state of the
        /// tool; `text` gives the tick and the reason.
        SimulationFailed = EVENT_SIMULATION_FAILED, 13, "simulation_failed";
        /// A link of the arm, the holder or the shaft behind the tool's base has entered bone, where there is
        /// no collision; `text` gives the part and the depth.
        ArmInBone = EVENT_ARM_IN_BONE, 14, "arm_in_bone";
        /// The model of the tool is invalid from here on, because a flexure is past its stop; `text` gives
        /// the flexure and the excess.
        ModelNotValid = EVENT_MODEL_NOT_VALID, 15, "model_not_valid";
        /// A tick created energy beyond the error of the integrator, the first in this run: from here on,
        /// forces and motions may not be physical; `text` gives the energy.
        EnergyCreated = EVENT_ENERGY_CREATED, 16, "energy_created";
        /// The burr or the tube has left the bone elsewhere than through the hole that it came by; `text`
        /// gives the part, the place and the direction.
        Breach = EVENT_BREACH, 17, "breach";
        /// The arm stopped because the tool pushed its flange too hard or came too close to a critical
        /// structure; `text` gives the cause.
        ProtectiveStop = EVENT_PROTECTIVE_STOP, 18, "protective_stop";
        /// The tool has come closer to a critical structure than its margin; `text` gives structure, part,
        /// place and clearance.
        StructureMargin = EVENT_STRUCTURE_MARGIN, 19, "structure_margin";
        /// The tool has entered a critical structure; `text` gives structure, part, place and depth.
        StructureBreach = EVENT_STRUCTURE_BREACH, 20, "structure_breach";
        /// The recorder saves the ticks before and after a trigger (`recording.ring_s`); `text` names the log
        /// and the trigger.
        LogSaved = EVENT_LOG_SAVED, 21, "log_saved";
    }
}

/// Every code that a client needs, in the order of the client libraries' constants.
pub const CLIENT_CODES: &[CodeSet] = &[
    TendonMode::SET,
    ArmMode::SET,
    ArmStatus::SET,
    ArmProtectiveStop::SET,
    BurrMode::SET,
    TubeMode::SET,
    BodyMode::SET,
    CommandSource::SET,
    ContactPart::SET,
    ControlAction::SET,
    ControlStatus::SET,
    GeometryChoice::SET,
    DrrStatus::SET,
    Phase::SET,
    SensorKind::SET,
    Severity::SET,
    EventCode::SET,
];

/// Declares the conversion of message fields that hold a code.
macro_rules! fields {
    ($( $message:ident { $( $field:ident: $codes:ident ),* } )*) => {
        /// Every field of a message that holds a code.
        pub const CODE_FIELDS: &[CodeField] = &[$($(
            CodeField {
                message: stringify!($message),
                field: stringify!($field),
                codes: stringify!($codes),
            },
        )*)*];

        $( impl $message { $(
            #[doc = concat!("The code in `", stringify!($field), "`.")]
            ///
            /// # Errors
            /// If the field holds a number that is not one of its codes.
            pub fn $field(&self) -> Result<$codes, UnknownCode> {
                $codes::try_from(self.$field)
            }
        )* } )*
    };
}

fields! {
    Command {
        tendon_mode: TendonMode, arm_mode: ArmMode, burr_mode: BurrMode, tube_mode: TubeMode,
        body_mode: BodyMode
    }
    LatchedCommand { source: CommandSource }
    AppliedCommand { source: CommandSource }
    Contact { part: ContactPart }
    State { arm_mode: ArmMode, arm_status: ArmStatus, arm_protective_stop: ArmProtectiveStop }
    RunControl { action: ControlAction }
    RunControlReply { action: ControlAction, status: ControlStatus }
    SensorReading { kind: SensorKind }
    RunStatus { phase: Phase }
    DrrRequest { use_geometry: GeometryChoice }
    DrrReply { status: DrrStatus }
    Event { severity: Severity, code: EventCode }
}

impl Event {
    /// Returns the sender; `None` if the number is not a sender's.
    pub fn sender(&self) -> Option<Participant> {
        Participant::of(self.sender)
    }
}

impl Progress {
    /// Returns the reporting part; `None` if the number is not a part's.
    pub fn consumer(&self) -> Option<Part> {
        match Participant::of(self.consumer) {
            Some(Participant::Part(part)) => Some(part),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layout::{Description, Message};

    fn doc(description: &Description, field: &str) -> &'static str {
        description.fields.iter().find(|other| other.name == field).unwrap().doc
    }

    #[test]
    fn every_code_converts_to_its_enum_and_back_and_no_other_number_does() {
        for number in 0..9 {
            assert_eq!(ArmMode::try_from(number).map(ArmMode::code), Ok(number));
        }
        let unknown = ArmMode::try_from(9).unwrap_err();
        assert_eq!((unknown.field, unknown.number), ("arm_mode", 9));
        let unknown = Command { tendon_mode: 5, ..Command::zeroed() }.tendon_mode().unwrap_err();
        let want = "`tendon_mode` is 5, expected 0 none, 1 servo_jf, 2 servo_jp, 3 move_jp or 4 servo_jv";
        assert_eq!(unknown.to_string(), want);
        assert_eq!(ControlAction::try_from(0).map_err(|unknown| unknown.number), Err(0));
    }

    /// The message reference prints these docs.
    #[test]
    fn the_documentation_of_a_field_lists_its_codes() {
        let fields = [
            (Command::DESCRIPTION, "tendon_mode", TendonMode::CODES),
            (Command::DESCRIPTION, "arm_mode", ArmMode::CODES),
            (Command::DESCRIPTION, "burr_mode", BurrMode::CODES),
            (Command::DESCRIPTION, "tube_mode", TubeMode::CODES),
            (Command::DESCRIPTION, "body_mode", BodyMode::CODES),
            (LatchedCommand::DESCRIPTION, "source", CommandSource::CODES),
            (AppliedCommand::DESCRIPTION, "source", CommandSource::CODES),
            (Contact::DESCRIPTION, "part", ContactPart::CODES),
            (State::DESCRIPTION, "arm_status", ArmStatus::CODES),
            (State::DESCRIPTION, "arm_protective_stop", ArmProtectiveStop::CODES),
            (RunControl::DESCRIPTION, "action", ControlAction::CODES),
            (RunControlReply::DESCRIPTION, "status", ControlStatus::CODES),
            (SensorReading::DESCRIPTION, "kind", SensorKind::CODES),
            (RunStatus::DESCRIPTION, "phase", Phase::CODES),
            (DrrRequest::DESCRIPTION, "use_geometry", GeometryChoice::CODES),
            (DrrReply::DESCRIPTION, "status", DrrStatus::CODES),
            (Event::DESCRIPTION, "severity", Severity::CODES),
        ];
        for (message, field, codes) in fields {
            let listed: Vec<String> =
                codes.iter().map(|code| format!("{} {}", code.number, code.word)).collect();
            let text = doc(message, field);
            assert!(text.contains(&listed.join(", ")), "{}.{field}: {text}", message.name);
        }
    }
}
