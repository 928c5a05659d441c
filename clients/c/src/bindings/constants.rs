//! The constants that clients need, by name.

use ipc_types::command_check::{
    MAX_BURR_SPEED_RAD_PER_S, MAX_DISPLACEMENT_M, MAX_POSITION_M, MAX_SPEED_M_PER_S, MAX_TENSION_N,
};
use ipc_types::messages::*;

macro_rules! named {
    ($($name:ident),* $(,)?) => { &[$((stringify!($name), $name as u64)),*] };
}

/// Whole numbers: codes of fields and lengths of arrays.
pub(super) const WHOLE: &[(&str, u64)] = named![
    TENDON_NONE,
    TENDON_SERVO_JF,
    TENDON_SERVO_JP,
    TENDON_MOVE_JP,
    ARM_NONE,
    ARM_SERVO_JP,
    ARM_MOVE_JP,
    ARM_SERVO_CP,
    ARM_MOVE_CP,
    ARM_HOLD,
    BURR_NONE,
    BURR_SPEED,
    SOURCE_NONE,
    SOURCE_FRESH,
    SOURCE_HELD,
    SOURCE_SAFE,
    PART_SHAFT,
    PART_SEGMENT,
    PART_BURR,
    CONTROL_PAUSE,
    CONTROL_RESUME,
    CONTROL_STEP,
    CONTROL_RESET,
    CONTROL_STOP,
    PHASE_CONNECTING,
    PHASE_RUNNING,
    PHASE_PAUSED,
    PHASE_ENDED,
    SEVERITY_INFO,
    SEVERITY_WARNING,
    SEVERITY_ERROR,
    EVENT_COMMAND_REFUSED,
    EVENT_COMMAND_HELD,
    EVENT_SAFE_COMMAND,
    EVENT_MESSAGES_LOST,
    EVENT_RUN,
    EVENT_CONTROLLER,
    EVENT_REQUEST_REFUSED,
    SENDER_LAUNCHER,
    SENDER_PHYSICS,
    SENDER_DRR,
    SENDER_RECORDER,
    SENDER_CONTROLLER,
    MAX_JOINTS,
    MAX_CONTACTS,
    MAX_BODIES,
    MAX_TENDONS,
    ARM_JOINTS,
    MAX_CONTROLLERS,
];

/// Limits of what a command may ask for.
pub(super) const LIMITS: &[(&str, f64)] = &[
    ("MAX_TENSION_N", MAX_TENSION_N),
    ("MAX_DISPLACEMENT_M", MAX_DISPLACEMENT_M),
    ("MAX_BURR_SPEED_RAD_PER_S", MAX_BURR_SPEED_RAD_PER_S),
    ("MAX_POSITION_M", MAX_POSITION_M),
    ("MAX_SPEED_M_PER_S", MAX_SPEED_M_PER_S),
];
