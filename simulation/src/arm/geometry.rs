//! Kinematics of the arms that a scene can have, behind one type.

use super::gantry::GantryGeometry;
use super::inverse::KinematicsError;
use super::kinematics::{Joints, LinkFrames, UrGeometry};
use super::serial::SerialGeometry;
use nalgebra::{Isometry3, Matrix3, Matrix6, Vector3, Vector6};

/// The kinematics of an arm.
#[allow(clippy::large_enum_variant, reason = "a simulation has one, and a tick allocates nothing for it")]
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ArmGeometry {
    /// An arm of Universal Robots, with a closed inverse.
    Ur(UrGeometry),
    /// Another arm of six turning joints, with a numeric inverse.
    Serial(SerialGeometry),
    /// Three linear axes. They stand in the first three [`Joints`], in metres; the other three are 0.
    Gantry(GantryGeometry),
    /// No arm: the flange is the base, whatever the joint angles.
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
    /// Whether there is an arm that moves the tool.
    pub fn moves(&self) -> bool {
        !matches!(self, ArmGeometry::Fixed { .. })
    }

    /// Whether the arm has joints that turn, which commands and states name by angles.
    pub fn turns(&self) -> bool {
        matches!(self, ArmGeometry::Ur(_) | ArmGeometry::Serial(_))
    }

    /// T_flange_tool: pose of the tool's base on the flange; `None` means identity.
    pub fn t_flange_tool(&self) -> Option<&Isometry3<f64>> {
        match self {
            ArmGeometry::Ur(ur) => ur.t_flange_tool.as_ref(),
            ArmGeometry::Serial(serial) => serial.t_flange_tool.as_ref(),
            ArmGeometry::Gantry(gantry) => gantry.t_flange_tool.as_ref(),
            ArmGeometry::Fixed { t_flange_tool } => t_flange_tool.as_ref(),
        }
    }

    /// The same arm with its tool's base there on the flange.
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

    /// All link frames at joint angles `q_rad`; the last one is the tool's base.
    pub fn frames(&self, q_rad: &Joints) -> LinkFrames {
        match self {
            ArmGeometry::Ur(ur) => ur.frames(q_rad),
            ArmGeometry::Serial(serial) => serial.frames(q_rad),
            ArmGeometry::Gantry(gantry) => gantry.frames(q_rad),
            ArmGeometry::Fixed { t_flange_tool } => {
                let mut frames =
                    LinkFrames { rotation: [Matrix3::identity(); 7], origin_m: [Vector3::zeros(); 7] };
                frames.attach(t_flange_tool.as_ref());
                frames
            }
        }
    }

    /// Geometric Jacobian of the tool's base at these frames, base axes: [`LinkFrames::jacobian`]. A gantry's is the identity: its
    /// coordinates are the place itself, and its last three, which never change, would turn the tool about the base's axes.
    pub(super) fn jacobian(&self, frames: &LinkFrames) -> Matrix6<f64> {
        match self {
            ArmGeometry::Gantry(_) => Matrix6::identity(),
            ArmGeometry::Ur(_) | ArmGeometry::Serial(_) | ArmGeometry::Fixed { .. } => frames.jacobian(),
        }
    }

    /// `J̇ q̇` at these frames: [`LinkFrames::bias_acceleration`]. 0 where nothing turns.
    pub(super) fn bias_acceleration(&self, frames: &LinkFrames, qd_rad_s: &Joints) -> Vector6<f64> {
        if self.turns() { frames.bias_acceleration(qd_rad_s) } else { Vector6::zeros() }
    }

    /// The parts of the chain that do not turn: frame i is frame i - 1 turned about its z by joint i, then moved by part i; part 0 places
    /// frame 0 in the arm's base. For an arm of Universal Robots the identity, then `Tz(d_i) Tx(a_i) Rx(alpha_i)`.
    pub fn fixed_parts(&self) -> [Isometry3<f64>; 7] {
        let straight = self.frames(&[0.0; 6]);
        std::array::from_fn(|index| match index {
            0 => straight.t_base_link(0),
            _ => straight.t_base_link(index - 1).inverse() * straight.t_base_link(index),
        })
    }

    /// `T_base_tool`: pose of the tool's base in the arm's base frame; without a tool transform, of the flange.
    pub fn forward(&self, q_rad: &Joints) -> Isometry3<f64> {
        self.frames(q_rad).t_base_link(6)
    }

    /// `|det J|` in m³, Yoshikawa's manipulability of a six-joint arm; 0 without joints that turn.
    pub fn manipulability_m3(&self, q_rad: &Joints) -> f64 {
        match self {
            ArmGeometry::Ur(ur) => ur.manipulability_m3(q_rad),
            ArmGeometry::Serial(serial) => serial.frames(q_rad).jacobian().determinant().abs(),
            ArmGeometry::Gantry(_) | ArmGeometry::Fixed { .. } => 0.0,
        }
    }

    /// Joint angles within the limits that put the tool's base at `t_base_tool`, as near to `q_reference_rad` as the arm's inverse finds
    /// them: [`UrGeometry::inverse_nearest`], [`SerialGeometry::inverse_nearest`],
    /// [`GantryGeometry::inverse`].
    ///
    /// # Errors
    /// The pose is invalid, out of reach or singular, or no solution lies within the limits.
    pub fn inverse_nearest(
        &self,
        t_base_tool: &Isometry3<f64>,
        q_reference_rad: &Joints,
        lower_rad: &Joints,
        upper_rad: &Joints,
    ) -> Result<Joints, KinematicsError> {
        match self {
            ArmGeometry::Ur(ur) => ur.inverse_nearest(t_base_tool, q_reference_rad, lower_rad, upper_rad),
            ArmGeometry::Serial(serial) => {
                serial.inverse_nearest(t_base_tool, q_reference_rad, lower_rad, upper_rad)
            }
            ArmGeometry::Gantry(gantry) => gantry.inverse(t_base_tool, lower_rad, upper_rad),
            ArmGeometry::Fixed { .. } => Err(KinematicsError::NoJoints),
        }
    }

    /// Signs that differ between two configurations of the arm which only a singularity joins.
    pub(super) fn branch(&self, q_rad: &Joints) -> [bool; 3] {
        match self {
            ArmGeometry::Ur(ur) => {
                let f = ur.singularity_factors(q_rad);
                [f.elbow > 0.0, f.wrist > 0.0, f.shoulder_m > 0.0]
            }
            ArmGeometry::Serial(serial) => [serial.frames(q_rad).jacobian().determinant() > 0.0, true, true],
            ArmGeometry::Gantry(_) | ArmGeometry::Fixed { .. } => [true; 3],
        }
    }

    /// The error where the Jacobian at `q_rad` has no inverse.
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
