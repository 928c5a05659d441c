//! A link of the arm as a mesh for the page.

use std::collections::HashMap;

use super::mesh::BlockMesh;

/// Steps along the longest side of a mesh: one less than 16 bits allow.
const STEPS: f64 = 65_534.0;
/// Minimum length of a step, m, for a mesh without extent.
const LEAST_STEP_M: f64 = 1e-9;

/// Returns the mesh of the link that moves with frame `frame` of the arm, from triangles in that frame, m,
/// counterclockwise seen from outside. Every facet keeps its own normal, so the edges of a housing stay
/// sharp.
pub fn link_mesh(frame: u32, triangles_m: &[[[f64; 3]; 3]]) -> BlockMesh {
    let (mut least, mut most) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for corner in triangles_m.iter().flatten() {
        for axis in 0..3 {
            least[axis] = least[axis].min(corner[axis]);
            most[axis] = most[axis].max(corner[axis]);
        }
    }
    let longest_m = (0..3).map(|axis| most[axis] - least[axis]).fold(0.0, f64::max);
    let scale_m = (longest_m / STEPS).max(LEAST_STEP_M);
    let (mut vertices, mut normals, mut indices) = (Vec::new(), Vec::new(), Vec::new());
    let mut known: HashMap<([i64; 3], [i8; 3]), u32> = HashMap::new();
    for triangle in triangles_m {
        let Some(normal) = normal_of(triangle) else { continue };
        for corner in triangle {
            let steps = corner.map(|x| (x / scale_m).round() as i64);
            let index = *known.entry((steps, normal)).or_insert_with(|| {
                vertices.push(steps);
                normals.push(normal);
                vertices.len() as u32 - 1
            });
            indices.push(index);
        }
    }
    BlockMesh::new(frame, scale_m, &vertices, normals, indices)
}

/// Returns the outward normal in 127ths, or `None` if the triangle has no area.
fn normal_of([a, b, c]: &[[f64; 3]; 3]) -> Option<[i8; 3]> {
    let along = |end: &[f64; 3]| -> [f64; 3] { core::array::from_fn(|axis| end[axis] - a[axis]) };
    let (u, v) = (along(b), along(c));
    let cross = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
    let length = cross.iter().map(|x| x * x).sum::<f64>().sqrt();
    (length > 0.0).then(|| cross.map(|x| (127.0 * x / length).round() as i8))
}
