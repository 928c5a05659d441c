//! `[manipulator.tool]`: a tool, with the keys of a tool file.

use messages::{MAX_DEPLOYED_M, MAX_JOINTS, MAX_TENDONS};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{SCENE_NAME, SCENE_NAME_EXPECTED};

/// A tool that replaces the standard one, with the keys of a file named by `manipulator.file`. Positions are
/// along the straight tool, from the flange.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ToolDescription {
    /// Its name.
    #[schemars(regex(pattern = SCENE_NAME), extend("patternErrorMessage" = SCENE_NAME_EXPECTED))]
    pub name: String,
    /// What it is, and the source of its numbers.
    #[serde(default)]
    pub description: String,
    /// Damping ratio of the first bending mode.
    #[serde(default = "standard_damping")]
    #[schemars(range(min = 0.001, max = 10.0))]
    pub damping_ratio: f64,
    /// Stiffness of the mount between arm and tool.
    #[serde(default = "standard_mount")]
    #[schemars(range(min = 1e3, max = 1e7))]
    pub mount_stiffness_n_per_m: f64,
    /// The tube, uniform along the whole tool.
    pub tube: ToolTube,
    /// The rigid part in front of the first flexure.
    #[serde(default)]
    pub shaft: ToolShaft,
    /// Where the tool bends, from the flange to the tip. At most 32 in all, groups expanded: as many as the
    /// state has joints.
    #[schemars(length(max = MAX_JOINTS))]
    pub flexure: Vec<ToolFlexure>,
    /// Bending limit of a flexure.
    #[serde(default)]
    pub stop: FlexureStop,
    /// The cutter.
    pub burr: ToolBurr,
    /// The flexible shaft in the tube that turns the cutter. Absent: it bends with the tube without
    /// resistance and does not twist.
    pub drive_shaft: Option<ToolDriveShaft>,
    /// A straight tube that this one slides out of. Absent: the tool is fixed to its holder.
    pub outer_tube: Option<ToolOuterTube>,
    /// The tendons, in command order.
    #[serde(default)]
    #[schemars(length(max = MAX_TENDONS))]
    pub tendon: Vec<ToolTendon>,
    /// Properties common to all tendons.
    #[serde(default)]
    pub tendon_cable: TendonCable,
}

const fn standard_damping() -> f64 {
    0.05
}

const fn standard_mount() -> f64 {
    2e5
}

/// The tube of a tool.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ToolTube {
    /// Outer diameter, also of the contact spheres of shaft and links.
    #[schemars(range(min = 0.5, max = 30.0))]
    pub outer_diameter_mm: f64,
    /// Lumen diameter.
    #[schemars(range(min = 0.0, max = 30.0))]
    pub inner_diameter_mm: f64,
    /// The steel drive cable in the lumen, which X-ray frames show.
    #[schemars(range(min = 0.1, max = 30.0))]
    pub drive_cable_diameter_mm: Option<f64>,
    /// Mass per length.
    #[schemars(range(min = 1e-4, max = 10.0))]
    pub linear_density_kg_per_m: f64,
    /// Young's modulus, which gives the stiffness of flexures without one of their own.
    #[schemars(range(min = 1e-3, max = 1000.0))]
    pub youngs_modulus_gpa: Option<f64>,
    /// Poisson's ratio.
    #[serde(default = "nitinol_poisson")]
    #[schemars(range(min = 0.0, max = 0.5))]
    pub poisson_ratio: f64,
}

const fn nitinol_poisson() -> f64 {
    0.33
}

/// The rigid part of a tool.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ToolShaft {
    /// Its mass.
    #[schemars(range(min = 0.0, max = 1e5), extend("x-absent" = "that of the tube"))]
    pub mass_g: Option<f64>,
    /// Its centre of mass.
    #[schemars(range(min = 0.0, max = 1000.0), extend("x-absent" = "its middle"))]
    pub centre_mm: Option<f64>,
    /// Where its contact spheres begin: one per tube diameter up to `contact_to_mm`, at most 8.
    #[schemars(
        range(min = 0.0, max = 1000.0),
        extend("x-absent" = "the flange, or 7 diameters before the last")
    )]
    pub contact_from_mm: Option<f64>,
    /// Position of its last contact sphere.
    #[schemars(range(min = 0.0, max = 1000.0), extend("x-absent" = "the first flexure"))]
    pub contact_to_mm: Option<f64>,
}

