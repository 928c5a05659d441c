//! `[tool]`, `[manipulator]` and `[[tendon]]`: the tool.

use std::path::PathBuf;

use messages::MAX_JOINTS;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{FARTHEST_MM, ToolDescription};

/// Where the tool starts and which way it looks, in the patient frame (LPS).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Tool {
    /// A plan made in 3D Slicer (`.mrk.json`, `.fcsv`; points named entry, bend, target), from the scene
    /// file's folder. From it follow `burr_start_mm`, `direction`, `bend_toward`, the pilot hole
    /// (`[[predrill]]`), and, where the scene does not give them, `drr.isocentre_mm`, target and feed of the
    /// built-in controllers.
    #[schemars(extend("x-kind" = "path"))]
    pub plan: Option<PathBuf>,
    /// Burr centre of the straight tool at the start; from `plan`, if there is one.
    #[schemars(inner(range(min = -FARTHEST_MM, max = FARTHEST_MM)))]
    pub burr_start_mm: [f64; 3],
    /// Insertion direction, any length; from `plan`, if there is one.
    pub direction: [f64; 3],
    /// Side to which tendon 0 bends the tool; its part across the direction counts. From `plan`, if that
    /// bends.
    pub bend_toward: [f64; 3],
    /// Shape of a pre-curved tool at the start: `rest`, the standard, is its own, `straight` is held straight
    /// by a hole or a guide, as at the start of a curved tunnel. A tool that is straight without load is
    /// straight either way.
    #[schemars(extend("x-absent" = "rest"))]
    pub start_shape: Option<StartShape>,
}

/// Shapes of the tool at the start.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum StartShape {
    /// Its shape without load.
    #[default]
    Rest,
    /// Straight.
    Straight,
}

/// The manipulator, where it differs from the notched nitinol tube of 27 flexures.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
#[schemars(extend("x-absent" = "standard"))]
pub struct Manipulator {
    /// A tool file, from the scene file's folder: another tool in place of the standard one (docs/tools.md).
    /// From it follows `[manipulator.tool]`. The keys below then change that tool.
    #[schemars(extend("x-kind" = "path"))]
    pub file: Option<PathBuf>,
    /// The same in the scene itself.
    pub tool: Option<ToolDescription>,
    /// Rung of the ladder of models: `planar` is the standard.
    pub model: Option<ManipulatorRung>,
    /// Number of moment modes of the model `modal`; 5 by default, with which the standard tool rests within
    /// 25 µm of all its flexures.
    #[schemars(range(min = 2, max = 8))]
    pub modes: Option<usize>,
    /// The flexible length as this many equal links in place of the flexures of the tables.
    #[schemars(range(min = 1, max = MAX_JOINTS))]
    pub links: Option<usize>,
    /// Width of the tube's notches along its axis; 0.73 by default. With `notch_past_axis_mm` it sets the
    /// axial, shear, lateral and torsional stiffness of a flexure of `spatial` and `full`; the bending
    /// stiffness stays that of the tables.
    #[schemars(range(min = 0.65, max = 0.8))]
    pub notch_width_mm: Option<f64>,
    /// How far a notch reaches past the tube's axis; 0.495 by default.
    #[schemars(range(min = 0.4, max = 0.6))]
    pub notch_past_axis_mm: Option<f64>,
    /// Stiffness of a flexure across the bending plane over that in it, in place of what the notches give;
    /// for `spatial` and `full`.
    #[schemars(range(min = 1e-3, max = 1e3))]
    pub lateral_stiffness_ratio: Option<f64>,
    /// Torsional over bending stiffness of a flexure, in place of what the notches give; for `spatial` and
    /// `full`.
    #[schemars(range(min = 1e-3, max = 1e3))]
    pub torsion_stiffness_ratio: Option<f64>,
    /// Friction coefficient of tendons in their channels.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub tendon_friction: Option<f64>,
    /// Damping ratio of the first bending mode.
    #[schemars(range(min = 0.001, max = 10.0))]
    pub damping_ratio: Option<f64>,
    /// All flexure stiffnesses times this.
    #[schemars(range(min = 0.001, max = 1000.0))]
    pub stiffness_scale: Option<f64>,
    /// All masses times this.
    #[schemars(range(min = 0.001, max = 1000.0))]
    pub mass_scale: Option<f64>,
    /// Stiffness of the mount between arm and tool.
    #[schemars(range(min = 1e3, max = 1e7))]
    pub mount_stiffness_n_per_m: Option<f64>,
    /// Diameter of the burr.
    #[schemars(range(min = 1.0, max = 20.0))]
    pub burr_diameter_mm: Option<f64>,
    /// Torque at which the burr's motor stands; its speed falls in a line up to there. Absent: it keeps its
    /// speed under any torque.
    #[schemars(range(min = 0.01, max = 1e4), extend("x-absent" = "none"))]
    pub burr_stall_torque_nmm: Option<f64>,
    /// Time integration: `hybrid`, the standard, is second order in free motion.
    pub integrator: Option<Integrator>,
}

/// Models of the manipulator, from the cheapest to the richest.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ManipulatorRung {
    /// An arc of one curvature.
    ConstantCurvature,
    /// A chain that bends in one plane, in a few modes of its bending moment. Not valid while single flexures
    /// stand on their stops.
    Modal,
    /// A chain that bends in one plane.
    #[default]
    Planar,
    /// A chain that bends, bends laterally and twists.
    Spatial,
    /// A chain whose flexures have all six freedoms.
    Full,
}

/// Integrators of the manipulator.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Integrator {
    /// First order, never unstable.
    LinearlyImplicitEuler,
    /// Second order in free motion, linearly implicit Euler otherwise.
    #[default]
    Hybrid,
}

/// A tendon in its channel along the whole flexible length.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Tendon {
    /// Distance of the channel from the tool axis toward `tool.bend_toward`.
    #[schemars(range(min = -10.0, max = 10.0))]
    pub toward_mm: f64,
    /// Distance across it (direction times `bend_toward`, right-handed); for `spatial` and `full`.
    #[serde(default)]
    #[schemars(range(min = -10.0, max = 10.0))]
    pub across_mm: f64,
    /// Angle by which the channel turns about the tool axis per length, from `toward_mm` to `across_mm`,
    /// beginning half way before the first flexure: the tendon winds about the tool. For `spatial` and
    /// `full`.
    #[schemars(range(min = -30.0, max = 30.0), extend("x-absent" = "0"))]
    pub twist_deg_per_mm: Option<f64>,
}
