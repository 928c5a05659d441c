//! The complete simulation state as bytes: the content of a log's keyframe.
//!
//! A keyframe holds everything that a tick changes and that a later tick depends on: the state message with
//! its hash, the arm's motion (segment and age, from which Ruckig replans the same trajectory), joint angles,
//! tendons, the contact solver's warm start, the strength of every touched voxel, the rigid bodies' world
//! with its contacts, and the sensors' drift, filters and readings in progress. A new process that builds the
//! same scene and reads these bytes computes the same ticks, bit for bit.
//!
//! The bytes are a function of the scene and of u_0 … u_k, so replay compares them too.

use messages::State;
use serde::{Serialize, Serializer};
use thiserror::Error;
use zerocopy::{FromBytes, IntoBytes};

use super::receding::RecessionState;
use super::{
    BurrDriveState, Simulation, SimulationError, SimulationSnapshot, TendonDriveState, TubeDriveState,
};
use crate::arm::{ArmSnapshot, Compliance, ComplianceState};
use crate::bone::BoneSnapshot;
use crate::manipulator::{ManipulatorModel, ManipulatorState};
use crate::rigid::{RigidScene, RigidSnapshot};

/// Errors of writing and reading a keyframe.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum KeyframeError {
    /// The buffer is too short because drilling has touched too many voxels.
    #[error("larger than the {given} bytes available; this tick has no keyframe")]
    TooLong {
        /// Size of the buffer.
        given: usize,
    },
    /// The bytes are not a keyframe.
    #[error("malformed or written by another build ({cause}); use the build that wrote it")]
    Unreadable {
        /// What could not be read.
        cause: String,
    },
    /// The keyframe is from another scene.
    #[error("{what} do not match this scene; use the scene that it was written with")]
    OtherScene {
        /// What does not match.
        what: &'static str,
    },
}

/// Serialises bytes as one block.
struct Bytes<'a>(&'a [u8]);

impl Serialize for Bytes<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_bytes(self.0)
    }
}

impl Simulation<'_> {
    /// Writes the current state into `buffer` and returns the number of bytes used. Allocates nothing; takes
    /// time in proportion to the number of voxel blocks that drilling has touched.
    ///
    /// # Errors
    /// [`KeyframeError::TooLong`].
    pub fn write_keyframe(&self, buffer: &mut [u8]) -> Result<usize, KeyframeError> {
        let given = buffer.len();
        let whole = (
            Bytes(self.state.as_bytes()),
            (self.arm.snapshot(), self.compliance.as_ref().map(Compliance::state)),
            self.manipulator.state(),
            self.bone.as_ref().map(|bone| bone.field.voxels().serialised()),
            self.rigid.as_ref().map(RigidScene::serialised),
            self.tendon.snapshot(),
            (self.burr_speed_rad_per_s, self.cutting_energy_j, self.crushing_energy_j, self.receding),
        );
        let too_long = |_| KeyframeError::TooLong { given };
        let length = postcard::to_slice(&whole, buffer).map_err(too_long)?.len();
        // Only if the scene models it, so that the keyframes of other scenes are unchanged.
        let mut end = length;
        if self.burr_drive.is_modelled() {
            end += postcard::to_slice(&self.burr_drive.state, &mut buffer[end..]).map_err(too_long)?.len();
        }
        if self.has_side_torque() {
            let torque_nm = &self.burr_drive.state.side_torque_nm;
            end += postcard::to_slice(torque_nm, &mut buffer[end..]).map_err(too_long)?.len();
        }
        if self.burr_drive.torsion.is_some() {
            let shaft = &self.burr_drive.state.shaft;
            end += postcard::to_slice(shaft, &mut buffer[end..]).map_err(too_long)?.len();
        }
        if let Some(tube) = &self.tube {
            end += postcard::to_slice(&tube.snapshot(), &mut buffer[end..]).map_err(too_long)?.len();
        }
        if !self.sensors.is_empty() {
            end +=
                postcard::to_slice(&self.sensors.serialised(), &mut buffer[end..]).map_err(too_long)?.len();
        }
        Ok(end)
    }

    /// Restores the state from the bytes of [`Simulation::write_keyframe`], written by a simulation of the
    /// same scene and volume in this or another process. After an error the simulation must not be used.
    ///
    /// # Errors
    /// The bytes are not a keyframe, or are from another scene.
    pub fn restore_keyframe(&mut self, bytes: &[u8]) -> Result<(), SimulationError> {
        type Whole<'b> = (
            &'b [u8],
            (ArmSnapshot, Option<ComplianceState>),
            ManipulatorState,
            Option<BoneSnapshot>,
            Option<RigidSnapshot>,
            TendonDriveState,
            (f64, f64, f64, RecessionState),
        );
        let unreadable = |cause: String| KeyframeError::Unreadable { cause };
        let (whole, rest): (Whole<'_>, _) =
            postcard::take_from_bytes(bytes).map_err(|cause| unreadable(cause.to_string()))?;
        let (
            state,
            (arm, compliance),
            manipulator,
            bone,
            rigid,
            tendon,
            (burr_speed_rad_per_s, cutting_energy_j, crushing_energy_j, receding),
        ) = whole;
        let state = State::read_from_bytes(state).map_err(|_| unreadable("its state".to_owned()))?;
        let command_rad_per_s = burr_speed_rad_per_s;
        let (mut burr_drive, mut rest) = match self.burr_drive.is_modelled() {
            false => (BurrDriveState { command_rad_per_s, ..BurrDriveState::default() }, rest),
            true => postcard::take_from_bytes(rest).map_err(|cause| unreadable(cause.to_string()))?,
        };
        if self.has_side_torque() {
            (burr_drive.side_torque_nm, rest) =
                postcard::take_from_bytes(rest).map_err(|cause| unreadable(cause.to_string()))?;
        }
        if self.burr_drive.torsion.is_some() {
            (burr_drive.shaft, rest) =
                postcard::take_from_bytes(rest).map_err(|cause| unreadable(cause.to_string()))?;
        }
        let (tube, rest) = match &self.tube {
            None => (None, rest),
            Some(_) => {
                let (tube, rest): (TubeDriveState, _) =
                    postcard::take_from_bytes(rest).map_err(|cause| unreadable(cause.to_string()))?;
                (Some(tube), rest)
            }
        };
        let (sensors, rest) = match self.sensors.is_empty() {
            true => (self.sensors.state(), rest),
            false => postcard::take_from_bytes(rest).map_err(|cause| unreadable(cause.to_string()))?,
        };
        if !rest.is_empty() {
            return Err(unreadable(format!("{} bytes too many", rest.len())).into());
        }
        let other = |what| Err(KeyframeError::OtherScene { what }.into());
        if bone.is_some() != self.bone.is_some() {
            return other("the volume and strength field");
        }
        if compliance.is_some() != self.compliance.is_some() {
            return other("the arm's joints (rigid or elastic)");
        }
        if !self.manipulator.fits(&manipulator) {
            return other("the manipulator's model and links");
        }
        if !self.sensors.fits(&sensors) {
            return other("the sensors");
        }
        let bodies_fit = match (&self.rigid, &rigid) {
            (None, None) => true,
            (Some(scene), Some(saved)) => scene.fits(saved),
            _ => false,
        };
        if !bodies_fit {
            return other("the rigid bodies");
        }
        self.restore(&SimulationSnapshot {
            arm,
            compliance,
            manipulator,
            bone,
            rigid,
            tendon,
            tube,
            burr_drive,
            burr_speed_rad_per_s,
            cutting_energy_j,
            crushing_energy_j,
            receding,
            sensors,
            state,
        })
    }
}
