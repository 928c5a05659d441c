//! The signed distance from a closed triangle mesh.
//!
//! The nearest triangle is found in a hierarchy of bounding boxes. The sign is that of the angle-weighted
//! pseudonormal of the nearest face, edge or corner: Bærentzen and Aanæs 2005, "Signed distance computation
//! using the angle weighted pseudonormal", IEEE TVCG 11:243.

use std::collections::BTreeMap;

use nalgebra::Vector3;
use scene::closed_mesh::ClosedMesh;

/// Most triangles of a leaf of the hierarchy.
const LEAF: usize = 4;
/// Depth of the hierarchy's traversal: each level halves the triangles, of which there are less than 2^32.
const DEPTH: usize = 64;

/// A closed triangle mesh, m.
#[derive(Debug, Clone, PartialEq)]
pub struct Solid {
    faces: Vec<Face>,
    nodes: Vec<Node>,
}

#[derive(Debug, Clone, PartialEq)]
struct Face {
    corners_m: [Vector3<f64>; 3],
    /// Pseudonormals of the face, of its corners, and of the edges that begin at them.
    normals: [Vector3<f64>; 7],
}

/// A box around triangles; its children, or the triangles themselves, follow one another.
#[derive(Debug, Clone, PartialEq)]
struct Node {
    low_m: Vector3<f64>,
    high_m: Vector3<f64>,
    /// First triangle of a leaf, or first of two children.
    first: usize,
    /// Number of triangles of a leaf; 0 for other nodes.
    count: usize,
}

impl Node {
    fn squared_m2(&self, point_m: &Vector3<f64>) -> f64 {
        let beyond = (self.low_m - point_m).sup(&(point_m - self.high_m)).sup(&Vector3::zeros());
        beyond.norm_squared()
    }
}

impl Solid {
    /// Creates the solid that a mesh bounds; `place` gives the position, m, of a point of the mesh.
    pub fn new(mesh: &ClosedMesh, place: impl Fn([f64; 3]) -> Vector3<f64>) -> Solid {
        let corners_m: Vec<Vector3<f64>> = mesh.corners().iter().copied().map(place).collect();
        let mut faces = faces(&corners_m, mesh.triangles());
        let mut nodes = vec![Node { low_m: Vector3::zeros(), high_m: Vector3::zeros(), first: 0, count: 0 }];
        let mut open = vec![(0, 0..faces.len())];
        while let Some((node, range)) = open.pop() {
            let part = &mut faces[range.clone()];
            let low_m = bound(part, f64::INFINITY, Vector3::inf);
            let high_m = bound(part, f64::NEG_INFINITY, Vector3::sup);
            if part.len() <= LEAF {
                nodes[node] = Node { low_m, high_m, first: range.start, count: part.len() };
                continue;
            }
            let axis = (high_m - low_m).imax();
            let at = |face: &Face| face.corners_m.iter().map(|corner| corner[axis]).sum::<f64>();
            part.sort_by(|a, b| at(a).total_cmp(&at(b)));
            let (first, middle) = (nodes.len(), range.start + part.len() / 2);
            nodes[node] = Node { low_m, high_m, first, count: 0 };
            nodes.extend([nodes[node].clone(), nodes[node].clone()]);
            open.extend([(first, range.start..middle), (first + 1, middle..range.end)]);
        }
        Solid { faces, nodes }
    }

    /// Returns the distance of a point from the surface, m, negative inside.
    pub fn distance_m(&self, point_m: &Vector3<f64>) -> f64 {
        let (mut least_m2, mut sign) = (f64::INFINITY, 1.0);
        let mut stack = [(0, 0.0); DEPTH];
        let mut height = 1;
        while height > 0 {
            height -= 1;
            let (node, squared_m2) = stack[height];
            if squared_m2 >= least_m2 {
                continue;
            }
            let node = &self.nodes[node];
            if node.count == 0 {
                let [a, b] =
                    [node.first, node.first + 1].map(|child| (child, self.nodes[child].squared_m2(point_m)));
                let (near, far) = if a.1 <= b.1 { (a, b) } else { (b, a) };
                (stack[height], stack[height + 1]) = (far, near);
                height += 2;
                continue;
            }
            for face in &self.faces[node.first..node.first + node.count] {
                let (nearest_m, part) = face.nearest(point_m);
                let away = point_m - nearest_m;
                if away.norm_squared() < least_m2 {
                    least_m2 = away.norm_squared();
                    sign = if away.dot(&face.normals[part]) < 0.0 { -1.0 } else { 1.0 };
                }
            }
        }
        sign * libm::sqrt(least_m2)
    }
}

