//! X-ray model of the manipulator and its burr.

use messages::{Pose, State};
use scene::{Notch as SceneNotch, ToolRadii};

use crate::{Material, Notch, Tool, ToolPart};

/// Shaft and links as nitinol tubes around a steel cable, the burr as a steel ball. With `notch`, every link between two flexures has a
/// notch at its middle, on alternating sides of the bending plane. The burr is the last part.
pub fn tool_of(state: &State, radii: &ToolRadii, notch: Option<&SceneNotch>) -> Tool {
    let links = &state.t_world_link[..(state.joint_count as usize).min(state.t_world_link.len())];
    let origins = core::iter::once(&state.t_world_base).chain(links);
    let ends = links.iter().chain(core::iter::once(&state.t_world_burr));
    let mut parts = Vec::with_capacity(2 * links.len() + 3);
    for (number, (start, end)) in origins.zip(ends).enumerate() {
        let (start_m, end_m) = (start.position_m, end.position_m);
        if distance(start, end) < 1e-6 {
            continue;
        }
        // The first part is the rigid shaft.
        let cut = notch.filter(|_| number > 0).and_then(|notch| notch_between(notch, number, start, end));
        let (outer_radius_m, inner_radius_m) = (radii.tube_outer_m, radii.tube_inner_m);
        let material = Material::Nitinol;
        parts.push(match cut {
            // A solid rod.
            _ if inner_radius_m == 0.0 => {
                ToolPart::Cylinder { start_m, end_m, radius_m: outer_radius_m, material }
            }
            None => ToolPart::HollowCylinder { start_m, end_m, outer_radius_m, inner_radius_m, material },
            Some(notch) => {
                ToolPart::NotchedTube { start_m, end_m, outer_radius_m, inner_radius_m, notch, material }
            }
        });
        if radii.drive_cable_m > 0.0 {
            parts.push(ToolPart::Cylinder {
                start_m,
                end_m,
                radius_m: radii.drive_cable_m,
                material: Material::Steel316L,
            });
        }
    }
    let centre_m = state.t_world_burr.position_m;
    parts.push(ToolPart::Sphere { centre_m, radius_m: radii.burr_m, material: Material::Steel316L });
    Tool { parts }
}

/// The points of the tool that a frame's labels name: base, each joint from base to tip, burr. World, m.
pub fn points_of(state: &State) -> Vec<[f64; 3]> {
    let links = &state.t_world_link[..(state.joint_count as usize).min(state.t_world_link.len())];
    let poses = core::iter::once(&state.t_world_base).chain(links);
    poses.chain(core::iter::once(&state.t_world_burr)).map(|pose| pose.position_m).collect()
}

/// The notch of a link; `None` if the link is too short for it.
fn notch_between(notch: &SceneNotch, number: usize, start: &Pose, end: &Pose) -> Option<Notch> {
    let (length_m, width_m) = (distance(start, end), notch.width_mm * 1e-3);
    if width_m >= length_m {
        return None;
    }
    let axis: [f64; 3] = core::array::from_fn(|i| (end.position_m[i] - start.position_m[i]) / length_m);
    // +x of the link points toward tendon 0; remove its component along the axis.
    let x = x_axis(&start.orientation_xyzw);
    let along: f64 = axis.iter().zip(&x).map(|(a, b)| a * b).sum();
    let across: [f64; 3] = core::array::from_fn(|i| x[i] - along * axis[i]);
    let size = libm::sqrt(across.iter().map(|a| a * a).sum());
    let turn = if number.is_multiple_of(2) { 1.0 } else { -1.0 };
    let side = across.map(|a| turn * a / size);
    (size > 0.1).then_some(Notch {
        offset_m: 0.5 * (length_m - width_m),
        width_m,
        side,
        depth_m: notch.depth_mm * 1e-3,
    })
}

/// First column of the rotation matrix of a unit quaternion.
fn x_axis([x, y, z, w]: &[f64; 4]) -> [f64; 3] {
    [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + z * w), 2.0 * (x * z - y * w)]
}

fn distance(a: &Pose, b: &Pose) -> f64 {
    let squares = a.position_m.iter().zip(&b.position_m).map(|(x, y)| (x - y) * (x - y));
    libm::sqrt(squares.sum())
}
