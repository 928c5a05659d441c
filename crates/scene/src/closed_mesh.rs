//! Closed triangle meshes: surfaces that bound a solid, so that a ray has a length inside it.
//!
//! A mesh is closed if, with equal corners merged, every edge is traversed equally often in both directions:
//! then every ray that enters also leaves. Shells may touch or overlap; each counts separately.

use std::collections::BTreeMap;

use thiserror::Error;

use crate::mesh::Triangle;

/// Largest number of shells of a mesh: each is compared with every other.
pub const MOST_SHELLS: usize = 10_000;

/// Why triangles do not bound a solid.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum MeshFault {
    /// There is a hole, or neighbours are oriented oppositely.
    #[error(
        "is not closed: {edges} edges lack a consistently oriented neighbour, the first from {from:?} to \
         {to:?} (in the file's unit)"
    )]
    Open {
        /// Unmatched edges.
        edges: usize,
        /// One end of the first one.
        from: [f64; 3],
        /// Its other end.
        to: [f64; 3],
    },
    /// All triangles lie in a plane, or two shells cancel.
    #[error("encloses no volume; expected the surface of a solid")]
    Flat,
    /// More shells than can be compared.
    #[error(
        "has {shells} separate shells, expected at most {MOST_SHELLS}: merge the parts, or remove the small \
         ones"
    )]
    Shells {
        /// Number of shells.
        shells: usize,
    },
}

/// Triangles that bound a solid, counterclockwise seen from outside.
#[derive(Debug, Clone, PartialEq)]
pub struct ClosedMesh {
    corners: Vec<[f64; 3]>,
    triangles: Vec<[u32; 3]>,
}

impl ClosedMesh {
    /// Merges equal corners and checks that the triangles bound a solid. Triangles without area are dropped.
    /// A shell inside no other is flipped to face outward if needed; one inside another and oriented
    /// oppositely is a cavity.
    ///
    /// # Errors
    /// [`MeshFault`].
    pub fn new(triangles: &[Triangle]) -> Result<Self, MeshFault> {
        let (corners, triangles) = joined(triangles);
        check_edges(&corners, &triangles)?;
        let mut mesh = ClosedMesh { corners, triangles };
        mesh.turn_outward()?;
        Ok(mesh)
    }

    /// The corners, in the file's unit or as scaled by [`ClosedMesh::scaled`].
    pub fn corners(&self) -> &[[f64; 3]] {
        &self.corners
    }

    /// The triangles, as indices into the corners.
    pub fn triangles(&self) -> &[[u32; 3]] {
        &self.triangles
    }

    /// Scales the mesh along its axes; a negative factor mirrors it.
    #[must_use]
    pub fn scaled(mut self, factors: [f64; 3]) -> Self {
        for corner in &mut self.corners {
            *corner = [0, 1, 2].map(|axis| corner[axis] * factors[axis]);
        }
        if factors.iter().product::<f64>() < 0.0 {
            self.triangles.iter_mut().for_each(turn);
        }
        self
    }

    /// Smallest and largest coordinates.
    pub fn bounds(&self) -> [[f64; 3]; 2] {
        bounds(&self.corners)
    }

    /// Volume in cubic units; overlaps of shells count twice.
    pub fn volume(&self) -> f64 {
        self.triangles.iter().map(|triangle| self.part_of_volume(triangle)).sum()
    }

    /// Signed volume between a triangle and the first corner, negative if seen from inside.
    fn part_of_volume(&self, triangle: &[u32; 3]) -> f64 {
        let first = self.corners[0];
        let [a, b, c] = triangle.map(|corner| {
            let corner = self.corners[corner as usize];
            [0, 1, 2].map(|axis| corner[axis] - first[axis])
        });
        let across = [b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]];
        (a[0] * across[0] + a[1] * across[1] + a[2] * across[2]) / 6.0
    }

    fn turn_outward(&mut self) -> Result<(), MeshFault> {
        let shells = self.shells()?;
        let mut turned: Vec<bool> = Vec::with_capacity(shells.len());
        for shell in &shells {
            // In order from the largest, so that the enclosing shells are already decided.
            let around = shells[..turned.len()].iter().rposition(|other| other.is_around(shell));
            let is_turned = around.map_or(shell.volume < 0.0, |around| turned[around]);
            if is_turned {
                shell.triangles.iter().for_each(|index| turn(&mut self.triangles[*index]));
            }
            turned.push(is_turned);
        }
        if self.volume() > 0.0 { Ok(()) } else { Err(MeshFault::Flat) }
    }

    /// The parts that share no corner, sorted by bounding box from the largest.
    fn shells(&self) -> Result<Vec<Shell>, MeshFault> {
        let mut leads: Vec<u32> = (0..self.corners.len() as u32).collect();
        for [a, b, c] in &self.triangles {
            let first = lead(&mut leads, *a);
            for other in [*b, *c] {
                let other = lead(&mut leads, other);
                leads[other as usize] = first;
            }
        }
        let mut of_lead: BTreeMap<u32, Vec<usize>> = BTreeMap::new();
        for (index, [corner, ..]) in self.triangles.iter().enumerate() {
            of_lead.entry(lead(&mut leads, *corner)).or_default().push(index);
        }
        if of_lead.len() > MOST_SHELLS {
            return Err(MeshFault::Shells { shells: of_lead.len() });
        }
        let mut shells: Vec<Shell> = of_lead.into_values().map(|triangles| self.shell(triangles)).collect();
        shells.sort_by(|a, b| b.size().total_cmp(&a.size()));
        Ok(shells)
    }

    fn shell(&self, triangles: Vec<usize>) -> Shell {
        let corners = triangles.iter().flat_map(|index| self.triangles[*index]);
        let corners: Vec<[f64; 3]> = corners.map(|corner| self.corners[corner as usize]).collect();
        let volume = triangles.iter().map(|index| self.part_of_volume(&self.triangles[*index])).sum();
        Shell { volume, bounds: bounds(&corners), triangles }
    }
}

