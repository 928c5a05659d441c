//! Kinematics of all arms that a scene can have, as one type.

use super::gantry::GantryGeometry;
use super::inverse::KinematicsError;
use super::kinematics::{Jacobian, Joints, LinkFrames, UR_JOINTS, UrGeometry, without};
use super::serial::{Redundancy, SerialGeometry};
use nalgebra::{Isometry3, Vector6};

/// The kinematics of an arm.
#[allow(clippy::large_enum_variant, reason = "one per simulation, and a tick allocates nothing for it")]
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ArmGeometry {
    /// A Universal Robots arm, with a closed-form inverse.
    Ur(UrGeometry),
    /// Any other arm of six or seven revolute joints, with a numeric inverse.
    Serial(SerialGeometry),
    /// Three linear axes: the first three entries of [`Joints`], in metres; the others are 0.
    Gantry(GantryGeometry),
    /// No arm: the flange is the base, regardless of the joint angles.
    Fixed {
        /// T_flange_tool; `None` means identity.
        t_flange_tool: Option<Isometry3<f64>>,
    },
}

impl From<UrGeometry> for ArmGeometry {
    fn from(geometry: UrGeometry) -> Self {
        ArmGeometry::Ur(geometry)
    }
}

impl ArmGeometry {
    /// Returns whether there is an arm that moves the tool.
    pub fn moves(&self) -> bool {
        !matches!(self, ArmGeometry::Fixed { .. })
    }

    /// Returns the number of revolute joints, which commands and states report as angles.
    pub fn joints(&self) -> usize {
        match self {
            ArmGeometry::Ur(_) => UR_JOINTS,
            ArmGeometry::Serial(serial) => serial.joints(),
            ArmGeometry::Gantry(_) | ArmGeometry::Fixed { .. } => 0,
        }
    }

    /// Returns whether the arm has revolute joints.
    pub fn turns(&self) -> bool {
        self.joints() > 0
    }

    /// Returns the joint, from 0, that keeps its angle while the tool's base moves on a path: the redundant
    /// one of seven. For other arms, the entry after the last joint.
    pub(super) fn held_joint(&self) -> usize {
        match self {
            ArmGeometry::Serial(serial) => serial.held_joint(),
            ArmGeometry::Ur(_) | ArmGeometry::Gantry(_) | ArmGeometry::Fixed { .. } => UR_JOINTS,
        }
    }

    /// Returns T_flange_tool: pose of the tool's base on the flange; `None` means identity.
    pub fn t_flange_tool(&self) -> Option<&Isometry3<f64>> {
        match self {
            ArmGeometry::Ur(ur) => ur.t_flange_tool.as_ref(),
            ArmGeometry::Serial(serial) => serial.t_flange_tool.as_ref(),
            ArmGeometry::Gantry(gantry) => gantry.t_flange_tool.as_ref(),
            ArmGeometry::Fixed { t_flange_tool } => t_flange_tool.as_ref(),
        }
    }

    /// Returns the same arm with the tool base at this pose on the flange.
    #[must_use]
    pub fn with_tool(mut self, t_flange_tool: Option<Isometry3<f64>>) -> Self {
        match &mut self {
            ArmGeometry::Ur(ur) => ur.t_flange_tool = t_flange_tool,
            ArmGeometry::Serial(serial) => serial.t_flange_tool = t_flange_tool,
            ArmGeometry::Gantry(gantry) => gantry.t_flange_tool = t_flange_tool,
            ArmGeometry::Fixed { t_flange_tool: tool } => *tool = t_flange_tool,
        }
        self
    }

    /// Returns all link frames at joint angles `q_rad`; the last one is the tool's base.
    pub fn frames(&self, q_rad: &Joints) -> LinkFrames {
        match self {
            ArmGeometry::Ur(ur) => ur.frames(q_rad),
            ArmGeometry::Serial(serial) => serial.frames(q_rad),
            ArmGeometry::Gantry(gantry) => gantry.frames(q_rad),
            ArmGeometry::Fixed { t_flange_tool } => {
                let mut frames = LinkFrames::standing(0);
                frames.attach(t_flange_tool.as_ref());
                frames
            }
        }
    }

    /// Returns the geometric Jacobian of the tool's base at these frames, base axes:
    /// [`LinkFrames::jacobian`]. For a gantry it is the identity: the coordinates are the position itself,
    /// plus three unused ones that would turn the tool about the base axes.
    pub(super) fn jacobian(&self, frames: &LinkFrames) -> Jacobian {
        match self {
            ArmGeometry::Gantry(_) => Jacobian::identity(),
            ArmGeometry::Ur(_) | ArmGeometry::Serial(_) | ArmGeometry::Fixed { .. } => frames.jacobian(),
        }
    }

    /// Returns `J̇ q̇` at these frames: [`LinkFrames::bias_acceleration`]. Zero without revolute joints.
    pub(super) fn bias_acceleration(&self, frames: &LinkFrames, qd_rad_s: &Joints) -> Vector6<f64> {
        if self.turns() { frames.bias_acceleration(qd_rad_s) } else { Vector6::zeros() }
    }

