//! The tool as the X-ray sees it.

use ipc_types::messages::{Pose, State};

use crate::{Material, Tool, ToolPart};

/// Outer and inner radius of the notched nitinol tube (6 / 4 mm), and of the drive cable in its lumen.
const TUBE_OUTER_RADIUS_M: f64 = 3.0e-3;
const TUBE_INNER_RADIUS_M: f64 = 2.0e-3;
const CABLE_RADIUS_M: f64 = 1.0e-3;

/// Shaft and links as nitinol tubes with a steel cable inside, and the burr as a steel ball.
pub fn tool_of(state: &State, burr_radius_m: f64) -> Tool {
    let links = &state.t_world_link[..(state.joint_count as usize).min(state.t_world_link.len())];
    let origins = core::iter::once(&state.t_world_base).chain(links);
    let ends = links.iter().chain(core::iter::once(&state.t_world_burr));
    let mut parts = Vec::with_capacity(2 * links.len() + 3);
    for (start, end) in origins.zip(ends) {
        let (start_m, end_m) = (start.position_m, end.position_m);
        if distance(start, end) < 1e-6 {
            continue;
        }
        parts.push(ToolPart::HollowCylinder {
            start_m,
            end_m,
            outer_radius_m: TUBE_OUTER_RADIUS_M,
            inner_radius_m: TUBE_INNER_RADIUS_M,
            material: Material::Nitinol,
        });
        parts.push(ToolPart::Cylinder {
            start_m,
            end_m,
            radius_m: CABLE_RADIUS_M,
            material: Material::Steel316L,
        });
    }
    let centre_m = state.t_world_burr.position_m;
    parts.push(ToolPart::Sphere { centre_m, radius_m: burr_radius_m, material: Material::Steel316L });
    Tool { parts }
}

fn distance(a: &Pose, b: &Pose) -> f64 {
    let squares = a.position_m.iter().zip(&b.position_m).map(|(x, y)| (x - y) * (x - y));
    libm::sqrt(squares.sum())
}
