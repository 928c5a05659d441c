//! Curvature along the tool, and the shape integrated from it.
//!
//! The tool bends at its flexures. Each flexure's angle is spread evenly over the section between the
//! midpoints to its neighbours, so the curvature is constant there. A node reads the mean curvature over its
//! gauge length, in two directions: toward tendon 0 (the bend plane, +x of the tool's base) and across (+y).

use messages::{MAX_JOINTS, Pose, State};
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use crate::measure::rotation;

/// Integration steps along the fibre when computing a shape from curvatures; each is a circular arc.
const STEPS: usize = 128;

/// Positions of a fibre's nodes from its start, as fractions of its length: the midpoints of equal sections.
pub fn node_places(nodes: u32) -> impl Iterator<Item = f64> {
    (0..nodes).map(move |node| (f64::from(node) + 0.5) / f64::from(nodes))
}

/// The bending part of a tool as sections of constant curvature.
struct Stretches {
    /// Ends of the sections from the fibre's start, metres.
    end_m: [f64; MAX_JOINTS],
    /// Curvature of each, toward and across, 1/m.
    curvature_per_m: [[f64; 2]; MAX_JOINTS],
    count: usize,
}

impl Stretches {
    fn of(state: &State) -> Stretches {
        let count = (state.joint_count as usize).min(MAX_JOINTS);
        let mut stretches =
            Stretches { end_m: [0.0; MAX_JOINTS], curvature_per_m: [[0.0; 2]; MAX_JOINTS], count };
        let mut before = rotation(&t_world_tube(state));
        let mut start_m = 0.0;
        for i in 0..count {
            let length_m = stretch_m(state, i, count);
            let here = rotation(&state.t_world_link[i]);
            let turn = (before.inverse() * here).scaled_axis();
            if length_m > 0.0 {
                // A rotation about +y bends toward +x, one about -x toward +y.
                stretches.curvature_per_m[i] = [turn.y / length_m, -turn.x / length_m];
            }
            start_m += length_m;
            stretches.end_m[i] = start_m;
            before = here;
        }
        stretches
    }

    fn length_m(&self) -> f64 {
        self.count.checked_sub(1).map_or(0.0, |last| self.end_m[last])
    }

    /// Mean curvature between two positions.
    fn mean_per_m(&self, from_m: f64, to_m: f64) -> [f64; 2] {
        let (mut sum, mut covered_m, mut start_m) = ([0.0; 2], 0.0, 0.0);
        for (end_m, curvature) in self.end_m.iter().zip(&self.curvature_per_m).take(self.count) {
            let overlap_m = (end_m.min(to_m) - f64::max(start_m, from_m)).max(0.0);
            sum[0] += overlap_m * curvature[0];
            sum[1] += overlap_m * curvature[1];
            covered_m += overlap_m;
            start_m = *end_m;
        }
        if covered_m > 0.0 { sum.map(|x| x / covered_m) } else { [0.0; 2] }
    }
}

/// Pose of the base of the tube that contains the fibre. It differs from the tool's base only if the tool has
/// slid out of an outer tube and rotated in it.
pub fn t_world_tube(state: &State) -> Pose {
    if state.tube_deployed_m == 0.0 && state.tube_roll_rad == 0.0 {
        return state.t_world_base;
    }
    let base = rotation(&state.t_world_base);
    let ahead = base * Vector3::new(0.0, 0.0, state.tube_deployed_m);
    let turned = base * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), state.tube_roll_rad);
    Pose {
        position_m: (Vector3::from(state.t_world_base.position_m) + ahead).into(),
        orientation_xyzw: [turned.i, turned.j, turned.k, turned.w],
    }
}

fn distance_m(a: &Pose, b: &Pose) -> f64 {
    (Vector3::from(a.position_m) - Vector3::from(b.position_m)).norm()
}

/// Length of tool that bends at flexure i: half the distance to each neighbour; at the ends, the full
/// distance to the only neighbour.
fn stretch_m(state: &State, i: usize, count: usize) -> f64 {
    let link = &state.t_world_link;
    let before = (i > 0).then(|| distance_m(&link[i - 1], &link[i]));
    let after = (i + 1 < count).then(|| distance_m(&link[i], &link[i + 1]));
    match (before, after) {
        (Some(before), Some(after)) => 0.5 * (before + after),
        (Some(only), None) | (None, Some(only)) => only,
        (None, None) => distance_m(&link[i], &state.t_world_burr),
    }
}

