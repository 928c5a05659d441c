//! Content of `/view/info`: the scene as the page needs it.

use ipc_types::messages::Pose;
use ipc_types::scene::{Cutter, Holder, OuterTubeSize, Scene, StructureRole, planned_path_in_bone_mm};
use serde_json::{Value, json};
use voxel_grid::slice::ANATOMICAL;

use crate::board::Board;
use crate::channels::ARM;
use crate::slice::{DRILLED, MOST_PIXELS, OUTSIDE};
use crate::surface::BlockMesh;

/// The viewer's controller name in a scene.
pub const CONTROLLER: &str = "viewer";

/// The tool's shape, in metres.
#[derive(Debug, Clone, PartialEq)]
pub struct ToolShape {
    /// z of each flexure from the tool base, for the straight tool.
    pub joint_positions_m: Vec<f64>,
    /// From the last flexure to the burr centre.
    pub tip_offset_m: f64,
    /// Outer radius of the tube.
    pub outer_radius_m: f64,
    /// The tube out of which the tool slides, if there is one.
    pub outer_tube: Option<OuterTubeSize>,
    /// The burr.
    pub cutter: Cutter,
    /// What joins the tool to the arm.
    pub holder: Holder,
    /// Parts of the arm between its joints: frame i + 1 in frame i while joint i + 1 is at zero. The joint
    /// turns about z of frame i; the last frame is the flange. `None` for an arm without joints.
    pub arm_parts: Option<Vec<Pose>>,
}

/// The arm's links that have a mesh; the others are drawn as tubes.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ArmMeshes {
    /// One mesh per link; its block is the frame it moves with, from 0 (the arm's base) to the flange.
    pub meshes: Vec<BlockMesh>,
    /// Notes for the user on links without a mesh.
    pub notes: Vec<String>,
}

impl ArmMeshes {
    /// Publishes the meshes, also to clients that connect later.
    pub(crate) fn publish(&self, board: &Board) {
        for mesh in &self.meshes {
            board.publish(ARM, board.time_ns(), mesh.block, mesh.bytes());
        }
        self.notes.iter().for_each(|note| board.notice("warning", note));
    }
}

/// A volume's bounding box in the patient frame, and its voxel spacing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VolumeBox {
    /// Lowest corner.
    pub min_m: [f64; 3],
    /// Highest corner.
    pub max_m: [f64; 3],
    /// Distance between voxel centres.
    pub spacing_m: [f64; 3],
}

/// Source of the scene.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Origin {
    /// A running session, by its folder.
    Live(String),
    /// A log, by its file.
    Log(String),
    /// A scene before its run, by its file.
    Plan(String),
}

/// Returns the message.
pub fn info(scene: &Scene, origin: &Origin, tool: &ToolShape, volume: Option<&VolumeBox>) -> Value {
    let (kind, key, place) = match origin {
        Origin::Live(folder) => ("live", "session", folder),
        Origin::Log(file) => ("log", "path", file),
        Origin::Plan(file) => ("plan", "path", file),
    };
    let mut value = json!({
        "kind": kind,
        "scene": scene_part(scene),
        "tool": tool_part(scene, tool),
        "arm": tool.arm_parts.as_deref()
            .map(|parts| json!({"parts": parts.iter().map(part).collect::<Vec<_>>()})),
        "volume": volume.map(|v| json!({"min_m": v.min_m, "max_m": v.max_m, "spacing_m": v.spacing_m})),
        "slices": scene.volume.as_ref().map(|_| slice_planes(scene)),
        "controllers": scene.controller_names(),
        // The quantities that the viewer's own controller can drive.
        "drives": scene.controller.iter().find(|controller| controller.name == CONTROLLER)
            .map(|own| &own.drives),
        "c_arm": scene.drr.as_ref().map(|drr| json!({
            "isocentre_m": drr.isocentre_mm.map(metres),
            "primary_angle_deg": drr.primary_angle_deg,
            "secondary_angle_deg": drr.secondary_angle_deg,
            "source_isocentre_m": metres(drr.source_isocentre_mm),
            "source_detector_m": metres(drr.source_detector_mm),
            "columns": drr.columns, "rows": drr.rows, "pixel_pitch_m": metres(drr.pixel_pitch_mm),
            "rate_hz": drr.rate_hz,
            "display": drr.display,
        })),
        // The detector's whole range: 16 bits per pixel.
        "window": scene.drr.as_ref().map(|_| json!({"low": 0, "high": 65535})),
    });
    value[key] = json!(place);
    value
}