fn bound(
    faces: &[Face],
    start: f64,
    of: impl Fn(&Vector3<f64>, &Vector3<f64>) -> Vector3<f64>,
) -> Vector3<f64> {
    let corners = faces.iter().flat_map(|face| &face.corners_m);
    corners.fold(Vector3::repeat(start), |bound, corner| of(&bound, corner))
}

fn faces(corners_m: &[Vector3<f64>], triangles: &[[u32; 3]]) -> Vec<Face> {
    let normals: Vec<Vector3<f64>> = triangles
        .iter()
        .map(|triangle| {
            let [a, b, c] = triangle.map(|index| corners_m[index as usize]);
            (b - a).cross(&(c - a)).try_normalize(0.0).unwrap_or_default()
        })
        .collect();
    let mut at_corner = vec![Vector3::zeros(); corners_m.len()];
    let mut at_edge: BTreeMap<[u32; 2], Vector3<f64>> = BTreeMap::new();
    let edge = |[a, b]: [u32; 2]| [a.min(b), a.max(b)];
    let ends = |[a, b, c]: [u32; 3]| [[a, b], [b, c], [c, a]];
    for (triangle, normal) in triangles.iter().zip(&normals) {
        for (at, pair) in ends(*triangle).into_iter().enumerate() {
            let [own, next, last] = [at, at + 1, at + 2].map(|i| corners_m[triangle[i % 3] as usize]);
            at_corner[triangle[at] as usize] += normal * angle_rad(&(next - own), &(last - own));
            *at_edge.entry(edge(pair)).or_default() += normal;
        }
    }
    let face = |(triangle, normal): (&[u32; 3], &Vector3<f64>)| {
        let [a, b, c] = triangle.map(|index| at_corner[index as usize]);
        let [ab, bc, ca] = ends(*triangle).map(|pair| at_edge[&edge(pair)]);
        let corners_m = triangle.map(|index| corners_m[index as usize]);
        Face { corners_m, normals: [*normal, a, b, c, ab, bc, ca] }
    };
    triangles.iter().zip(&normals).map(face).collect()
}

fn angle_rad(a: &Vector3<f64>, b: &Vector3<f64>) -> f64 {
    libm::atan2(a.cross(b).norm(), a.dot(b))
}

impl Face {
    /// Returns the nearest point, and which pseudonormal belongs to it. Ericson 2005, "Real-Time Collision
    /// Detection", section 5.1.5.
    fn nearest(&self, p: &Vector3<f64>) -> (Vector3<f64>, usize) {
        let [a, b, c] = &self.corners_m;
        let (ab, ac, ap) = (b - a, c - a, p - a);
        let (d1, d2) = (ab.dot(&ap), ac.dot(&ap));
        if d1 <= 0.0 && d2 <= 0.0 {
            return (*a, 1);
        }
        let bp = p - b;
        let (d3, d4) = (ab.dot(&bp), ac.dot(&bp));
        if d3 >= 0.0 && d4 <= d3 {
            return (*b, 2);
        }
        let vc = d1 * d4 - d3 * d2;
        if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 {
            return (a + ab * (d1 / (d1 - d3)), 4);
        }
        let cp = p - c;
        let (d5, d6) = (ab.dot(&cp), ac.dot(&cp));
        if d6 >= 0.0 && d5 <= d6 {
            return (*c, 3);
        }
        let vb = d5 * d2 - d1 * d6;
        if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
            return (a + ac * (d2 / (d2 - d6)), 6);
        }
        let va = d3 * d6 - d5 * d4;
        if va <= 0.0 && d4 >= d3 && d5 >= d6 {
            return (b + (c - b) * ((d4 - d3) / ((d4 - d3) + (d5 - d6))), 5);
        }
        let sum = va + vb + vc;
        (a + ab * (vb / sum) + ac * (vc / sum), 0)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use scene::mesh::Triangle;

    use super::*;

