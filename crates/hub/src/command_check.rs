//! Checks a command before it reaches the model.

use thiserror::Error;

use messages::{
    ArmMode, BodyMode, BurrMode, Command, MAX_BODY_FORCE_N, MAX_BODY_TORQUE_NM, MAX_BURR_SPEED_RAD_PER_S,
    MAX_DEPLOYED_M, MAX_DEPTH_M, MAX_DISPLACEMENT_M, MAX_DISPLACEMENT_RATE_M_PER_S, MAX_POSITION_M,
    MAX_ROLL_RAD, MAX_SPEED_M_PER_S, MAX_TENSION_N, Pose, TendonMode, Tick, TubeMode, UnknownCode,
};
use scene::Drives;

const MAX_JOINT_RAD: f64 = core::f64::consts::TAU;
const MAX_JOINT_RATE_RAD_PER_S: f64 = core::f64::consts::TAU;
/// Tolerance for the length of a quaternion, which is stored rounded: far above rounding and far below any
/// real mistake.
const QUATERNION_TOLERANCE: f64 = 1e-6;
const BASE: [&str; 2] = ["t_world_base.position_m", "t_world_base.orientation_xyzw"];
const BODY: [&str; 2] = ["t_world_body_goal.position_m", "t_world_body_goal.orientation_xyzw"];

/// Why a command is refused. A refused command changes nothing.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum CommandRefusal {
    /// A number is not finite or out of range.
    #[error("`{field}` is {value}; allowed: {lowest} to {highest}")]
    OutOfRange {
        /// Field with its index.
        field: String,
        /// Value given.
        value: f64,
        /// Lowest allowed.
        lowest: f64,
        /// Highest allowed.
        highest: f64,
    },
    /// A number is not positive, or is above its range.
    #[error("`{field}` is {value}; allowed: above 0 and at most {highest}")]
    NotPositive {
        /// Field.
        field: &'static str,
        /// Value given.
        value: f64,
        /// Highest allowed.
        highest: f64,
    },
    /// A mode is unknown.
    #[error(transparent)]
    UnknownMode(#[from] UnknownCode),
    /// The orientation is not a unit quaternion.
    #[error("`{field}` has length {length}, expected 1")]
    NotAUnitQuaternion {
        /// Field.
        field: &'static str,
        /// Its length.
        length: f64,
    },
    /// The axis of an insertion is not a unit vector.
    #[error("`arm_axis` has length {length}, expected 1")]
    NotAUnitVector {
        /// Its length.
        length: f64,
    },
    /// The scene assigns this part of the tool to another controller, or to no controller.
    #[error(
        "`{field}` drives the {part}, which the scene does not assign to this controller; add it to the \
         controller's `drives`"
    )]
    NotItsPart {
        /// Field.
        field: &'static str,
        /// Part of the tool.
        part: &'static str,
    },
    /// The sequence number does not increase.
    #[error("`sequence` is {sequence}, expected more than {last}")]
    OldSequence {
        /// Number given.
        sequence: u64,
        /// Newest accepted number.
        last: u64,
    },
    /// The command answers an older state than an earlier command did.
    #[error("`state_tick` is {state_tick}, but an earlier command of this connection answered {last}")]
    PastState {
        /// Tick given.
        state_tick: Tick,
        /// Tick of the newest accepted command.
        last: Tick,
    },
    /// The command answers a state that does not exist yet.
    #[error("`state_tick` is {state_tick}, but the newest state is {newest}")]
    FutureState {
        /// Tick given.
        state_tick: Tick,
        /// Newest tick.
        newest: Tick,
    },
}

fn range(field: impl Fn() -> String, value: f64, lowest: f64, highest: f64) -> Result<(), CommandRefusal> {
    // Written so that NaN fails.
    if value >= lowest && value <= highest {
        return Ok(());
    }
    Err(CommandRefusal::OutOfRange { field: field(), value, lowest, highest })
}

fn ranges(name: &str, values: &[f64], lowest: f64, highest: f64) -> Result<(), CommandRefusal> {
    values
        .iter()
        .enumerate()
        .try_for_each(|(i, value)| range(|| format!("{name}[{i}]"), *value, lowest, highest))
}

/// Checks ranges, modes, order and authority. `last_sequence` is the number of the newest accepted command (0
/// before the first), `newest_tick` the tick of the newest state.
///
/// # Errors
/// The first [`CommandRefusal`] found.
pub fn check(
    command: &Command,
    drives: &[Drives],
    last_sequence: u64,
    newest_tick: Tick,
) -> Result<(), CommandRefusal> {
    if command.sequence <= last_sequence {
        return Err(CommandRefusal::OldSequence { sequence: command.sequence, last: last_sequence });
    }
    let state_tick = Tick(command.state_tick);
    if state_tick > newest_tick {
        return Err(CommandRefusal::FutureState { state_tick, newest: newest_tick });
    }
    let modes = Modes::of(command)?;
    check_authority(&modes, drives)?;
    check_values(command, &modes)
}

/// The modes of a command, one for each part of the tool.
struct Modes {
    tendon: TendonMode,
    arm: ArmMode,
    burr: BurrMode,
    tube: TubeMode,
    body: BodyMode,
}

impl Modes {
    fn of(command: &Command) -> Result<Modes, CommandRefusal> {
        Ok(Modes {
            tendon: command.tendon_mode()?,
            arm: command.arm_mode()?,
            burr: command.burr_mode()?,
            tube: command.tube_mode()?,
            body: command.body_mode()?,
        })
    }
}

