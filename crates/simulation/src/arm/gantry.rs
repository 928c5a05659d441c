//! A gantry: three linear axes, as of a test bench or a milling machine. It does not turn the tool.

use super::inverse::{KinematicsError, check_pose};
use super::kinematics::{Joints, LinkFrames};
use nalgebra::{Isometry3, UnitQuaternion, Vector3};

/// How far a goal may be turned against the tool: what clients lose by rounding an orientation to four
/// single-precision numbers.
const TURN_TOLERANCE_RAD: f64 = 1e-6;

/// Three linear axes along x, y and z of the arm's base; the flange has the base's orientation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GantryGeometry {
    /// T_flange_tool; `None` means identity.
    pub t_flange_tool: Option<Isometry3<f64>>,
}

impl GantryGeometry {
    /// The base, and the tool's base where the axes are: `place` holds their places in m, then zeros.
    pub(super) fn frames(&self, place: &Joints) -> LinkFrames {
        let mut frames = LinkFrames::standing(0);
        frames.attach(self.t_flange_tool.as_ref());
        frames.origin_m[LinkFrames::TOOL] += Vector3::from_column_slice(&place[..3]);
        frames
    }

    /// The goal with exactly the tool's orientation, from which rounding may have turned it.
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

    /// Places of the axes, m, that put the tool's base at `t_base_tool`, then zeros.
    ///
    /// # Errors
    /// The pose is invalid, turned against the tool by more than 1e-6 rad, or beyond the travel of an axis.
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
