//! Conversion of errors to the package's exceptions.

use pyo3::prelude::*;
use sim::SimError;

/// The package's exception for an error.
enum Kind {
    /// `ArgumentError`: another value would be accepted.
    Argument,
    /// `Error` with this constant of the package.
    Status(&'static str),
}

fn kind(error: &SimError) -> Kind {
    match error {
        SimError::Input(failure) if failure.code != ipc_types::process::EXIT_BAD_INPUT => {
            Kind::Status("ERROR_ABSENT")
        }
        SimError::Input(_)
        | SimError::Calibration(_)
        | SimError::Refused { .. }
        | SimError::CommandCount { .. }
        | SimError::NoController { .. }
        | SimError::NoSignal { .. }
        | SimError::StateVector(_)
        | SimError::Packed(_)
        | SimError::OtherScene
        | SimError::OtherTruth { .. }
        | SimError::NotInLog { .. }
        | SimError::NoContinuation { .. }
        | SimError::Count { .. }
        | SimError::NoSimulation { .. }
        | SimError::Threads { .. }
        | SimError::ArmMesh(_)
        | SimError::XRay(_) => Kind::Argument,
        SimError::NoXRay | SimError::Log(_) | SimError::Output(_) | SimError::SceneText(_) => {
            Kind::Status("ERROR_ABSENT")
        }
        SimError::Recording { .. } | SimError::RecordingLate { .. } | SimError::RecordingElsewhere => {
            Kind::Status("ERROR_BUSY")
        }
        SimError::Forked => Kind::Status("ERROR_FORKED"),
        SimError::Physics { .. } | SimError::Differs { .. } | SimError::Gone | SimError::GivenUp { .. } => {
            Kind::Status("ERROR_DEFECT")
        }
    }
}

/// Converts an error to the package's exception.
pub(crate) fn raised(py: Python<'_>, error: &SimError) -> PyErr {
    let made = match kind(error) {
        Kind::Argument => argument(py, &error.to_string()),
        Kind::Status(status) => {
            let status = py.import("trabecula._generated").and_then(|module| module.getattr(status));
            let class = py.import("trabecula._errors").and_then(|module| module.getattr("Error"));
            status.and_then(|status| class?.call1((status, error.to_string())))
        }
    };
    made.map_or_else(|broken| broken, PyErr::from_value)
}

/// Creates an `ArgumentError`, for an argument of the wrong size or value.
pub(crate) fn refused(py: Python<'_>, text: &str) -> PyErr {
    argument(py, text).map_or_else(|broken| broken, PyErr::from_value)
}

fn argument<'py>(py: Python<'py>, text: &str) -> PyResult<Bound<'py, PyAny>> {
    py.import("trabecula._errors")?.getattr("ArgumentError")?.call1((text,))
}
