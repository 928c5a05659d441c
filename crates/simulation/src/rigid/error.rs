//! Errors of building a rigid scene.

/// Errors of [`super::RigidScene::new`].
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RigidError {
    /// A value of a body is not finite or out of range.
    #[error("body `{body}`: `{field}` is {value}, expected {allowed}; correct it where the body is defined")]
    OutOfRange {
        /// The body's name.
        body: String,
        /// Name of the field.
        field: &'static str,
        /// The given value.
        value: f64,
        /// The accepted range, in words.
        allowed: &'static str,
    },
    /// The time step or gravity is invalid.
    #[error("rigid scene: `{field}` is {value}, expected {allowed}")]
    Scene {
        /// Name of the field.
        field: &'static str,
        /// The given value.
        value: f64,
        /// The accepted range, in words.
        allowed: &'static str,
    },
}
