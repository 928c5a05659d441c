//! Meshing of the blocks.

use std::collections::BTreeSet;

use voxel_grid::VoxelGrid;

use super::field::Field;
use super::mesh::BlockMesh;

/// Voxels along a block's edge.
pub const BLOCK: i64 = 24;
/// Cells along a block's edge, including those shared with its lower neighbours.
const CELLS: usize = BLOCK as usize + 1;
/// Voxels along an edge that these cells touch.
const VOXELS: usize = CELLS + 1;

/// The blocks of a field, and which of them need meshing.
///
/// Voxels count from −1, the layer outside the grid, so that edges into the bone begin inside a block.
#[derive(Debug, Clone)]
pub struct Blocks {
    counts: [i64; 3],
    changed: BTreeSet<u32>,
    /// Blocks that currently have a surface.
    shown: BTreeSet<u32>,
    scale_m: f64,
}

impl Blocks {
    /// All blocks of a grid, all marked for meshing.
    pub fn new(grid: &VoxelGrid) -> Blocks {
        let counts = grid.dims().map(|n| (n as u64 + 1).div_ceil(BLOCK as u64) as i64);
        let total = counts.iter().product::<i64>() as u32;
        // The length of a step: a block with its neighbours' cells spans less than 65536 steps in any
        // direction.
        let largest = grid.spacing_m().iter().fold(0.0f64, |all, spacing| all.max(*spacing));
        let scale_m = largest * VOXELS as f64 * 3f64.sqrt() / 65000.0;
        Blocks { counts, changed: (0..total).collect(), shown: BTreeSet::new(), scale_m }
    }

    /// Number of blocks.
    pub fn count(&self) -> usize {
        self.counts.iter().product::<i64>() as usize
    }

    /// Number of blocks waiting to be meshed.
    pub fn changed_count(&self) -> usize {
        self.changed.len()
    }

    /// Marks the blocks whose cells touch this voxel for meshing.
    pub fn touch(&mut self, voxel: [usize; 3]) {
        // Voxel v touches cells v − 1 and v. A block meshes cells from one before its first voxel, and edges
        // from its own voxels.
        let range = |axis: usize| {
            let shifted = voxel[axis] as i64 + 1;
            let last = self.counts[axis] - 1;
            let first = (shifted - 1).div_euclid(BLOCK).clamp(0, last);
            first..=(shifted + 1).div_euclid(BLOCK).clamp(0, last)
        };
        for k in range(2) {
            for j in range(1) {
                for i in range(0) {
                    self.changed.insert(((k * self.counts[1] + j) * self.counts[0] + i) as u32);
                }
            }
        }
    }

    /// Meshes at most `most` of the waiting blocks. A block that has just become empty is returned without
    /// vertices.
    pub fn mesh_changed(&mut self, field: &Field, hu: &[i16], most: usize) -> Vec<BlockMesh> {
        let mut meshes = Vec::new();
        while meshes.len() < most
            && let Some(block) = self.changed.pop_first()
        {
            let mesh = self.mesh(field, hu, block);
            let is_empty = mesh.indices.is_empty();
            let was_shown = if is_empty { self.shown.remove(&block) } else { !self.shown.insert(block) };
            if !is_empty || was_shown {
                meshes.push(mesh);
            }
        }
        meshes
    }

    /// Meshes one block.
    pub fn mesh(&self, field: &Field, hu: &[i16], block: u32) -> BlockMesh {
        let block_i64 = i64::from(block);
        let [ci, cj, _] = self.counts;
        let at = [block_i64 % ci, block_i64 / ci % cj, block_i64 / (ci * cj)];
        // First voxel of the lowest cell: the block's first voxel is BLOCK · at − 1.
        let first = at.map(|at| at * BLOCK - 2);
        let mut samples = Samples { first, values: vec![0.0; VOXELS * VOXELS * VOXELS] };
        if !samples.fill(field, hu) {
            return BlockMesh::empty(block);
        }
        let mut builder = Builder {
            samples,
            field,
            scale_m: self.scale_m,
            vertices: vec![NONE; VOXELS * VOXELS * VOXELS],
            order: Vec::new(),
            normals: Vec::new(),
            indices: Vec::new(),
        };
        builder.faces();
        BlockMesh::new(block, self.scale_m, &builder.order, builder.normals, builder.indices)
    }
}

/// Field values at the voxels that a block's cells touch.
struct Samples {
    first: [i64; 3],
    values: Vec<f32>,
}

fn place(cell: [usize; 3]) -> usize {
    (cell[2] * VOXELS + cell[1]) * VOXELS + cell[0]
}

impl Samples {
    /// Samples the field; returns whether there are voxels on both sides of the surface.
    fn fill(&mut self, field: &Field, hu: &[i16]) -> bool {
        let [i, j, k] = self.first;
        for (number, row) in self.values.chunks_exact_mut(VOXELS).enumerate() {
            let (dj, dk) = (number % VOXELS, number / VOXELS);
            field.row(hu, [i, j + dj as i64, k + dk as i64], row);
        }
        let inside = self.values.iter().filter(|value| **value > 0.0).count();
        inside > 0 && inside < self.values.len()
    }

