//! Content of `/view/info`: the scene as the page needs it.

use ipc_types::scene::Scene;
use serde_json::{Value, json};

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
    /// Radius of the burr.
    pub burr_radius_m: f64,
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
}

/// The message.
pub fn info(scene: &Scene, origin: &Origin, tool: &ToolShape, volume: Option<&VolumeBox>) -> Value {
    let (kind, key, place) = match origin {
        Origin::Live(folder) => ("live", "session", folder),
        Origin::Log(file) => ("log", "path", file),
    };
    let mut value = json!({
        "kind": kind,
        "scene": scene_part(scene),
        "tool": tool_part(tool),
        "volume": volume.map(|v| json!({"min_m": v.min_m, "max_m": v.max_m, "spacing_m": v.spacing_m})),
        "controllers": scene.controller_names(),
        // What the viewer's own controller may drive.
        "drives": scene.controller.iter().find(|controller| controller.name == CONTROLLER).map(|own| &own.drives),
        "c_arm": scene.drr.as_ref().map(|drr| json!({
            "isocentre_m": drr.isocentre_mm.map(metres),
            "primary_angle_deg": drr.primary_angle_deg,
            "secondary_angle_deg": drr.secondary_angle_deg,
            "source_isocentre_m": metres(drr.source_isocentre_mm),
            "source_detector_m": metres(drr.source_detector_mm),
            "columns": drr.columns, "rows": drr.rows, "pixel_pitch_m": metres(drr.pixel_pitch_mm),
            "rate_hz": drr.rate_hz,
        })),
        // The detector's whole range: 16 bits per pixel.
        "window": scene.drr.as_ref().map(|_| json!({"low": 0, "high": 65535})),
    });
    value[key] = json!(place);
    value
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
        "target_m": drilling.and_then(|drilling| drilling.target_mm).map(|target| target.map(metres)),
        "planned_path_m": planned_path(scene),
    })
}

/// Planned path of the burr, as far as the scene defines it: from its start along the tool to where the bend begins, then to the target if
/// there is one, otherwise straight to the end of the insertion.
fn planned_path(scene: &Scene) -> Option<Vec<[f64; 3]>> {
    let start = scene.tool.burr_start_mm;
    let along = |length_mm: f64| -> [f64; 3] {
        let direction = unit(scene.tool.direction);
        core::array::from_fn(|axis| metres(start[axis] + length_mm * direction[axis]))
    };
    let path = scene.controller.iter().find_map(|controller| {
        let skiving = controller.skiving.as_ref().map(|skiving| vec![along(0.0), along(skiving.depth_mm)]);
        let drilling = controller.curved_drilling.as_ref().map(|drilling| match drilling.target_mm {
            Some(target) => bent(along(0.0), along(drilling.ramp_start_mm), target.map(metres)),
            None => vec![along(0.0), along(drilling.insertion_mm)],
        });
        drilling.or(skiving)
    });
    path.filter(|points| points.len() > 1)
}

/// Straight to the knee, then a parabola that continues the line and ends at the target: the path of a tool whose tension rises evenly.
fn bent(start: [f64; 3], knee: [f64; 3], target: [f64; 3]) -> Vec<[f64; 3]> {
    const PIECES: usize = 24;
    let direction = unit(core::array::from_fn(|axis| knee[axis] - start[axis]));
    let rest: [f64; 3] = core::array::from_fn(|axis| target[axis] - knee[axis]);
    let length: f64 = (0..3).map(|axis| rest[axis] * direction[axis]).sum();
    let point = |piece: usize| {
        let t = piece as f64 / PIECES as f64;
        core::array::from_fn(|axis| {
            let sideways = rest[axis] - length * direction[axis];
            knee[axis] + t * length * direction[axis] + t * t * sideways
        })
    };
    core::iter::once(start).chain((0..=PIECES).map(point)).collect()
}

/// The vector normalised to length 1.
pub(crate) fn unit(vector: [f64; 3]) -> [f64; 3] {
    let length = vector.iter().map(|x| x * x).sum::<f64>().sqrt();
    if length > 0.0 { vector.map(|x| x / length) } else { vector }
}

fn tool_part(tool: &ToolShape) -> Value {
    let ends = tool
        .joint_positions_m
        .iter()
        .skip(1)
        .copied()
        .chain(tool.joint_positions_m.last().map(|z| z + tool.tip_offset_m));
    let links: Vec<Value> = tool
        .joint_positions_m
        .iter()
        .zip(ends)
        .map(|(start, end)| json!({"length_m": end - start, "outer_radius_m": tool.outer_radius_m}))
        .collect();
    json!({
        "links": links,
        "burr_radius_m": tool.burr_radius_m,
        "shaft": {"length_m": tool.joint_positions_m.first(), "radius_m": tool.outer_radius_m},
    })
}