fn check_authority(modes: &Modes, drives: &[Drives]) -> Result<(), CommandRefusal> {
    let asked = [
        (modes.tendon != TendonMode::None, Drives::Tendon, "tendon_mode", "tendons"),
        (modes.arm != ArmMode::None, Drives::Arm, "arm_mode", "arm"),
        (modes.burr != BurrMode::None, Drives::Burr, "burr_mode", "burr"),
        (modes.tube != TubeMode::None, Drives::Tube, "tube_mode", "tube"),
        (modes.body != BodyMode::None, Drives::Body, "body_mode", "bodies"),
    ];
    match asked.into_iter().find(|(is_asked, part, ..)| *is_asked && !drives.contains(part)) {
        Some((_, _, field, part)) => Err(CommandRefusal::NotItsPart { field, part }),
        None => Ok(()),
    }
}

fn check_values(command: &Command, modes: &Modes) -> Result<(), CommandRefusal> {
    match modes.tendon {
        TendonMode::ServoJf => ranges("tendon_force_n", &command.tendon_force_n, 0.0, MAX_TENSION_N)?,
        TendonMode::ServoJp | TendonMode::MoveJp => {
            let limit = MAX_DISPLACEMENT_M;
            ranges("tendon_displacement_m", &command.tendon_displacement_m, -limit, limit)?;
        }
        TendonMode::ServoJv => {
            let limit = MAX_DISPLACEMENT_RATE_M_PER_S;
            ranges("tendon_velocity_m_per_s", &command.tendon_velocity_m_per_s, -limit, limit)?;
        }
        TendonMode::None => {}
    }
    match modes.arm {
        ArmMode::ServoJp | ArmMode::MoveJp => {
            ranges("arm_joint_position_rad", &command.arm_joint_position_rad, -MAX_JOINT_RAD, MAX_JOINT_RAD)?;
        }
        ArmMode::ServoJv => {
            let limit = MAX_JOINT_RATE_RAD_PER_S;
            ranges("arm_joint_velocity_rad_per_s", &command.arm_joint_velocity_rad_per_s, -limit, limit)?;
        }
        ArmMode::ServoCp | ArmMode::MoveCp => check_pose(BASE, &command.t_world_base)?,
        ArmMode::Insert => check_insertion(command)?,
        ArmMode::Rcm => {
            check_pose(BASE, &command.t_world_base)?;
            ranges("arm_pivot_m", &command.arm_pivot_m, -MAX_POSITION_M, MAX_POSITION_M)?;
        }
        ArmMode::None | ArmMode::Hold => {}
    }
    if modes.tube == TubeMode::MoveJp {
        range(|| "tube_deployed_m".to_owned(), command.tube_deployed_m, 0.0, MAX_DEPLOYED_M)?;
        range(|| "tube_roll_rad".to_owned(), command.tube_roll_rad, -MAX_ROLL_RAD, MAX_ROLL_RAD)?;
    }
    match modes.body {
        BodyMode::ServoCf => {
            let (wrench, force, torque) = (&command.body_wrench, MAX_BODY_FORCE_N, MAX_BODY_TORQUE_NM);
            ranges("body_wrench.force_n", &wrench.force_n, -force, force)?;
            ranges("body_wrench.torque_nm", &wrench.torque_nm, -torque, torque)?;
        }
        BodyMode::ServoCp => check_pose(BODY, &command.t_world_body_goal)?,
        BodyMode::None => {}
    }
    range(|| "tube_speed_m_per_s".to_owned(), command.tube_speed_m_per_s, 0.0, MAX_SPEED_M_PER_S)?;
    range(|| "arm_speed_m_per_s".to_owned(), command.arm_speed_m_per_s, 0.0, MAX_SPEED_M_PER_S)?;
    let field = || "burr_speed_rad_per_s".to_owned();
    range(field, command.burr_speed_rad_per_s, 0.0, MAX_BURR_SPEED_RAD_PER_S)
}

fn check_insertion(command: &Command) -> Result<(), CommandRefusal> {
    ranges("arm_axis", &command.arm_axis, -1.1, 1.1)?;
    let length = command.arm_axis.iter().map(|x| x * x).sum::<f64>().sqrt();
    if (length - 1.0).abs() > QUATERNION_TOLERANCE {
        return Err(CommandRefusal::NotAUnitVector { length });
    }
    range(|| "arm_depth_m".to_owned(), command.arm_depth_m, -MAX_DEPTH_M, MAX_DEPTH_M)?;
    // An insertion at speed 0 would never arrive. Written so that NaN fails.
    let (value, highest) = (command.arm_speed_m_per_s, MAX_SPEED_M_PER_S);
    if value > 0.0 && value <= highest {
        return Ok(());
    }
    Err(CommandRefusal::NotPositive { field: "arm_speed_m_per_s", value, highest })
}

/// Checks a pose; `fields` are the names of its position and its orientation.
fn check_pose(fields: [&'static str; 2], pose: &Pose) -> Result<(), CommandRefusal> {
    let [position, field] = fields;
    ranges(position, &pose.position_m, -MAX_POSITION_M, MAX_POSITION_M)?;
    ranges(field, &pose.orientation_xyzw, -1.1, 1.1)?;
    let length = pose.orientation_xyzw.iter().map(|x| x * x).sum::<f64>().sqrt();
    if (length - 1.0).abs() > QUATERNION_TOLERANCE {
        return Err(CommandRefusal::NotAUnitQuaternion { field, length });
    }
    Ok(())
}