    /// A box of 12 triangles from -half to +half.
    fn cuboid(half: [f32; 3]) -> ClosedMesh {
        let corner =
            |i: usize| [0, 1, 2].map(|axis| if i >> axis & 1 == 1 { half[axis] } else { -half[axis] });
        let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        let halves = |[a, b, c, d]: [usize; 4]| [[a, b, c], [a, c, d]];
        let triangles: Vec<Triangle> =
            quads.into_iter().flat_map(halves).map(|triangle| triangle.map(corner)).collect();
        ClosedMesh::new(&triangles).unwrap()
    }

    /// A ball of `rings` times twice as many quadrangles, each halved.
    fn ball(radius: f64, rings: usize) -> ClosedMesh {
        let point = |i: usize, j: usize| {
            let (polar, around) = (
                std::f64::consts::PI * i as f64 / rings as f64,
                std::f64::consts::PI * (j % (2 * rings)) as f64 / rings as f64,
            );
            [polar.sin() * around.cos(), polar.sin() * around.sin(), polar.cos()].map(|x| (radius * x) as f32)
        };
        let point = |i: usize, j: usize| match i {
            0 => [0.0, 0.0, radius as f32],
            _ if i == rings => [0.0, 0.0, -radius as f32],
            _ => point(i, j),
        };
        let mut triangles: Vec<Triangle> = Vec::new();
        for (i, j) in (0..rings).flat_map(|i| (0..2 * rings).map(move |j| (i, j))) {
            triangles.push([point(i, j), point(i + 1, j), point(i + 1, j + 1)]);
            triangles.push([point(i, j), point(i + 1, j + 1), point(i, j + 1)]);
        }
        ClosedMesh::new(&triangles).unwrap()
    }

    proptest! {
        /// The distance from a box is its closed form, to rounding, on all of its faces, edges and corners.
        #[test]
        fn the_distance_from_a_box_is_its_closed_form(at in [-5.0..5.0, -5.0..5.0, -5.0..5.0_f64]) {
            let half = Vector3::new(1.0, 2.0, 3.0);
            let solid = Solid::new(&cuboid([1.0, 2.0, 3.0]), Vector3::from);
            let point = Vector3::from(at);
            let beyond = point.abs() - half;
            let exact = beyond.map(|x| x.max(0.0)).norm() + beyond.max().min(0.0);
            prop_assert!((solid.distance_m(&point) - exact).abs() < 1e-12);
        }

        /// At the acute edges and the tip of a spike, the sign is that of the half spaces that bound it.
        #[test]
        fn the_sign_at_acute_edges_is_that_of_the_half_spaces(at in [-2.0..6.0, -1.5..1.5, -1.5..1.5_f64]) {
            let corners: [[f32; 3]; 4] = [[5.0, 0.0, 0.0], [0.0, 0.3, -0.2], [0.0, -0.3, -0.2], [0.0, 0.0, 0.4]];
            let faces = [[1, 2, 3], [0, 2, 1], [0, 3, 2], [0, 1, 3]];
            let triangles: Vec<Triangle> = faces.iter().map(|face| face.map(|i: usize| corners[i])).collect();
            let solid = Solid::new(&ClosedMesh::new(&triangles).unwrap(), Vector3::from);
            let point = Vector3::from(at);
            let beyond = |triangle: &Triangle| {
                let [a, b, c] = triangle.map(|corner| Vector3::from(corner.map(f64::from)));
                (b - a).cross(&(c - a)).normalize().dot(&(point - a))
            };
            let deepest = triangles.iter().map(beyond).fold(f64::NEG_INFINITY, f64::max);
            prop_assume!(deepest.abs() > 1e-9);
            prop_assert_eq!(solid.distance_m(&point) < 0.0, deepest < 0.0);
        }

        /// The distance from a ball of 5120 triangles is between those of the balls within and around them.
        #[test]
        fn the_distance_from_a_fine_ball_is_that_of_the_ball(at in [-3.0..3.0, -3.0..3.0, -3.0..3.0_f64]) {
            use std::sync::LazyLock;
            static BALL: LazyLock<Solid> = LazyLock::new(|| Solid::new(&ball(1.0, 36), Vector3::from));
            let point = Vector3::from(at);
            let within = (0.75 * std::f64::consts::PI / 36.0).cos();
            let found = BALL.distance_m(&point);
            prop_assert!(found > point.norm() - 1.0 - 1e-6 && found < point.norm() - within + 1e-6, "{found}");
        }
    }
}
