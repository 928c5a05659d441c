//! Errors of device input.

use std::path::{Path, PathBuf};

use foreign_text::{foreign, foreign_path};
use thiserror::Error;
use trabecula_client::ClientError;

use super::DeviceKind;
use super::mapping::MappingError;
use crate::is_bad_input;

/// Why a device cannot drive a run.
#[derive(Debug, Error)]
pub enum DeviceError {
    /// The session cannot be joined, or was lost.
    #[error(transparent)]
    Client(#[from] ClientError),
    /// The mapping is refused.
    #[error(transparent)]
    Mapping(#[from] MappingError),
    /// There is no device of the kind.
    #[error(
        "no {kind} found; `trabecula device list` lists the devices, and --device takes a node under \
         /dev/input"
    )]
    NotFound {
        /// The kind.
        kind: DeviceKind,
    },
    /// There are several devices of the kind.
    #[error("several devices of kind {kind}: {}; choose one with --device", joined(nodes))]
    Several {
        /// The kind.
        kind: DeviceKind,
        /// Their nodes.
        nodes: Vec<PathBuf>,
    },
    /// This user may not read the device.
    #[error(
        "{}: permission denied; input devices belong to the group `input`: run `sudo usermod -aG input \
         $USER` and log in again",
        foreign_path(.path)
    )]
    Permission {
        /// The node.
        path: PathBuf,
    },
    /// A device, pipe or recording cannot be opened.
    #[error("{}: {source}", foreign_path(.path))]
    Open {
        /// The path.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// `--device` with a file, a folder, or a device with records of another kind (`js0`, `hidraw0`).
    #[error(
        "{}: neither an event device (/dev/input/event0 and so on) nor a pipe; play a recorded file with \
         --events",
        foreign_path(.path)
    )]
    NotADevice {
        /// The path.
        path: PathBuf,
    },
    /// `--events` with a file that is not a sequence of events.
    #[error(
        "{}: not a recording: expected at least one record of 24 bytes, and only whole ones, as \
         `cat /dev/input/event3` writes them",
        foreign_path(.path)
    )]
    NotARecording {
        /// The path.
        path: PathBuf,
    },
    /// The mapping drives only what the scene assigns to others.
    #[error(
        "controller {} drives none of the parts that the mapping moves; add one to its `drives`",
        foreign(.0)
    )]
    NothingToDrive(String),
    /// The mapping moves along the X-ray image, which the scene does not have.
    #[error("the mapping's frame is c_arm, but the scene has no `[drr]`; choose tool or patient")]
    NoCArm,
    /// The device has vanished.
    #[error("{device}: {why}; everything that it moved has been stopped")]
    Gone {
        /// The device.
        device: String,
        /// Why.
        why: String,
    },
}

impl DeviceError {
    /// Returns whether the user's input is at fault: no session, an unknown controller, a wrong mapping.
    pub fn is_bad_input(&self) -> bool {
        match self {
            DeviceError::Client(error) => is_bad_input(error),
            DeviceError::Gone { .. } => false,
            _ => true,
        }
    }

    /// A path cannot be opened.
    pub(super) fn open(path: &Path, source: std::io::Error) -> DeviceError {
        let path = path.to_owned();
        match source.kind() {
            std::io::ErrorKind::PermissionDenied if path.starts_with("/dev/input") => {
                DeviceError::Permission { path }
            }
            _ => DeviceError::Open { path, source },
        }
    }
}

fn joined(nodes: &[PathBuf]) -> String {
    nodes.iter().map(|node| foreign_path(node)).collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_denied_permission_names_the_group() {
        let denied = std::io::Error::from(std::io::ErrorKind::PermissionDenied);
        let error = DeviceError::open(Path::new("/dev/input/event3"), denied);
        assert!(error.is_bad_input());
        let text = error.to_string();
        assert!(
            text.starts_with("/dev/input/event3: permission denied;") && text.contains("usermod -aG input")
        );
    }
}