fn part(pose: &Pose) -> Value {
    json!({"position_m": pose.position_m, "orientation_xyzw": pose.orientation_xyzw})
}

fn metres(millimetres: f64) -> f64 {
    millimetres * 1e-3
}

fn scene_part(scene: &Scene) -> Value {
    let drilling = scene.controller.iter().find_map(|controller| controller.curved_drilling.as_ref());
    json!({
        "name": scene.name,
        "dt_ns": scene.dt_ns(),
        "mode": scene.run.mode,
        "tick_count": scene.tick_count(),
        "target_m": drilling.and_then(|drilling| drilling.target_mm)
            .map(|target| scene.in_bone_mm(target).map(metres)),
        "planned_path_m": planned_path_in_bone_mm(scene)
            .map(|path| path.into_iter().map(|point| point.map(metres)).collect::<Vec<_>>()),
        "burr_start_m": scene.tool.burr_start_mm.map(metres),
        "predrill": scene.predrill.iter().map(|hole| json!({
            "from_m": hole.from_mm.map(metres), "to_m": hole.to_mm.map(metres),
            "radius_m": 0.5 * metres(hole.diameter_mm),
        })).collect::<Vec<_>>(),
        "structures": scene.structure.iter().map(|structure| json!({
            "name": structure.name,
            "margin_m": metres(structure.margin_mm),
            "is_target": structure.role == StructureRole::Target,
        })).collect::<Vec<_>>(),
    })
}

/// The planes of the slices: the anatomical ones, and the plane of feed and bend.
fn slice_planes(scene: &Scene) -> Value {
    let mut planes: Vec<Value> = ANATOMICAL
        .iter()
        .map(|plane| {
            json!({"name": plane.name, "right": plane.right, "down": plane.down, "letters": plane.letters})
        })
        .collect();
    let along = unit(scene.tool.direction);
    let toward = scene.tool.bend_toward;
    let part: f64 = (0..3).map(|axis| toward[axis] * along[axis]).sum();
    let up = unit(core::array::from_fn(|axis| toward[axis] - part * along[axis]));
    planes.push(json!({"name": "along the path", "right": along, "down": up.map(|x| -x), "letters": null}));
    json!({"planes": planes, "most_pixels": MOST_PIXELS, "outside": OUTSIDE, "drilled": DRILLED})
}

/// Returns the vector normalised to length 1.
pub(crate) fn unit(vector: [f64; 3]) -> [f64; 3] {
    let length = vector.iter().map(|x| x * x).sum::<f64>().sqrt();
    if length > 0.0 { vector.map(|x| x / length) } else { vector }
}

fn tool_part(scene: &Scene, tool: &ToolShape) -> Value {
    let from_flange_m = scene.arm.tool_position_mm.iter().map(|x| metres(*x).powi(2)).sum::<f64>().sqrt();
    let ends = tool
        .joint_positions_m
        .iter()
        .skip(1)
        .copied()
        .chain(tool.joint_positions_m.last().map(|z| z + tool.tip_offset_m - tool.cutter.span_m()));
    let links: Vec<Value> = tool
        .joint_positions_m
        .iter()
        .zip(ends)
        .map(|(start, end)| json!({"length_m": end - start, "outer_radius_m": tool.outer_radius_m}))
        .collect();
    json!({
        "links": links,
        "burr_radius_m": tool.cutter.widest_radius_m(),
        "burr_balls": tool.cutter.balls().iter().map(|ball| {
            json!({"behind_m": ball.behind_m, "radius_m": ball.radius_m})
        }).collect::<Vec<_>>(),
        "outer_tube": tool.outer_tube.map(|tube| json!({"length_m": tube.end_m, "radius_m": tube.outer_m})),
        "shaft": {"length_m": tool.joint_positions_m.first(), "radius_m": tool.outer_radius_m},
        "holder": tool.holder.reach_m(from_flange_m).map(|length_m| {
            json!({"length_m": length_m, "radius_m": tool.holder.radius_m})
        }),
    })
}
