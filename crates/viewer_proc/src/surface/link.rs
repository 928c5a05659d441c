//! Triangles as a mesh for the page: a link of the arm, or a structure.

use std::collections::HashMap;

use super::Triangle;
use super::mesh::BlockMesh;

/// Steps along the longest side of a mesh: one less than 16 bits allow.
const STEPS: f64 = 65_534.0;
/// Minimum length of a step, m, for a mesh without extent.
const LEAST_STEP_M: f64 = 1e-9;

/// Least cosine of the angle between a facet and the mean of those around a corner that is shown round.
const LEAST_ROUND: f64 = 0.8;

/// Returns the mesh of the link that moves with frame `frame` of the arm, from triangles in that frame. Every
/// facet keeps its own normal, so the edges of a housing stay sharp.
pub fn link_mesh(frame: u32, triangles_m: &[Triangle]) -> BlockMesh {
    mesh(frame, triangles_m, step_m(triangles_m), |facet, _| facet)
}

/// Returns the mesh number `number` of triangles in the patient frame. Corners between facets in similar
/// directions are shown round.
pub fn smooth_mesh(number: u32, triangles_m: &[Triangle]) -> BlockMesh {
    let scale_m = step_m(triangles_m);
    let mut sums: HashMap<[i64; 3], [f64; 3]> = HashMap::new();
    for triangle in triangles_m {
        let normal = cross(triangle);
        for corner in triangle {
            let sum = sums.entry(steps(corner, scale_m)).or_default();
            *sum = core::array::from_fn(|axis| sum[axis] + normal[axis]);
        }
    }
    mesh(number, triangles_m, scale_m, |facet, corner| {
        let mean = sums.get(&corner).copied().and_then(unit).unwrap_or(facet);
        let cosine: f64 = (0..3).map(|axis| mean[axis] * facet[axis]).sum();
        if cosine < LEAST_ROUND { facet } else { mean }
    })
}

/// Returns a mesh whose normals follow from that of a facet and one of its corners.
fn mesh(
    number: u32,
    triangles_m: &[Triangle],
    scale_m: f64,
    normal_at: impl Fn([f64; 3], [i64; 3]) -> [f64; 3],
) -> BlockMesh {
    let (mut vertices, mut normals, mut indices) = (Vec::new(), Vec::new(), Vec::new());
    let mut known: HashMap<([i64; 3], [i8; 3]), u32> = HashMap::new();
    for triangle in triangles_m {
        // A triangle without area shows nothing.
        let Some(facet) = unit(cross(triangle)) else { continue };
        for corner in triangle {
            let steps = steps(corner, scale_m);
            let normal = normal_at(facet, steps).map(|x| (127.0 * x).round() as i8);
            let index = *known.entry((steps, normal)).or_insert_with(|| {
                vertices.push(steps);
                normals.push(normal);
                vertices.len() as u32 - 1
            });
            indices.push(index);
        }
    }
    BlockMesh::new(number, scale_m, &vertices, normals, indices)
}

/// Returns the length of a step, m.
fn step_m(triangles_m: &[Triangle]) -> f64 {
    let (mut least, mut most) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for corner in triangles_m.iter().flatten() {
        for axis in 0..3 {
            least[axis] = least[axis].min(corner[axis]);
            most[axis] = most[axis].max(corner[axis]);
        }
    }
    let longest_m = (0..3).map(|axis| most[axis] - least[axis]).fold(0.0, f64::max);
    (longest_m / STEPS).max(LEAST_STEP_M)
}

fn steps(corner_m: &[f64; 3], scale_m: f64) -> [i64; 3] {
    corner_m.map(|x| (x / scale_m).round() as i64)
}

/// Returns the outward normal, twice as long as the triangle's area.
fn cross([a, b, c]: &Triangle) -> [f64; 3] {
    let along = |end: &[f64; 3]| -> [f64; 3] { core::array::from_fn(|axis| end[axis] - a[axis]) };
    let (u, v) = (along(b), along(c));
    [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
}

/// Returns the vector normalised to length 1, or `None` for one without a length.
fn unit(vector: [f64; 3]) -> Option<[f64; 3]> {
    let length = vector.iter().map(|x| x * x).sum::<f64>().sqrt();
    (length > 0.0).then(|| vector.map(|x| x / length))
}
