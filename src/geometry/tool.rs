//! The tool as a mesh.

use ipc_types::messages::{Pose, State};
use ipc_types::scene::{Cutter, CutterZone, ToolRadii};
use nalgebra::{Quaternion, UnitQuaternion, Vector3};

use super::mesh::Mesh;

/// Vertices per cross-section.
const SIDES: u32 = 24;
/// Circles per ball of the burr between its poles.
const CIRCLES: u32 = 11;

/// Builds the mesh of the tool in a state: a closed tube through base and links up to the burr, the burr, and
/// the outer tube if present.
pub fn surface(state: &State, radii: &ToolRadii) -> Mesh {
    let count = (state.joint_count as usize).min(state.t_world_link.len());
    let poses =
        [&state.t_world_base].into_iter().chain(&state.t_world_link[..count]).chain([&state.t_world_burr]);
    let mut rings: Vec<Ring> =
        poses.map(|pose| Ring { pose, ahead_m: 0.0, radius_m: radii.tube_outer_m }).collect();
    if let Some(end) = rings.last_mut() {
        end.ahead_m = -radii.cutter.span_m();
    }
    let mut tool = swept(&rings);
    if let Some(outer) = &radii.outer_tube {
        let ring = |ahead_m: f64| Ring { pose: &state.t_world_base, ahead_m, radius_m: outer.outer_m };
        tool.add(&swept(&[ring(0.0), ring(outer.end_m)]));
    }
    tool.add(&swept(&burr_rings(&state.t_world_burr, &radii.cutter)));
    tool
}

/// Returns the circles of the burr from back to front: those in each ball's own zone, and those where two
/// balls meet.
fn burr_rings<'p>(pose: &'p Pose, cutter: &Cutter) -> Vec<Ring<'p>> {
    let zones: Vec<CutterZone> = cutter.zones().collect();
    let mut rings = Vec::new();
    for (number, CutterZone { ball, ahead_m: [from_m, to_m] }) in zones.iter().enumerate().rev() {
        for circle in 1..=CIRCLES {
            let angle = core::f64::consts::PI * f64::from(circle) / f64::from(CIRCLES + 1);
            let [along_m, radius_m] = [-angle.cos(), angle.sin()].map(|x| x * ball.radius_m);
            if along_m > *from_m && along_m < *to_m {
                rings.push(Ring { pose, ahead_m: along_m - ball.behind_m, radius_m });
            }
        }
        if number > 0 {
            let radius_m = (ball.radius_m * ball.radius_m - to_m * to_m).max(0.0).sqrt();
            rings.push(Ring { pose, ahead_m: to_m - ball.behind_m, radius_m });
        }
    }
    rings
}

/// A circle perpendicular to the z axis of a pose.
struct Ring<'a> {
    pose: &'a Pose,
    ahead_m: f64,
    radius_m: f64,
}

impl Ring<'_> {
    fn point_mm(&self, x_m: f64, y_m: f64) -> [f64; 3] {
        let [x, y, z, w] = self.pose.orientation_xyzw;
        let turn = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
        let place_m = Vector3::from(self.pose.position_m) + turn * Vector3::new(x_m, y_m, self.ahead_m);
        (place_m * 1e3).into()
    }
}

/// Builds the surface through consecutive circles, closed by a flat cap at each end.
fn swept(rings: &[Ring]) -> Mesh {
    let mut mesh = Mesh::default();
    for ring in rings {
        mesh.points_mm.extend((0..SIDES).map(|side| {
            let angle = core::f64::consts::TAU * f64::from(side) / f64::from(SIDES);
            ring.point_mm(ring.radius_m * angle.cos(), ring.radius_m * angle.sin())
        }));
    }
    let count = rings.len() as u32;
    let lids = rings.first().into_iter().chain(rings.last());
    mesh.points_mm.extend(lids.map(|ring| ring.point_mm(0.0, 0.0)));
    let (behind, ahead) = (count * SIDES, count * SIDES + 1);
    for side in 0..SIDES {
        let next = (side + 1) % SIDES;
        for ring in 1..count {
            let (near, far) = ((ring - 1) * SIDES, ring * SIDES);
            mesh.triangles.push([near + side, near + next, far + next]);
            mesh.triangles.push([near + side, far + next, far + side]);
        }
        let last = (count - 1) * SIDES;
        mesh.triangles.push([behind, next, side]);
        mesh.triangles.push([ahead, last + side, last + next]);
    }
    mesh
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::mesh::tests::assert_closed;
    use ipc_types::scene::STANDARD_RADII;

    /// A straight tool of 40 mm against the exact cylinder and ball. 24 vertices enclose sin(15°)/15° = 98.9
    /// % of a circle's area, and 12 zones of the ball slightly less.
    #[test]
    fn a_straight_tool_has_the_volume_of_its_cylinder_and_its_burr() {
        let mut state = State::zeroed();
        let at = |z_m: f64| Pose { position_m: [0.1, 0.2, z_m], orientation_xyzw: [0.0, 0.0, 0.0, 1.0] };
        state.joint_count = 2;
        (state.t_world_base, state.t_world_burr) = (at(0.0), at(0.04));
        (state.t_world_link[0], state.t_world_link[1]) = (at(0.01), at(0.03));
        let mesh = surface(&state, &STANDARD_RADII);
        assert_closed(&mesh);
        let pi = core::f64::consts::PI;
        let expected_mm3 = pi * 3.0 * 3.0 * 40.0 + 4.0 / 3.0 * pi * 3.25_f64.powi(3);
        let share = mesh.volume_mm3() / expected_mm3;
        assert!((0.98..0.99).contains(&share), "{share}");
    }
}
