//! Errors of building a rigid scene, and of driving its bodies.

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

/// Errors of [`super::RigidScene::drive`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum DriveError {
    /// The controller's entry in the scene names no body.
    #[error("the controller drives no body; set `controller.body`")]
    NoBody,
    /// A wrench on a body that does not move by forces.
    #[error("servo_cf needs a body whose `motion` is \"free\"; use servo_cp for a driven one")]
    NotFree,
    /// A pose of a body that moves by forces, or not at all.
    #[error("servo_cp needs a body whose `motion` is \"driven\"; use servo_cf for a free one")]
    NotDriven,
}
