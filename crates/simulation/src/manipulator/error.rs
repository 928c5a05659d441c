//! Errors of construction and stepping.

/// Why a manipulator rejected its input. A rejected step changes nothing.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum ManipulatorError {
    /// A scalar is out of range.
    #[error("manipulator `{field}` is {value}, expected {allowed}; correct it where the value is set")]
    OutOfRange {
        /// Name of the field.
        field: &'static str,
        /// The given value.
        value: f64,
        /// The accepted range, in words.
        allowed: &'static str,
    },
    /// An entry of a per-joint list is out of range.
    #[error(
        "manipulator `{field}[{index}]` is {value}, expected {allowed}; correct it where the list is set"
    )]
    EntryOutOfRange {
        /// Name of the list.
        field: &'static str,
        /// Index of the offending entry.
        index: usize,
        /// The given value.
        value: f64,
        /// The accepted range, in words.
        allowed: &'static str,
    },
    /// The length of a per-joint list does not match the joint list, or there are too few or too many joints.
    #[error("manipulator `{field}` has {given} entries, expected {expected}")]
    Length {
        /// Name of the list.
        field: &'static str,
        /// Number of entries given.
        given: usize,
        /// Number of entries accepted, in words.
        expected: &'static str,
    },
}

/// Checks that `value` is finite and that `accept` holds for it.
pub(super) fn check(
    field: &'static str,
    value: f64,
    allowed: &'static str,
    accept: impl Fn(f64) -> bool,
) -> Result<(), ManipulatorError> {
    if value.is_finite() && accept(value) {
        Ok(())
    } else {
        Err(ManipulatorError::OutOfRange { field, value, allowed })
    }
}

/// Checks that every entry of `values` is finite and that `accept` holds for it.
pub(super) fn check_all(
    field: &'static str,
    values: &[f64],
    allowed: &'static str,
    accept: impl Fn(f64) -> bool,
) -> Result<(), ManipulatorError> {
    for (index, &value) in values.iter().enumerate() {
        if !(value.is_finite() && accept(value)) {
            return Err(ManipulatorError::EntryOutOfRange { field, index, value, allowed });
        }
    }
    Ok(())
}