    /// Returns the constant parts of the chain, one more than there are joints: frame i is frame i - 1 turned
    /// about its z by joint i, then moved by part i; part 0 places frame 0 in the arm's base, and the last
    /// part ends at the tool's base. For a Universal Robots arm: the identity, then `Tz(d_i) Tx(a_i)
    /// Rx(alpha_i)`.
    pub fn fixed_parts(&self) -> Vec<Isometry3<f64>> {
        let (straight, joints) = (self.frames(&Joints::default()), self.joints());
        let frame =
            |index: usize| straight.t_base_link(if index == joints { LinkFrames::TOOL } else { index });
        let first = straight.t_base_link(0);
        let between = (1..=joints).map(|index| frame(index - 1).inverse() * frame(index));
        core::iter::once(first).chain(between).collect()
    }

    /// Returns `T_base_tool`: pose of the tool's base in the arm's base frame; without a tool transform, the
    /// pose of the flange.
    pub fn forward(&self, q_rad: &Joints) -> Isometry3<f64> {
        self.frames(q_rad).t_base_tool()
    }

    /// Returns Yoshikawa's manipulability in m³: `|det J|` for six joints, the root of `det(J Jᵀ)` for seven;
    /// 0 without revolute joints.
    pub fn manipulability_m3(&self, q_rad: &Joints) -> f64 {
        match self {
            ArmGeometry::Ur(ur) => ur.manipulability_m3(q_rad),
            ArmGeometry::Serial(serial) => {
                let jacobian = serial.frames(q_rad).jacobian();
                match serial.is_redundant() {
                    true => libm::sqrt((jacobian * jacobian.transpose()).determinant().max(0.0)),
                    false => self.determinant_m3(&jacobian).abs(),
                }
            }
            ArmGeometry::Gantry(_) | ArmGeometry::Fixed { .. } => 0.0,
        }
    }

    /// Returns the manipulability in m³ of the joints that move on a path: `|det J|` of all except the held
    /// one.
    pub(crate) fn manipulability_on_path_m3(&self, q_rad: &Joints) -> f64 {
        match self {
            ArmGeometry::Serial(serial) => self.determinant_m3(&serial.frames(q_rad).jacobian()).abs(),
            _ => self.manipulability_m3(q_rad),
        }
    }

    /// Returns the determinant of the Jacobian without the joint that is held on a path.
    fn determinant_m3(&self, jacobian: &Jacobian) -> f64 {
        without(jacobian, self.held_joint()).determinant()
    }

    /// Returns the joint angles within the limits that put the tool's base at `t_base_tool`, as close to
    /// `q_reference_rad` as the arm's inverse finds them: [`UrGeometry::inverse_nearest`],
    /// [`SerialGeometry::inverse_nearest`], [`GantryGeometry::inverse`]. With seven joints, the redundant one
    /// keeps the reference angle, unless that finds no solution and `redundancy` lets it move.
    ///
    /// # Errors
    /// The pose is invalid, out of reach or singular, or no solution lies within the limits.
    pub fn inverse_nearest(
        &self,
        t_base_tool: &Isometry3<f64>,
        q_reference_rad: &Joints,
        lower_rad: &Joints,
        upper_rad: &Joints,
        redundancy: Redundancy,
    ) -> Result<Joints, KinematicsError> {
        match self {
            ArmGeometry::Ur(ur) => ur.inverse_nearest(t_base_tool, q_reference_rad, lower_rad, upper_rad),
            ArmGeometry::Serial(serial) => {
                serial.inverse_nearest(t_base_tool, q_reference_rad, lower_rad, upper_rad, redundancy)
            }
            ArmGeometry::Gantry(gantry) => gantry.inverse(t_base_tool, lower_rad, upper_rad),
            ArmGeometry::Fixed { .. } => Err(KinematicsError::NoJoints),
        }
    }

    /// Returns signs that identify the arm's configuration: two configurations with different signs are
    /// connected only through a singularity.
    pub(super) fn branch(&self, q_rad: &Joints) -> [bool; 3] {
        match self {
            ArmGeometry::Ur(ur) => {
                let f = ur.singularity_factors(q_rad);
                [f.elbow > 0.0, f.wrist > 0.0, f.shoulder_m > 0.0]
            }
            ArmGeometry::Serial(serial) => {
                [self.determinant_m3(&serial.frames(q_rad).jacobian()) > 0.0, true, true]
            }
            ArmGeometry::Gantry(_) | ArmGeometry::Fixed { .. } => [true; 3],
        }
    }

    /// Returns the error for a `q_rad` at which the Jacobian has no inverse.
    pub(super) fn singular(&self, q_rad: &Joints) -> KinematicsError {
        match self {
            ArmGeometry::Ur(_) => {
                KinematicsError::WristSingular { sin_q5: libm::sin(q_rad[4]).abs(), minimum: 0.0 }
            }
            ArmGeometry::Serial(_) | ArmGeometry::Gantry(_) | ArmGeometry::Fixed { .. } => {
                KinematicsError::Singular
            }
        }
    }
}