    fn is_inside(&self, cell: [usize; 3]) -> bool {
        self.values[place(cell)] > 0.0
    }
}

/// Marks a cell without a vertex.
const NONE: u32 = u32::MAX;

struct Builder<'a> {
    samples: Samples,
    field: &'a Field,
    scale_m: f64,
    /// Vertex number of each cell; [`NONE`] if it has none yet.
    vertices: Vec<u32>,
    /// Vertices in whole steps.
    order: Vec<[i64; 3]>,
    normals: Vec<[i8; 3]>,
    indices: Vec<u32>,
}

const CORNERS: [[usize; 3]; 8] =
    [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1]];
/// The two corners of each of a cell's edges.
const EDGES: [[usize; 2]; 12] =
    [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]];

impl Builder<'_> {
    /// Adds a quadrilateral for each edge that begins at a voxel of this block and crosses the surface.
    fn faces(&mut self) {
        for k in 1..VOXELS - 1 {
            for j in 1..VOXELS - 1 {
                for i in 1..VOXELS - 1 {
                    let from = [i, j, k];
                    let inside = self.samples.is_inside(from);
                    for axis in 0..3 {
                        let mut to = from;
                        to[axis] += 1;
                        if self.samples.is_inside(to) != inside {
                            self.face(from, axis, inside);
                        }
                    }
                }
            }
        }
    }

    fn face(&mut self, from: [usize; 3], axis: usize, inside: bool) {
        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
        let mut corner = |du: usize, dv: usize| {
            let mut cell = from;
            cell[u] -= du;
            cell[v] -= dv;
            self.vertex(cell)
        };
        // Counterclockwise around the edge, seen against its direction.
        let ring = [corner(1, 1), corner(0, 1), corner(0, 0), corner(1, 0)];
        // If the edge leads from inside to outside, the outward normal points along it.
        let [a, b, c, d] = if inside { ring } else { [ring[3], ring[2], ring[1], ring[0]] };
        self.indices.extend([a, b, c, a, c, d]);
    }

    fn vertex(&mut self, cell: [usize; 3]) -> u32 {
        let key = place(cell);
        if self.vertices[key] != NONE {
            return self.vertices[key];
        }
        let number = self.order.len() as u32;
        let (position, gradient) = self.crossing(cell);
        let grid = self.field.grid();
        let voxel = core::array::from_fn(|axis| {
            (self.samples.first[axis] + cell[axis] as i64) as f64 + position[axis]
        });
        let steps = grid.world_m(voxel).map(|metres| (metres / self.scale_m).round() as i64);
        self.order.push(steps);
        self.normals.push(normal(world_gradient(grid, gradient)));
        self.vertices[key] = number;
        number
    }

    /// Returns the mean of the points where the surface crosses a cell's edges, in voxels from its lowest
    /// corner, and the cell's mean gradient.
    fn crossing(&self, cell: [usize; 3]) -> ([f64; 3], [f64; 3]) {
        let values: [f64; 8] = core::array::from_fn(|corner| {
            let offset = CORNERS[corner];
            f64::from(self.samples.values[place(core::array::from_fn(|axis| cell[axis] + offset[axis]))])
        });
        let (mut sum, mut count) = ([0.0; 3], 0.0);
        for [a, b] in EDGES {
            if (values[a] > 0.0) == (values[b] > 0.0) {
                continue;
            }
            let t = values[a] / (values[a] - values[b]);
            for (axis, sum) in sum.iter_mut().enumerate() {
                let (from, to) = (CORNERS[a][axis] as f64, CORNERS[b][axis] as f64);
                *sum += from + t * (to - from);
            }
            count += 1.0;
        }
        let mut gradient = [0.0; 3];
        for (corner, value) in values.iter().enumerate() {
            for (axis, slope) in gradient.iter_mut().enumerate() {
                *slope += if CORNERS[corner][axis] == 1 { 0.25 * value } else { -0.25 * value };
            }
        }
        (sum.map(|sum| sum / f64::max(count, 1.0)), gradient)
    }
}

/// Converts a gradient per voxel to one per metre in the patient frame.
fn world_gradient(grid: &VoxelGrid, gradient: [f64; 3]) -> [f64; 3] {
    let (axes, spacing_m) = (grid.axes(), grid.spacing_m());
    core::array::from_fn(|row| (0..3).map(|axis| axes[axis][row] * gradient[axis] / spacing_m[axis]).sum())
}

/// Returns the outward unit normal in 127ths; values are higher inside the bone.
fn normal(gradient: [f64; 3]) -> [i8; 3] {
    let length = gradient.iter().map(|x| x * x).sum::<f64>().sqrt();
    if length == 0.0 { [0, 0, 127] } else { gradient.map(|x| (-127.0 * x / length).round() as i8) }
}
