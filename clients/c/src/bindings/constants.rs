//! The constants that clients need, by name.

use ipc_types::messages::*;

macro_rules! named {
    ($($name:ident),* $(,)?) => { &[$((stringify!($name), $name as u64)),*] };
}

/// Integers: codes of fields and lengths of arrays.
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
    ARM_SERVO_JV,
    ARM_INSERT,
    ARM_RCM,
    ARM_MOVING,
    ARM_DONE,
    ARM_FAULT,
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
    CONTROL_DONE,
    CONTROL_REFUSED,
    GEOMETRY_SCENE,
    GEOMETRY_REQUEST,
    DRR_ACCEPTED,
    DRR_REFUSED,
    DRR_BUSY,
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

/// Limits of command values.
pub(super) const LIMITS: &[(&str, f64)] = &[
    ("MAX_TENSION_N", MAX_TENSION_N),
    ("MAX_DISPLACEMENT_M", MAX_DISPLACEMENT_M),
    ("MAX_BURR_SPEED_RAD_PER_S", MAX_BURR_SPEED_RAD_PER_S),
    ("MAX_POSITION_M", MAX_POSITION_M),
    ("MAX_SPEED_M_PER_S", MAX_SPEED_M_PER_S),
    ("MAX_DEPTH_M", MAX_DEPTH_M),
];

#[cfg(test)]
mod tests {
    use super::*;

    /// C, C++, Python and Zig must get all codes, such as those of `servo_jv`, `insert` and `rcm`.
    #[test]
    fn every_code_of_a_message_has_its_name_in_every_language() {
        let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../messages/src");
        let mut codes = 0;
        for entry in std::fs::read_dir(folder).unwrap() {
            let text = std::fs::read_to_string(entry.unwrap().path()).unwrap();
            let names =
                text.lines().filter_map(|line| line.strip_prefix("pub const ")?.split_once(": u32 = "));
            for (name, value) in names {
                let value = value.trim_end_matches(';').parse().unwrap();
                assert!(
                    WHOLE.contains(&(name, value)),
                    "{name} = {value} is not among the bindings' constants"
                );
                codes += 1;
            }
        }
        assert!(codes >= 50, "{codes} codes found");
    }
}