/// A connected part of a mesh.
struct Shell {
    /// Signed volume, negative if the triangles face inward.
    volume: f64,
    bounds: [[f64; 3]; 2],
    triangles: Vec<usize>,
}

impl Shell {
    fn size(&self) -> f64 {
        (0..3).map(|axis| self.bounds[1][axis] - self.bounds[0][axis]).product()
    }

    /// Whether its bounding box contains the other's.
    fn is_around(&self, other: &Shell) -> bool {
        let [low, high] = &self.bounds;
        (0..3).all(|axis| low[axis] < other.bounds[0][axis] && other.bounds[1][axis] < high[axis])
    }
}

fn turn(triangle: &mut [u32; 3]) {
    triangle.swap(1, 2);
}

/// Representative corner of a connected set (union-find with path halving).
fn lead(leads: &mut [u32], mut corner: u32) -> u32 {
    while leads[corner as usize] != corner {
        let above = leads[leads[corner as usize] as usize];
        leads[corner as usize] = above;
        corner = above;
    }
    corner
}

fn bounds(corners: &[[f64; 3]]) -> [[f64; 3]; 2] {
    let end = |start: f64, of: fn(f64, f64) -> f64| {
        [0, 1, 2].map(|axis| corners.iter().map(|corner| corner[axis]).fold(start, of))
    };
    [end(f64::INFINITY, f64::min), end(f64::NEG_INFINITY, f64::max)]
}

/// The distinct corners, and the triangles as indices into them, without those with two equal corners.
fn joined(triangles: &[Triangle]) -> (Vec<[f64; 3]>, Vec<[u32; 3]>) {
    // -0 is 0.
    let places: Vec<[f64; 3]> =
        triangles.iter().flatten().map(|corner| corner.map(|x| f64::from(x) + 0.0)).collect();
    let compare = |a: &[f64; 3], b: &[f64; 3]| {
        a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])).then(a[2].total_cmp(&b[2]))
    };
    let mut order: Vec<usize> = (0..places.len()).collect();
    order.sort_unstable_by(|a, b| compare(&places[*a], &places[*b]).then(a.cmp(b)));
    let mut corners: Vec<[f64; 3]> = Vec::new();
    let mut numbers = vec![0_u32; places.len()];
    for index in order {
        if corners.last() != Some(&places[index]) {
            corners.push(places[index]);
        }
        numbers[index] = corners.len() as u32 - 1;
    }
    let triangles = numbers.chunks_exact(3).map(|n| [n[0], n[1], n[2]]);
    (corners, triangles.filter(|[a, b, c]| a != b && b != c && c != a).collect())
}

/// Checks that every edge is traversed equally often in both directions.
fn check_edges(corners: &[[f64; 3]], triangles: &[[u32; 3]]) -> Result<(), MeshFault> {
    let edges_of = |[a, b, c]: &[u32; 3]| [(*a, *b), (*b, *c), (*c, *a)];
    let upward = |(a, b): (u32, u32)| if a < b { (a, b, 1_i64) } else { (b, a, -1) };
    let mut edges: Vec<(u32, u32, i64)> = triangles.iter().flat_map(edges_of).map(upward).collect();
    edges.sort_unstable();
    let unmatched = |edge: &&[(u32, u32, i64)]| edge.iter().map(|(.., way)| way).sum::<i64>() != 0;
    let mut open = edges.chunk_by(|a, b| (a.0, a.1) == (b.0, b.1)).filter(unmatched);
    match open.next() {
        None => Ok(()),
        Some(first) => {
            let (from, to) = (corners[first[0].0 as usize], corners[first[0].1 as usize]);
            Err(MeshFault::Open { edges: 1 + open.count(), from, to })
        }
    }
}
