//! Closed triangle meshes: surfaces that bound a solid, which is what a ray can be long in.
//!
//! A mesh is closed if every edge is run through as often one way as the other, once equal corners are one:
//! then what enters it leaves it, whatever the ray. Shells that touch or overlap are allowed, and count each
//! for itself.

use std::collections::BTreeMap;

use thiserror::Error;

use crate::mesh::Triangle;

/// Shells of a mesh, at most: each is compared with each.
pub const MOST_SHELLS: usize = 10_000;

/// Why triangles bound no solid.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum MeshFault {
    /// A hole, or neighbours that are turned against each other.
    #[error(
        "is not closed: {edges} edges lack a neighbour that is turned alike, the first from {from:?} to {to:?} (in the file's unit)"
    )]
    Open {
        /// Edges without one.
        edges: usize,
        /// One end of the first.
        from: [f64; 3],
        /// The other end.
        to: [f64; 3],
    },
    /// All in a plane, or two shells that cancel.
    #[error("encloses no volume; expected the surface of a solid")]
    Flat,
    /// More than can be compared.
    #[error(
        "has {shells} separate shells, expected {MOST_SHELLS} at most: join the parts, or leave out the small ones"
    )]
    Shells {
        /// How many.
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
    /// Joins equal corners and checks that the triangles bound a solid. Triangles of no area are left out. A
    /// shell that lies within no other is turned outward if it is not; one within another is a cavity if it
    /// is turned against it.
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

    /// The corners, in the file's unit or as [`ClosedMesh::scaled`] made them.
    pub fn corners(&self) -> &[[f64; 3]] {
        &self.corners
    }

    /// The triangles, as numbers of corners.
    pub fn triangles(&self) -> &[[u32; 3]] {
        &self.triangles
    }

    /// The same mesh stretched along its axes; mirrored where a factor is below 0.
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

    /// Least and greatest coordinates.
    pub fn bounds(&self) -> [[f64; 3]; 2] {
        bounds(&self.corners)
    }

    /// Volume, in cubes of the unit; what two shells share counts twice.
    pub fn volume(&self) -> f64 {
        self.triangles.iter().map(|triangle| self.part_of_volume(triangle)).sum()
    }

    /// Volume between a triangle and the first corner, below 0 if it is seen from inside.
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
            // From the largest on, so what is around it has been decided.
            let around = shells[..turned.len()].iter().rposition(|other| other.is_around(shell));
            let is_turned = around.map_or(shell.volume < 0.0, |around| turned[around]);
            if is_turned {
                shell.triangles.iter().for_each(|index| turn(&mut self.triangles[*index]));
            }
            turned.push(is_turned);
        }
        if self.volume() > 0.0 { Ok(()) } else { Err(MeshFault::Flat) }
    }

    /// The parts that share no corner, from the one with the largest box to that with the smallest.
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

/// A part of a mesh that hangs together.
struct Shell {
    /// Below 0 if its triangles are seen from inside.
    volume: f64,
    bounds: [[f64; 3]; 2],
    triangles: Vec<usize>,
}

impl Shell {
    fn size(&self) -> f64 {
        (0..3).map(|axis| self.bounds[1][axis] - self.bounds[0][axis]).product()
    }

    /// Whether its box holds another one.
    fn is_around(&self, other: &Shell) -> bool {
        let [low, high] = &self.bounds;
        (0..3).all(|axis| low[axis] < other.bounds[0][axis] && other.bounds[1][axis] < high[axis])
    }
}

fn turn(triangle: &mut [u32; 3]) {
    triangle.swap(1, 2);
}

/// The corner that stands for all that hang together with it.
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

/// The different corners, and the triangles as their numbers, without those that have two corners in one
/// place.
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

/// Every edge is run through as often one way as the other.
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
