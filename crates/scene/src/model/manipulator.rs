//! `[tool]`, `[manipulator]` and `[[tendon]]`: the tool.

use std::path::PathBuf;

use messages::MAX_JOINTS;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{FARTHEST_MM, ToolDescription};

/// Start pose of the tool in the patient frame (LPS).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Tool {
    /// A plan from 3D Slicer (`.mrk.json`, `.fcsv`; points named entry, bend, target), relative to the scene
    /// file's folder. It sets `burr_start_mm`, `direction`, `bend_toward`, the pilot hole (`[[predrill]]`),
    /// and, unless the scene sets them, `drr.isocentre_mm` and target and feed of the built-in controllers.
    #[schemars(extend("x-kind" = "path"))]
    pub plan: Option<PathBuf>,
    /// Burr centre of the straight tool at the start; from `plan`, if there is one.
    #[schemars(inner(range(min = -FARTHEST_MM, max = FARTHEST_MM)))]
    pub burr_start_mm: [f64; 3],
    /// Insertion direction, any length; from `plan`, if there is one.
    pub direction: [f64; 3],
    /// Side to which tendon 0 bends the tool; only its part perpendicular to the direction counts. From
    /// `plan`, if that is curved.
    pub bend_toward: [f64; 3],
    /// Start shape of a pre-curved tool: `rest`, the standard, is its own shape; `straight` is held straight
    /// by a hole or a guide, as at the start of a curved tunnel. No difference for a tool that is straight
    /// without load.
    #[schemars(extend("x-absent" = "rest"))]
    pub start_shape: Option<StartShape>,
}

/// Start shapes of the tool.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum StartShape {
    /// Its shape without load.
    #[default]
    Rest,
    /// Straight.
    Straight,
}

/// The manipulator, where it differs from the notched nitinol tube with 27 flexures.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
#[schemars(extend("x-absent" = "standard"))]
pub struct Manipulator {
    /// A tool file, relative to the scene file's folder: another tool in place of the standard one
    /// (docs/tools.md). It sets `[manipulator.tool]`. The keys below then modify that tool.
    #[schemars(extend("x-kind" = "path"))]
    pub file: Option<PathBuf>,
    /// The same, in the scene itself.
    pub tool: Option<ToolDescription>,
    /// Model of the manipulator: `planar` is the standard.
    pub model: Option<ManipulatorRung>,
    /// Number of moment modes of the model `modal`; 5 by default, for which all flexures of the standard tool
    /// at rest are within 25 µm.
    #[schemars(range(min = 2, max = 8))]
    pub modes: Option<usize>,
    /// Divides the flexible length into this many equal links instead of the flexures of the tables.
    #[schemars(range(min = 1, max = MAX_JOINTS))]
    pub links: Option<usize>,
    /// Width of the tube's notches along its axis; 0.73 by default. With `notch_past_axis_mm` it determines
    /// the axial, shear, lateral and torsional stiffness of a flexure for `spatial` and `full`; the bending
    /// stiffness remains that of the tables.
    #[schemars(range(min = 0.65, max = 0.8))]
    pub notch_width_mm: Option<f64>,
    /// Depth of a notch beyond the tube's axis; 0.495 by default.
    #[schemars(range(min = 0.4, max = 0.6))]
    pub notch_past_axis_mm: Option<f64>,
    /// Stiffness of a flexure across the bending plane over that in it, overriding the value from the
    /// notches; for `spatial` and `full`.
    #[schemars(range(min = 1e-3, max = 1e3))]
    pub lateral_stiffness_ratio: Option<f64>,
    /// Torsional over bending stiffness of a flexure, overriding the value from the notches; for `spatial`
    /// and `full`.
    #[schemars(range(min = 1e-3, max = 1e3))]
    pub torsion_stiffness_ratio: Option<f64>,
    /// Friction coefficient of tendons in their channels.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub tendon_friction: Option<f64>,
    /// Damping ratio of the first bending mode.
    #[schemars(range(min = 0.001, max = 10.0))]
    pub damping_ratio: Option<f64>,
    /// Scale factor of all flexure stiffnesses.
    #[schemars(range(min = 0.001, max = 1000.0))]
    pub stiffness_scale: Option<f64>,
    /// Scale factor of all masses.
    #[schemars(range(min = 0.001, max = 1000.0))]
    pub mass_scale: Option<f64>,
    /// Stiffness of the mount between arm and tool.
    #[schemars(range(min = 1e3, max = 1e7))]
    pub mount_stiffness_n_per_m: Option<f64>,
    /// Diameter of the burr.
    #[schemars(range(min = 1.0, max = 20.0))]
    pub burr_diameter_mm: Option<f64>,
    /// Stall torque of the burr's motor; its speed falls linearly up to there. Absent: constant speed under
    /// any torque.
    #[schemars(range(min = 0.01, max = 1e4), extend("x-absent" = "none"))]
    pub burr_stall_torque_nmm: Option<f64>,
    /// Time integration: `hybrid`, the standard, is second order in free motion.
    pub integrator: Option<Integrator>,
    /// Whether each state is accompanied by the message `TipJacobian`: Jacobian and compliance of the tip,
    /// for controllers (docs/control.md).
    #[schemars(extend("x-absent" = "false"))]
    pub tip_jacobian: Option<bool>,
}

/// Models of the manipulator, from the cheapest to the most detailed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ManipulatorRung {
    /// A single arc of constant curvature.
    ConstantCurvature,
    /// A chain that bends in one plane, with a few modes of its bending moment. Not valid while individual
    /// flexures are at their stops.
    Modal,
    /// A chain that bends in one plane.
    #[default]
    Planar,
    /// A chain that bends in two planes and twists.
    Spatial,
    /// A chain whose flexures have all six degrees of freedom.
    Full,
}

/// Time integrators of the manipulator.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Integrator {
    /// First order, unconditionally stable.
    LinearlyImplicitEuler,
    /// Second order in free motion, linearly implicit Euler otherwise.
    #[default]
    Hybrid,
}

/// A tendon in a channel along the whole flexible length.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Tendon {
    /// Distance of the channel from the tool axis toward `tool.bend_toward`.
    #[schemars(range(min = -10.0, max = 10.0))]
    pub toward_mm: f64,
    /// Distance perpendicular to it (direction times `bend_toward`, right-handed); for `spatial` and `full`.
    #[serde(default)]
    #[schemars(range(min = -10.0, max = 10.0))]
    pub across_mm: f64,
    /// Twist of the channel about the tool axis per length, from `toward_mm` to `across_mm`, beginning half
    /// way before the first flexure: the tendon is helical. For `spatial` and `full`.
    #[schemars(range(min = -30.0, max = 30.0), extend("x-absent" = "0"))]
    pub twist_deg_per_mm: Option<f64>,
}