/// A flexure, or a group of equal ones.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ToolFlexure {
    /// Its centre; in a group, that of the first.
    #[schemars(range(min = 0.01, max = 1000.0))]
    pub at_mm: f64,
    /// Number of flexures in the group.
    #[serde(default = "one")]
    #[schemars(range(min = 1, max = MAX_JOINTS))]
    pub count: usize,
    /// Distance between neighbours in the group.
    #[schemars(range(min = 0.01, max = 500.0))]
    pub pitch_mm: Option<f64>,
    /// Length of tube that bends. Without notches k = E I / length.
    #[schemars(range(min = 0.01, max = 500.0), extend("x-absent" = "half way to either neighbour"))]
    pub length_mm: Option<f64>,
    /// Bending stiffness.
    #[schemars(
        range(min = 1e-6, max = 1e4),
        extend("x-absent" = "from E and the tube, or E and the notches")
    )]
    pub stiffness_nm_per_deg: Option<f64>,
    /// Bend without load, toward `tool.bend_toward`: a pre-curved tube.
    #[serde(default)]
    #[schemars(range(min = -45.0, max = 45.0))]
    pub rest_deg: f64,
    /// Width of the notch along the tube. Absent: a piece of plain round tube.
    #[schemars(range(min = 0.05, max = 10.0))]
    pub notch_width_mm: Option<f64>,
    /// Depth of the notch beyond the tube's axis.
    #[schemars(range(min = 0.025, max = 10.0))]
    pub notch_past_axis_mm: Option<f64>,
}

const fn one() -> usize {
    1
}

/// The stop of each flexure.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct FlexureStop {
    /// Bend from the rest angle to either side.
    #[schemars(range(min = 0.01, max = 175.0))]
    pub angle_deg: f64,
    /// Stiffness of the stop.
    #[schemars(range(min = 1e-3, max = 1e6))]
    pub stiffness_nm_per_rad: f64,
}

impl Default for FlexureStop {
    fn default() -> Self {
        Self { angle_deg: 5.0, stiffness_nm_per_rad: 100.0 }
    }
}

/// The cutter of a tool: a body of revolution about the tool's axis, with round ends.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ToolBurr {
    /// Its shape.
    #[schemars(extend("x-absent" = "ball"))]
    pub shape: Option<CutterShape>,
    /// Its largest diameter.
    #[schemars(range(min = 1.0, max = 20.0))]
    pub diameter_mm: f64,
    /// From its front to its back; for all shapes except a ball.
    #[schemars(range(min = 1.0, max = 60.0))]
    pub length_mm: Option<f64>,
    /// Diameter of its round front, for a cone or a bit.
    #[schemars(range(min = 0.1, max = 20.0))]
    pub tip_diameter_mm: Option<f64>,
    /// Point angle of a bit, from flank to flank.
    #[schemars(range(min = 30.0, max = 160.0))]
    pub point_deg: Option<f64>,
    /// Rake angle of a bit's lips, for the law `drilling.law = "twist_drill"`.
    #[schemars(range(min = -30.0, max = 45.0), extend("x-absent" = "20"))]
    pub rake_deg: Option<f64>,
    /// Largest depth by which the surface between two of the balls that make up the shape falls short of it.
    #[schemars(range(min = 0.001, max = 1.0), extend("x-absent" = "0.05"))]
    pub scallop_mm: Option<f64>,
    /// Distance from the last flexure to its centre; for other shapes than a ball, to the centre of the ball
    /// at its front. `tool.burr_start_mm` places this point, and plans draw its path.
    #[schemars(range(min = 0.01, max = 500.0))]
    pub offset_mm: f64,
    /// Its mass.
    #[schemars(range(min = 0.0, max = 1000.0))]
    pub mass_g: f64,
    /// Cutting force over normal force; overridden by a scene's `drilling.cutting_coefficient`.
    #[schemars(range(min = 0.01, max = 5.0), extend("x-absent" = "standard"))]
    pub cutting_coefficient: Option<f64>,
}

/// Shapes of a cutter.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum CutterShape {
    /// A ball.
    #[default]
    Ball,
    /// A cylinder between two hemispheres.
    Cylinder,
    /// A cone that widens from its round tip to a ball at its back.
    Cone,
    /// A drill bit: a conical point with a round tip, and the cylinder behind it.
    Bit,
}

/// A straight tube on the tool's base that keeps the tool straight where it covers it. A drive slides the
/// tool out of it and rotates it inside.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ToolOuterTube {
    /// Where it ends; the tool protrudes, up to its burr, while nothing is deployed.
    #[schemars(range(min = 0.01, max = 1000.0))]
    pub end_mm: f64,
    /// Outer diameter, also of the contact spheres that it covers.
    #[schemars(range(min = 0.5, max = 30.0))]
    pub outer_diameter_mm: f64,
    /// Lumen diameter; the tool's tube fits without play.
    #[schemars(range(min = 0.5, max = 30.0))]
    pub inner_diameter_mm: f64,
    /// Young's modulus.
    #[serde(default = "steel_modulus")]
    #[schemars(range(min = 1e-3, max = 1000.0))]
    pub youngs_modulus_gpa: f64,
    /// Largest deployed length.
    #[schemars(range(min = 0.1, max = MAX_DEPLOYED_M * 1e3))]
    pub travel_mm: f64,
    /// Largest deployment speed.
    #[serde(default = "slide_speed")]
    #[schemars(range(min = 0.01, max = 1000.0))]
    pub speed_mm_per_s: f64,
    /// Largest roll speed.
    #[serde(default = "roll_speed")]
    #[schemars(range(min = 0.1, max = 3600.0))]
    pub roll_speed_deg_per_s: f64,
}

