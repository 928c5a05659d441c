//! A triangle mesh.

use markups::vector::{cross, dot, minus};

/// A triangle mesh with shared vertices; LPS, mm.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Mesh {
    /// Vertices.
    pub points_mm: Vec<[f64; 3]>,
    /// Vertex indices, counterclockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// Returns the vertices of a triangle.
    pub fn corners_mm(&self, triangle: [u32; 3]) -> [[f64; 3]; 3] {
        triangle.map(|corner| self.points_mm[corner as usize])
    }

    /// Returns the volume of a closed mesh: the sum of the tetrahedra between its triangles and its first
    /// vertex (the divergence theorem for the field x/3). Using the origin instead would suffer from
    /// cancellation, because a patient's tunnel is far from it.
    pub fn volume_mm3(&self) -> f64 {
        let Some(origin) = self.points_mm.first() else { return 0.0 };
        let six_times = |triangle: &[u32; 3]| {
            let [a, b, c] = self.corners_mm(*triangle).map(|point| minus(point, *origin));
            dot(a, cross(b, c))
        };
        self.triangles.iter().map(six_times).sum::<f64>() / 6.0
    }

    /// Appends another mesh.
    pub fn add(&mut self, other: &Mesh) {
        let first = self.points_mm.len() as u32;
        self.points_mm.extend(&other.points_mm);
        self.triangles.extend(other.triangles.iter().map(|triangle| triangle.map(|corner| corner + first)));
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use std::collections::HashMap;

    use super::*;

    /// Every edge occurs equally often in both directions.
    pub(crate) fn assert_closed(mesh: &Mesh) {
        let mut passed: HashMap<[u32; 2], i64> = HashMap::new();
        for [a, b, c] in &mesh.triangles {
            for [from, to] in [[a, b], [b, c], [c, a]] {
                *passed.entry([*from.min(to), *from.max(to)]).or_default() += if from < to { 1 } else { -1 };
            }
        }
        assert!(!passed.is_empty() && passed.values().all(|balance| *balance == 0));
    }

    /// A tetrahedron far from the origin: a sixth of the product of its legs.
    #[test]
    fn the_volume_of_a_tetrahedron_is_a_sixth_of_its_legs_wherever_it_lies() {
        let at = |x: f64, y: f64, z: f64| [1e4 + x, -2e4 + y, 3e4 + z];
        let points_mm = vec![at(0.0, 0.0, 0.0), at(2.0, 0.0, 0.0), at(0.0, 3.0, 0.0), at(0.0, 0.0, 4.0)];
        let triangles = vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]];
        let mesh = Mesh { points_mm, triangles };
        assert_closed(&mesh);
        assert!((mesh.volume_mm3() - 4.0).abs() < 1e-9, "{}", mesh.volume_mm3());
    }
}
