use sim::SimError;
use thiserror::Error;

/// Why an FMU cannot be written, created or used.
#[derive(Debug, Error)]
pub enum FmuError {
    /// The simulation refuses it.
    #[error(transparent)]
    Sim(#[from] SimError),
    /// A file cannot be read.
    #[error("{path}: {reason}")]
    File {
        /// The file.
        path: String,
        /// Reason.
        reason: String,
    },
    /// The FMU belongs to another export.
    #[error(
        "the token `{given}` is not that of the scene in the FMU's resources, `{expected}`: export the FMU again"
    )]
    Token {
        /// Token of the model description.
        given: String,
        /// Token of the resources.
        expected: String,
    },
    /// A handle is unknown.
    #[error("unknown or freed {what}")]
    Handle {
        /// Kind of handle.
        what: &'static str,
    },
    /// A pointer is null.
    #[error("`{0}` is a null pointer")]
    Null(&'static str),
    /// A text is not UTF-8.
    #[error("`{0}` is not UTF-8")]
    Text(&'static str),
    /// The scene has no variable of this reference and type.
    #[error("no {kind} variable with value reference {reference}")]
    NoVariable {
        /// Type of the variable.
        kind: &'static str,
        /// Value reference.
        reference: u32,
    },
    /// A variable cannot be set now.
    #[error("`{name}` cannot be set {when}")]
    NotSettable {
        /// Name of the variable.
        name: String,
        /// Why.
        when: &'static str,
    },
    /// A buffer has the wrong size.
    #[error("{given} values for {expected} elements")]
    Count {
        /// Values given.
        given: usize,
        /// Values needed.
        expected: usize,
    },
    /// A step is no number of whole ticks.
    #[error("a step of {step_s} s is not a whole number of ticks of {dt_s} s, 1 to {most}")]
    Step {
        /// Step asked for.
        step_s: f64,
        /// A tick.
        dt_s: f64,
        /// Most ticks in a step.
        most: u64,
    },
    /// The master's time is not the instance's.
    #[error("the communication point is {given_s} s, but the instance is at {own_s} s")]
    Time {
        /// The master's.
        given_s: f64,
        /// The instance's.
        own_s: f64,
    },
    /// A function in the wrong state of the instance.
    #[error("{0}")]
    Phase(&'static str),
    /// A function that this FMU does not offer.
    #[error("{0}: not offered by this FMU (its model description says so)")]
    Unsupported(&'static str),
    /// A panic was caught: a defect.
    #[error("internal error; see standard error")]
    Defect,
}
