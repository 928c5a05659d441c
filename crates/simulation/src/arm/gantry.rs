//! A gantry: three linear axes, as on a test bench or a milling machine. It never rotates the tool.

use super::inverse::{KinematicsError, check_pose};
use super::kinematics::{Joints, LinkFrames};
use nalgebra::{Isometry3, UnitQuaternion, Vector3};

/// Tolerance for a goal's rotation relative to the tool, which covers the rounding of an orientation to four
/// single-precision numbers by clients.
const TURN_TOLERANCE_RAD: f64 = 1e-6;

/// Three linear axes along x, y and z of the arm's base; the flange has the base's orientation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GantryGeometry {
    /// T_flange_tool; `None` means identity.
    pub t_flange_tool: Option<Isometry3<f64>>,
}

impl GantryGeometry {
    /// Returns the frames of the base and of the tool base; `place` holds the axis positions in m, then
    /// zeros.
    pub(super) fn frames(&self, place: &Joints) -> LinkFrames {
        let mut frames = LinkFrames::standing(0);
        frames.attach(self.t_flange_tool.as_ref());
        frames.origin_m[LinkFrames::TOOL] += Vector3::from_column_slice(&place[..3]);
        frames
    }

    /// Returns the goal with exactly the tool's orientation, which removes rounding.
    pub(super) fn unturned(
        &self,
        mut t_base_tool: Isometry3<f64>,
    ) -> Result<Isometry3<f64>, KinematicsError> {
        self.check_turn(&t_base_tool)?;
        t_base_tool.rotation = self.frames(&Joints::default()).t_base_tool().rotation;
        Ok(t_base_tool)
    }

    fn check_turn(&self, t_base_tool: &Isometry3<f64>) -> Result<(), KinematicsError> {
        let own = self.t_flange_tool.map_or_else(UnitQuaternion::identity, |tool| tool.rotation);
        let turned_rad = t_base_tool.rotation.angle_to(&own);
        match turned_rad <= TURN_TOLERANCE_RAD {
            true => Ok(()),
            false => Err(KinematicsError::Turned { turned_rad, allowed_rad: TURN_TOLERANCE_RAD }),
        }
    }

    /// Returns the axis positions, m, that put the tool base at `t_base_tool`, then zeros.
    ///
    /// # Errors
    /// The pose is invalid, rotated relative to the tool by more than 1e-6 rad, or beyond the travel of an
    /// axis.
    pub fn inverse(
        &self,
        t_base_tool: &Isometry3<f64>,
        lower_m: &Joints,
        upper_m: &Joints,
    ) -> Result<Joints, KinematicsError> {
        check_pose(t_base_tool)?;
        self.check_turn(t_base_tool)?;
        let tool_m = self.t_flange_tool.map_or_else(Vector3::zeros, |tool| tool.translation.vector);
        let place_m = t_base_tool.translation.vector - tool_m;
        for axis in 0..3 {
            let (given_m, lower_m, upper_m) = (place_m[axis], lower_m[axis], upper_m[axis]);
            if !(lower_m..=upper_m).contains(&given_m) {
                return Err(KinematicsError::BeyondTravel { axis: AXES[axis], given_m, lower_m, upper_m });
            }
        }
        let mut place = Joints::default();
        place[..3].copy_from_slice(place_m.as_slice());
        Ok(place)
    }
}

/// Names of the axes.
pub(super) const AXES: [char; 3] = ['x', 'y', 'z'];
