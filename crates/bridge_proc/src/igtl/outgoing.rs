//! Builds the messages that the bridge sends.

use ipc_types::messages::{Frame, Phase, Pose, RunStatus, SensorReading, State};
use ipc_types::scene::{Scene, StructureRole, ToolRadii, planned_path_mm};
use openigtlink::{Body, Coordinates, Image, Message, Point, PolyData, Timestamp};

use crate::ras;

/// Device names of the messages that a peer receives, and their contents. A test compares `docs/slicer.md`
/// with it.
pub const SENT: [(&str, &str, &str); 11] = [
    ("TRANSFORM", "BurrToRAS", "the burr's centre, axes of the last link"),
    ("TRANSFORM", "TipToRAS", "the front of the burr"),
    ("TRANSFORM", "BaseToRAS", "the tool's base"),
    ("TRANSFORM", "FlangeToRAS", "the arm's flange"),
    ("TRANSFORM", "Link01ToRAS and so on", "each link after its flexure, base to tip"),
    ("POLYDATA", "Tool", "the tool's surface in RAS, five times a second"),
    ("IMAGE", "XRay", "the newest scheduled X-ray frame, 16 bit, at its detector"),
    ("IMAGE", "XRayOnRequest", "the newest requested frame, as with `CArmToRAS`"),
    (
        "POINT",
        "Scene",
        "the scene's points: `BurrStart`, `Target` if a controller has one, ends of predrilled holes",
    ),
    (
        "POLYDATA",
        "PlannedPath",
        "the planned path of the burr's centre as a line, if a built-in controller drills; once per \
         connection",
    ),
    (
        "STRING",
        "State",
        "tick, time, phase, force, removal and, with a `[[structure]]`, the least clearance from those to \
         avoid (`least_clearance_mm`, `nearest_structure`) as `name=value`, five times a second",
    ),
];

/// Corners of the tube's cross-section.
const SIDES: u32 = 12;

/// Builds a message. The names in this module are short ASCII, so building one does not fail.
pub(crate) fn message(device: &str, timestamp: Timestamp, body: Body) -> Message {
    Message { device: device.to_owned(), timestamp, body }
}

/// Returns the links in use.
fn links(state: &State) -> &[Pose] {
    let count = usize::try_from(state.joint_count).unwrap_or(usize::MAX);
    &state.t_world_link[..count.min(state.t_world_link.len())]
}

/// Returns the poses of a state.
pub(crate) fn poses(state: &State, timestamp: Timestamp) -> Vec<Message> {
    let pose = |device: &str, pose: &Pose| message(device, timestamp, Body::Transform(ras::transform(pose)));
    let mut messages = vec![
        pose("BurrToRAS", &state.t_world_burr),
        pose("TipToRAS", &state.t_world_tip),
        pose("BaseToRAS", &state.t_world_base),
        pose("FlangeToRAS", &state.t_world_flange),
    ];
    let numbered = links(state).iter().enumerate();
    messages.extend(numbered.map(|(index, link)| pose(&format!("Link{:02}ToRAS", index + 1), link)));
    messages
}

/// Returns the name of the structure to avoid that is closest according to a reading of kind `clearance`, and
/// the clearance from it, m; `None` without such a structure.
pub(crate) fn least_clearance<'s>(scene: &'s Scene, reading: &SensorReading) -> Option<(&'s str, f64)> {
    let all = scene.structure.iter().zip(reading.clearances_m());
    let avoided = all.filter(|(structure, _)| structure.role != StructureRole::Target);
    let named = avoided.map(|(structure, clearance_m)| (structure.name.as_str(), clearance_m));
    named.min_by(|(_, a), (_, b)| a.total_cmp(b))
}

