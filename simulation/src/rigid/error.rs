//! What the construction of a rigid scene refuses.

/// Why [`super::RigidScene::new`] refused a body.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RigidError {
    /// A number of a body is not finite or outside what the model accepts.
    #[error("body `{body}`: `{field}` is {value}, expected {allowed}; correct it where the body is defined")]
    OutOfRange {
        /// The body's name.
        body: String,
        /// Name of the field.
        field: &'static str,
        /// The value that was given.
        value: f64,
        /// The range that is accepted, in words.
        allowed: &'static str,
    },
    /// The time step or gravity is not usable.
    #[error("rigid scene: `{field}` is {value}, expected {allowed}")]
    Scene {
        /// Name of the field.
        field: &'static str,
        /// The value that was given.
        value: f64,
        /// The range that is accepted, in words.
        allowed: &'static str,
    },
}