const fn steel_modulus() -> f64 {
    193.0
}

const fn slide_speed() -> f64 {
    10.0
}

const fn roll_speed() -> f64 {
    90.0
}

/// The flexible shaft that carries the motor's torque through the tube to the cutter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ToolDriveShaft {
    /// Its bending stiffness E I: stiffens each flexure by E I over the flexure's length. The shaft itself is
    /// straight at rest.
    #[serde(default)]
    #[schemars(range(min = 0.0, max = 100.0))]
    pub bending_stiffness_nm2: f64,
    /// Its torsional stiffness G J: a torque T twists it by T `length_mm` / (G J). Absent: it does not twist.
    #[schemars(range(min = 1e-7, max = 100.0), extend("x-absent" = "rigid"))]
    pub torsional_stiffness_nm2: Option<f64>,
    /// Length from the motor to the cutter.
    #[schemars(range(min = 1.0, max = 5000.0), extend("x-absent" = "from the flange to the burr"))]
    pub length_mm: Option<f64>,
    /// Damping ratio of the cutter's torsional oscillation on the shaft.
    #[serde(default = "standard_damping")]
    #[schemars(range(min = 0.0, max = 1.0))]
    pub torsional_damping_ratio: f64,
    /// Stall torque of the motor; overridden by a scene's `manipulator.burr_stall_torque_nmm`.
    #[schemars(range(min = 0.01, max = 1e4), extend("x-absent" = "none"))]
    pub stall_torque_nmm: Option<f64>,
    /// Friction torque of the shaft against the tube, which the motor carries in addition to the cutter's.
    #[serde(default)]
    #[schemars(range(min = 0.0, max = 1e4))]
    pub friction_torque_nmm: f64,
}

/// A tendon of a tool.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ToolTendon {
    /// Distance of the channel from the tool axis toward `tool.bend_toward`.
    #[schemars(range(min = -10.0, max = 10.0))]
    pub toward_mm: f64,
    /// Distance perpendicular to it (direction times `bend_toward`, right-handed); for `spatial` and `full`.
    #[serde(default)]
    #[schemars(range(min = -10.0, max = 10.0))]
    pub across_mm: f64,
    /// Twist of the channel about the tool axis per length, from `toward_mm` to `across_mm`, beginning half
    /// way before the first flexure that it bends: the tendon is helical. For `spatial` and `full`.
    #[schemars(range(min = -180.0, max = 180.0), extend("x-absent" = "0"))]
    pub twist_deg_per_mm: Option<f64>,
    /// First flexure that it bends, from 1 at the flange: a sheath holds it up to there.
    #[serde(default = "one")]
    #[schemars(range(min = 1, max = MAX_JOINTS))]
    pub from_flexure: usize,
    /// Last flexure that it bends, behind which it is anchored.
    #[schemars(range(min = 1, max = MAX_JOINTS), extend("x-absent" = "the last of the tool"))]
    pub to_flexure: Option<usize>,
    /// Axial stiffness from actuator to anchor.
    #[schemars(range(min = 1.0, max = 1e9), extend("x-absent" = "that of `tendon_cable`"))]
    pub stiffness_n_per_m: Option<f64>,
    /// Friction coefficient in its channel.
    #[schemars(range(min = 0.0, max = 1.0), extend("x-absent" = "that of `tendon_cable`"))]
    pub friction: Option<f64>,
}

/// Properties of the tendons' cables.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct TendonCable {
    /// Axial stiffness from actuator to anchor; by default a steel cable of 0.35 mm and 0.3 m.
    #[schemars(range(min = 1.0, max = 1e9))]
    pub stiffness_n_per_m: f64,
    /// Friction coefficient in the channels.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub friction: f64,
    /// Free length across a flexure, hole to hole.
    #[schemars(range(min = 0.0, max = 100.0))]
    pub gap_mm: f64,
    /// Sliding distance over which friction builds up.
    #[schemars(range(min = 1e-3, max = 10.0))]
    pub presliding_mm: f64,
}

impl Default for TendonCable {
    fn default() -> Self {
        Self { stiffness_n_per_m: 3.0e4, friction: 0.0, gap_mm: 0.0, presliding_mm: 0.02 }
    }
}