/// Formats figures of a state as text, with the [`least_clearance`].
pub(crate) fn figures(
    state: &State,
    status: Option<&RunStatus>,
    least: Option<(&str, f64)>,
    timestamp: Timestamp,
) -> Message {
    let phase = status.and_then(|status| status.phase().ok()).unwrap_or(Phase::Running).word();
    let mut text = format!(
        "tick={} sim_time_s={:.6} phase={phase} bend_deg={:.3} burr_force_n={:.4} burr_speed_rpm={:.1} \
         removed_voxels={}",
        state.tick,
        state.sim_time_s,
        state.bend_rad.to_degrees(),
        state.burr_force_n,
        state.burr_speed_rad_per_s * 30.0 / core::f64::consts::PI,
        state.removed_total,
    );
    if let Some((name, least_m)) = least {
        text += &format!(" least_clearance_mm={:.3} nearest_structure={name}", least_m * 1e3);
    }
    message("State", timestamp, Body::Text(text))
}

/// A circle perpendicular to a pose's z axis: radius, and distance behind the pose, m.
type Ring<'p> = (&'p Pose, f64, f64);

/// Builds the tool's surface: a tube through base, links and burr, closed by the widest circle of the burr,
/// or of its balls, and its tip; and the surrounding outer tube if there is one.
pub(crate) fn tool(state: &State, radii: &ToolRadii, timestamp: Timestamp) -> Message {
    let tube_m = radii.tube_outer_m;
    let mut rings: Vec<Ring> = vec![(&state.t_world_base, tube_m, 0.0)];
    rings.extend(links(state).iter().map(|link| (link, tube_m, 0.0)));
    let balls = radii.cutter.balls().iter().rev();
    rings.extend(balls.map(|ball| (&state.t_world_burr, ball.radius_m, ball.behind_m)));
    rings.push((&state.t_world_tip, 0.0, 0.0));
    let mut surface = PolyData::default();
    add_tube(&mut surface, &rings);
    if let Some(outer) = &radii.outer_tube {
        let base = &state.t_world_base;
        add_tube(&mut surface, &[(base, outer.outer_m, 0.0), (base, outer.outer_m, -outer.end_m)]);
    }
    message("Tool", timestamp, Body::PolyData(surface))
}

/// Adds the surface through a sequence of circles, one ahead of the other.
fn add_tube(surface: &mut PolyData, rings: &[Ring]) {
    let first = surface.points_mm.len() as u32;
    for (pose, radius_m, behind_m) in rings {
        let behind_mm = (1000.0 * behind_m) as f32;
        let transform = ras::transform(pose);
        let radius_mm = (1000.0 * radius_m) as f32;
        surface.points_mm.extend((0..SIDES).map(|side| {
            let angle = core::f32::consts::TAU * side as f32 / SIDES as f32;
            let (sin, cos) = angle.sin_cos();
            core::array::from_fn(|axis| {
                let [x, y, z] = transform.rotation[axis];
                transform.translation_mm[axis] - behind_mm * z + radius_mm * (x * cos + y * sin)
            })
        }));
    }
    for ring in 0..rings.len() as u32 - 1 {
        for side in 0..SIDES {
            let next = (side + 1) % SIDES;
            let (near, far) = (first + ring * SIDES, first + (ring + 1) * SIDES);
            surface.polygons.push(vec![near + side, near + next, far + next, far + side]);
        }
    }
}

/// Places an X-ray at its detector: axis i along the rows, j down the columns, k from the detector toward the
/// source.
pub(crate) fn x_ray(frame: &Frame, pixels: &[u16], timestamp: Timestamp) -> Option<Message> {
    let geometry = &frame.geometry;
    let size = [u16::try_from(geometry.columns).ok()?, u16::try_from(geometry.rows).ok()?, 1];
    let [pitch_row_m, pitch_column_m] = geometry.pixel_pitch_m;
    let row = ras::direction(geometry.row_axis).map(|axis| axis * (1000.0 * pitch_row_m) as f32);
    let column = ras::direction(geometry.column_axis).map(|axis| axis * (1000.0 * pitch_column_m) as f32);
    let normal = cross(ras::direction(geometry.row_axis), ras::direction(geometry.column_axis));
    let image = Image {
        coordinates: Coordinates::Ras,
        size,
        axes_mm: core::array::from_fn(|axis| [row[axis], column[axis], normal[axis]]),
        centre_mm: ras::position_mm(geometry.detector_centre_m),
        samples: pixels.to_vec(),
    };
    let device = if frame.request_id == 0 { "XRay" } else { "XRayOnRequest" };
    Some(message(device, timestamp, Body::Image(image)))
}

