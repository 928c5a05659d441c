//! `[[structure]]`: critical structures that the tool should keep away from.

use std::path::PathBuf;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{FARTHEST_MM, Label, NAME, NAME_EXPECTED};

/// Largest number of structures of a scene.
pub const MAX_STRUCTURES: usize = 16;
/// Largest number of points of a tube.
const MOST_POINTS: usize = 1000;

/// A critical structure, in the patient frame, which moves with the bone of `[truth]`. Its shape is exactly
/// one of `ball`, `cuboid`, `tube`, `curve`, `label`, `mesh` and `built_in`. The tool does not collide with
/// it. Structures may overlap.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Structure {
    /// Name.
    #[schemars(regex(pattern = NAME), extend("patternErrorMessage" = NAME_EXPECTED))]
    pub name: String,
    /// A ball.
    pub ball: Option<StructureBall>,
    /// A box.
    pub cuboid: Option<StructureCuboid>,
    /// A tube: a nerve, a vessel or a canal. Two points make a capsule.
    pub tube: Option<StructureTube>,
    /// A line or curve of 3D Slicer with a radius.
    pub curve: Option<StructureCurve>,
    /// A label of a label map, or a segment of a segmentation.
    pub label: Option<StructureLabel>,
    /// A closed surface.
    pub mesh: Option<StructureMesh>,
    /// What the volume defines.
    pub built_in: Option<BuiltInStructure>,
    /// Thickness of the `cortex`.
    #[schemars(range(min = 0.1, max = 50.0), extend("x-absent" = "required with `cortex`"))]
    pub thickness_mm: Option<f64>,
    /// Whether the tool should keep away from it or remove it.
    #[serde(default)]
    pub role: StructureRole,
    /// Clearance that the tool should keep.
    #[serde(default = "Structure::default_margin_mm")]
    #[schemars(range(min = 0.0, max = 100.0))]
    pub margin_mm: f64,
    /// What happens when the clearance falls below the margin.
    #[serde(default)]
    pub on_margin: StructureAction,
    /// What happens when the tool enters the structure.
    #[serde(default)]
    pub on_breach: StructureAction,
}

defaults!(Structure { default_margin_mm: f64 = 2.0 });

/// What a structure is for.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum StructureRole {
    /// The tool should keep away from it.
    #[default]
    Avoid,
    /// The tool should remove the bone in it: no events, no caution.
    Target,
}

/// What happens when the tool comes close to a structure or enters it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum StructureAction {
    /// An event.
    #[default]
    Event,
    /// An event, and a protective stop of the arm; the tendons keep their tension.
    Stop,
    /// The tool is kept out: the arm stops in time and accepts only motions that do not come closer, and
    /// tendons are pulled or paid out the slower the closer the tool is. Not with an outer tube.
    Fixture,
}

/// A structure that the volume defines.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum BuiltInStructure {
    /// Everything outside of the bone, with its marrow and pores, as it was before the pilot holes. The
    /// tool's own entrance does not count.
    OutsideOfBone,
    /// The outermost `thickness_mm` of the bone, and what is outside of it. The tool's own entrance does not
    /// count.
    Cortex,
}

/// A ball.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StructureBall {
    /// Centre.
    #[schemars(inner(range(min = -FARTHEST_MM, max = FARTHEST_MM)))]
    pub centre_mm: [f64; 3],
    /// Radius.
    #[schemars(range(min = 0.01, max = 1000.0))]
    pub radius_mm: f64,
}

/// A box.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StructureCuboid {
    /// Centre.
    #[schemars(inner(range(min = -FARTHEST_MM, max = FARTHEST_MM)))]
    pub centre_mm: [f64; 3],
    /// Half extents along its axes.
    #[schemars(inner(range(min = 0.01, max = 1000.0)))]
    pub half_extents_mm: [f64; 3],
    /// Orientation: axis times angle.
    #[serde(default)]
    #[schemars(inner(range(min = -360.0, max = 360.0)))]
    pub rotation_vector_deg: [f64; 3],
}

/// All points within a radius of a polyline.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StructureTube {
    /// The line's points, each coordinate within 100 m.
    #[schemars(length(min = 1, max = MOST_POINTS))]
    pub points_mm: Vec<[f64; 3]>,
    /// Radius.
    #[schemars(range(min = 0.01, max = 1000.0))]
    pub radius_mm: f64,
}

/// A line, curve or closed curve of a markups file (`.mrk.json`), which becomes a `tube` when the scene is
/// read. It is straight between its control points.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StructureCurve {
    /// The file, relative to the scene file's folder.
    #[schemars(extend("x-kind" = "path"))]
    pub file: PathBuf,
    /// Radius.
    #[schemars(range(min = 0.01, max = 1000.0))]
    pub radius_mm: f64,
}

/// The voxels of one label in a file that is read as a volume is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StructureLabel {
    /// The file, relative to the scene file's folder.
    #[schemars(extend("x-kind" = "path"))]
    pub file: PathBuf,
    /// The label's value, or the name of a segment in a `.seg.nrrd` from 3D Slicer.
    pub label: Label,
    /// Its voxels, as read from the file.
    pub voxels: Option<StructureVoxels>,
}

/// The part of a label map that holds a label, in the scene so that its copies need no file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StructureVoxels {
    /// Voxels along each axis.
    #[schemars(inner(range(min = 1, max = 65_536)))]
    pub dims: [usize; 3],
    /// Distance between neighbouring voxels.
    #[schemars(inner(range(min = 0.001, max = 100.0)))]
    pub spacing_mm: [f64; 3],
    /// Centre of the first voxel, LPS.
    #[schemars(inner(range(min = -FARTHEST_MM, max = FARTHEST_MM)))]
    pub origin_mm: [f64; 3],
    /// Directions of the axes.
    pub axes: [[f64; 3]; 3],
    /// Lengths of the runs of voxels outside and inside in turn, first axis fastest: LEB128 in Base64.
    pub runs: String,
}

/// A closed surface in a mesh file, in mm.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StructureMesh {
    /// The file, STL or OBJ, relative to the scene file's folder.
    #[schemars(extend("x-kind" = "path"))]
    pub file: PathBuf,
    /// Patient frame of a file that does not state it, as those of 3D Slicer do (`SPACE=LPS`).
    #[schemars(extend("x-absent" = "as the file states"))]
    pub frame: Option<PatientFrame>,
    /// Its triangles, as read from the file.
    pub surface: Option<StructureSurface>,
}

/// Patient frame of a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum PatientFrame {
    /// +x left, +y posterior, +z superior.
    Lps,
    /// +x right, +y anterior, +z superior.
    Ras,
}

/// The triangles of a mesh, in the scene so that its copies need no file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StructureSurface {
    /// Corners, LPS, mm: float32, little-endian, in Base64.
    pub corners: String,
    /// Corners of each triangle: uint32, little-endian, in Base64.
    pub triangles: String,
}