/// Error-free node readings: curvature toward and across for each node, from base to tip, 1/m. All zero for a
/// tool that does not bend.
pub fn node_curvatures(state: &State, nodes: u32, gauge_m: f64) -> impl Iterator<Item = f64> {
    let stretches = Stretches::of(state);
    let length_m = stretches.length_m();
    node_places(nodes).flat_map(move |share| {
        let (from_m, to_m) = (share * length_m - 0.5 * gauge_m, share * length_m + 0.5 * gauge_m);
        stretches.mean_per_m(from_m, to_m)
    })
}

/// Location of a fibre in its tool, as needed to compute a shape from curvatures. Depends only on the tool's
/// dimensions in a state, not on its shape.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Fibre {
    /// From the tube's base ([`t_world_tube`]) to the fibre's start, metres.
    pub start_m: f64,
    /// Length of the fibre, metres.
    pub length_m: f64,
    /// From the fibre's end to the centre of the burr, metres.
    pub tip_m: f64,
}

impl Fibre {
    /// Locates the fibre of the tool in a state.
    pub fn of(state: &State) -> Fibre {
        let count = (state.joint_count as usize).min(MAX_JOINTS);
        let Some(last) = count.checked_sub(1) else {
            return Fibre {
                start_m: 0.0,
                length_m: 0.0,
                tip_m: distance_m(&t_world_tube(state), &state.t_world_burr),
            };
        };
        let length_m = Stretches::of(state).length_m();
        let first_m = 0.5 * stretch_m(state, 0, count);
        let last_m = 0.5 * stretch_m(state, last, count);
        Fibre {
            start_m: distance_m(&t_world_tube(state), &state.t_world_link[0]) - first_m,
            length_m,
            tip_m: distance_m(&state.t_world_link[last], &state.t_world_burr) - last_m,
        }
    }

    /// Computes the pose of the burr from that of the tube's base and the node curvatures (toward and across
    /// for each). Between nodes the curvature is interpolated linearly; outside it is that of the nearest
    /// node.
    pub fn burr(&self, t_world_tube: &Pose, curvatures_per_m: &[f64]) -> Pose {
        let nodes = (curvatures_per_m.len() / 2) as u32;
        let mut here = Isometry3::from_parts(
            Translation3::from(Vector3::from(t_world_tube.position_m)),
            rotation(t_world_tube),
        ) * Translation3::new(0.0, 0.0, self.start_m);
        let step_m = self.length_m / STEPS as f64;
        for step in 0..STEPS {
            let share = (step as f64 + 0.5) / STEPS as f64;
            let [toward, across] = interpolated(curvatures_per_m, nodes, share);
            here *= arc(Vector3::new(-across, toward, 0.0), step_m);
        }
        here *= Translation3::new(0.0, 0.0, self.tip_m);
        let orientation: &Quaternion<f64> = &here.rotation;
        Pose {
            position_m: here.translation.vector.into(),
            orientation_xyzw: [orientation.i, orientation.j, orientation.k, orientation.w],
        }
    }
}

/// Curvature at a fraction of the fibre's length.
fn interpolated(curvatures_per_m: &[f64], nodes: u32, share: f64) -> [f64; 2] {
    if nodes == 0 {
        return [0.0; 2];
    }
    let place = (share * f64::from(nodes) - 0.5).clamp(0.0, f64::from(nodes - 1));
    let before = (place as usize).min(nodes as usize - 1);
    let after = (before + 1).min(nodes as usize - 1);
    let rest = place - before as f64;
    [0, 1].map(|axis| {
        let (a, b) = (curvatures_per_m[2 * before + axis], curvatures_per_m[2 * after + axis]);
        a + (b - a) * rest
    })
}

/// Pose at the end of a circular arc along +z that rotates by `turn_per_m` per metre: half the rotation, the
/// chord, half the rotation.
fn arc(turn_per_m: Vector3<f64>, length_m: f64) -> Isometry3<f64> {
    let half = UnitQuaternion::from_scaled_axis(turn_per_m * (0.5 * length_m));
    let angle = turn_per_m.norm() * length_m;
    let chord_m = if angle > 1e-9 { length_m * libm::sin(0.5 * angle) / (0.5 * angle) } else { length_m };
    let turned = Isometry3::from_parts(Translation3::identity(), half);
    turned * Translation3::new(0.0, 0.0, chord_m) * turned
}