fn cross([ax, ay, az]: [f32; 3], [bx, by, bz]: [f32; 3]) -> [f32; 3] {
    [ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx]
}

/// Converts a position of the scene (LPS, mm) to Slicer's frame.
fn scene_mm(place_mm: [f64; 3]) -> [f32; 3] {
    ras::position_mm(place_mm.map(|component| component / 1000.0))
}

/// Returns the scene's points.
pub(crate) fn scene_points(scene: &Scene, timestamp: Timestamp) -> Message {
    let point = |name: String, group: &str, position_mm: [f32; 3]| Point {
        name,
        group: group.to_owned(),
        rgba: [255, 200, 0, 255],
        position_mm,
        diameter_mm: 2.0,
        owner: String::new(),
    };
    let mut points = vec![point("BurrStart".into(), "Tool", scene_mm(scene.tool.burr_start_mm))];
    for controller in &scene.controller {
        if let Some(target_mm) = controller.curved_drilling.as_ref().and_then(|drilling| drilling.target_mm) {
            points.push(point("Target".into(), "Plan", scene_mm(target_mm)));
        }
    }
    for (index, hole) in scene.predrill.iter().enumerate() {
        points.push(point(format!("Hole{}From", index + 1), "Predrill", scene_mm(hole.from_mm)));
        points.push(point(format!("Hole{}To", index + 1), "Predrill", scene_mm(hole.to_mm)));
    }
    message("Scene", timestamp, Body::Points(points))
}

/// Returns the planned path of the burr's centre; `None` without a built-in controller that drills.
pub(crate) fn planned_path(scene: &Scene, timestamp: Timestamp) -> Option<Message> {
    let points_mm: Vec<[f32; 3]> = planned_path_mm(scene)?.into_iter().map(scene_mm).collect();
    let lines = vec![(0..points_mm.len() as u32).collect()];
    let surface = PolyData { points_mm, lines, ..PolyData::default() };
    Some(message("PlannedPath", timestamp, Body::PolyData(surface)))
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use ipc_types::messages::SensorKind;
    use zerocopy::FromZeros;

    use super::*;

    /// The text has nothing of a target, which the tool is meant to enter.
    #[test]
    fn the_least_clearance_is_that_of_the_nearest_structure_to_avoid() {
        let ball = "ball = { centre_mm = [0.0, 9.0, 0.0], radius_mm = 1.0 }";
        let text = format!(
            "name = \"bench\"\n[run]\nmode = \"lockstep\"\nduration_s = 1.0\n[tool]\n\
             burr_start_mm = [0.0, 0.0, 0.0]\ndirection = [0.0, 0.0, 1.0]\nbend_toward = [1.0, 0.0, 0.0]\n\
             [[structure]]\nname = \"tumour\"\nrole = \"target\"\n{ball}\n\
             [[structure]]\nname = \"nerve\"\n{ball}\n[[structure]]\nname = \"vessel\"\n{ball}\n"
        );
        let scene = Scene::parse(&text, Path::new("bench.toml")).unwrap();
        let kind = SensorKind::Clearance.code();
        let mut reading = SensorReading { kind, value_count: 6, ..SensorReading::new_zeroed() };
        reading.value[..6].copy_from_slice(&[-3e-3, 1.0, 2e-3, 7.0, -0.5e-3, 28.0]);
        let least = least_clearance(&scene, &reading);
        let Body::Text(text) = figures(&State::new_zeroed(), None, least, Timestamp::default()).body else {
            panic!()
        };
        assert!(text.ends_with(" least_clearance_mm=-0.500 nearest_structure=vessel"), "{text}");
    }
}
