//! The constants for clients, by name.

use ipc_types::messages::*;

macro_rules! named {
    ($($name:ident),* $(,)?) => { &[$((stringify!($name), $name as u64)),*] };
}

/// Integers other than field codes: senders, array lengths.
pub(super) fn lengths() -> Vec<(&'static str, u64)> {
    let senders = SENDERS.iter().map(|(name, number)| (*name, u64::from(*number)));
    senders.chain(LENGTHS.iter().copied()).collect()
}

/// Integers: field codes, senders, array lengths.
pub(super) fn whole() -> Vec<(&'static str, u64)> {
    let codes =
        CLIENT_CODES.iter().flat_map(|set| set.codes).map(|code| (code.constant, u64::from(code.number)));
    codes.chain(lengths()).collect()
}

const LENGTHS: &[(&str, u64)] = named![
    MAX_JOINTS,
    MAX_CONTACTS,
    MAX_BODIES,
    MAX_TENDONS,
    MAX_ARM_JOINTS,
    MAX_CONTROLLERS,
    MAX_SENSORS,
    MAX_SENSOR_VALUES,
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

    /// C, C++, Python and Zig must have all codes, such as those of `servo_jv`, `insert` and `rcm`.
    #[test]
    fn every_code_of_a_message_has_its_name_in_every_language() {
        let source =
            std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../crates/messages/src/codes.rs");
        let text = std::fs::read_to_string(source).unwrap();
        let declared = text.lines().filter_map(|line| {
            let (name, rest) = line.trim().split_once(" = ")?.1.split_once(", ")?;
            Some((name.to_owned(), rest.split_once(',')?.0.parse().ok()?))
        });
        let (whole, mut codes) = (whole(), 0);
        for (name, number) in declared {
            let known = whole.contains(&(name.as_str(), number));
            assert!(known, "{name} = {number} is not among the bindings' constants");
            codes += 1;
        }
        assert!(codes >= 45, "{codes} codes found");
    }
}
