//! A coarse copy of the bone for pages that render in software, where a picture takes as long as its surface
//! has triangles: cells of several voxels, each with their mean, so that thin cortex stays closed.

use std::collections::BTreeSet;

use voxel_grid::{GridError, VoxelGrid};

use super::field::Field;
use super::mesh::BlockMesh;
use super::nets::Blocks;

/// Maximum number of cells. The surface of a femur then has about 50 000 triangles.
const MAX_CELLS: usize = 500_000;
/// Factor by which the cells grow until they are few enough.
const GROWTH: f64 = 1.1;

/// The coarse copy.
#[derive(Debug, Clone)]
pub struct CoarseBone {
    /// Voxels per cell along each axis.
    strides: [usize; 3],
    threshold_hu: i16,
    /// The cells; the removed voxels are in their means.
    cells: Field,
    hu: Vec<i16>,
    blocks: Blocks,
    /// Cells whose voxels have changed; `None` before the first update, when all have.
    changed: Option<BTreeSet<u32>>,
}

impl CoarseBone {
    /// Creates the copy of a grid, with nothing meshed yet.
    ///
    /// # Errors
    /// The coarse grid is invalid: never for a valid one.
    pub fn new(grid: &VoxelGrid, threshold_hu: i16) -> Result<CoarseBone, GridError> {
        CoarseBone::with_cells(grid, threshold_hu, MAX_CELLS)
    }

    /// Creates a copy with at most `most` cells, or one.
    ///
    /// # Errors
    /// As [`CoarseBone::new`].
    pub fn with_cells(grid: &VoxelGrid, threshold_hu: i16, most: usize) -> Result<CoarseBone, GridError> {
        let (dims, spacing_m) = (grid.dims(), grid.spacing_m());
        let mut size_m = spacing_m.iter().copied().fold(f64::INFINITY, f64::min);
        let strides_at = |size_m: f64| spacing_m.map(|spacing| (size_m / spacing).round().max(1.0) as usize);
        let cells_at = |strides: [usize; 3]| core::array::from_fn(|axis| dims[axis].div_ceil(strides[axis]));
        while cells_at(strides_at(size_m)).iter().product::<usize>() > most.max(1) {
            size_m *= GROWTH;
        }
        let strides = strides_at(size_m);
        let origin_m = grid.world_m(strides.map(|stride| 0.5 * (stride as f64 - 1.0)));
        let cell_m = core::array::from_fn(|axis| spacing_m[axis] * strides[axis] as f64);
        let cells = VoxelGrid::new(cells_at(strides), cell_m, origin_m, grid.axes())?;
        let hu = vec![0; cells.voxel_count()];
        let blocks = Blocks::new(&cells);
        let cells = Field::new(cells, threshold_hu);
        Ok(CoarseBone { strides, threshold_hu, cells, hu, blocks, changed: None })
    }

    /// Number of cells.
    pub fn cell_count(&self) -> usize {
        self.hu.len()
    }

    /// Marks the cell of a voxel that was removed or restored.
    pub fn touch(&mut self, voxel: [usize; 3]) {
        let cell = core::array::from_fn(|axis| voxel[axis] / self.strides[axis]);
        if let (Some(changed), Some(index)) = (&mut self.changed, self.cells.grid().index(cell)) {
            changed.insert(index as u32);
        }
    }

    /// Takes the means of the cells that have changed, from the voxels and their Hounsfield units.
    pub fn update(&mut self, voxels: &Field, hu: &[i16]) {
        let grid = *self.cells.grid();
        match self.changed.replace(BTreeSet::new()) {
            None => {
                for index in 0..grid.voxel_count() {
                    self.hu[index] = grid.voxel(index).map_or(0, |cell| self.mean(cell, voxels, hu));
                }
            }
            Some(changed) => {
                for index in changed {
                    let Some(cell) = grid.voxel(index as usize) else { continue };
                    self.hu[index as usize] = self.mean(cell, voxels, hu);
                    self.blocks.touch(cell);
                }
            }
        }
    }

    /// Returns the mean of a cell's voxels. As in [`Field::row`], a drilled one is as far below the threshold
    /// as it was above.
    fn mean(&self, cell: [usize; 3], voxels: &Field, hu: &[i16]) -> i16 {
        let [ni, nj, nk] = voxels.grid().dims();
        let first: [usize; 3] = core::array::from_fn(|axis| cell[axis] * self.strides[axis]);
        let [si, sj, sk] = self.strides;
        let (threshold, mut sum, mut count) = (i64::from(self.threshold_hu), 0, 0);
        for k in first[2]..(first[2] + sk).min(nk) {
            for j in first[1]..(first[1] + sj).min(nj) {
                let row = (k * nj + j) * ni;
                for index in row + first[0]..row + (first[0] + si).min(ni) {
                    let above = i64::from(hu.get(index).map_or(0, |hu| *hu)) - threshold;
                    sum += if voxels.is_removed(index) { -above.abs() } else { above };
                    count += 1;
                }
            }
        }
        (threshold + sum / count.max(1)).clamp(i64::from(i16::MIN), i64::from(i16::MAX)) as i16
    }

    /// Meshes the changed blocks.
    pub fn mesh_changed(&mut self) -> Vec<BlockMesh> {
        self.blocks.mesh_changed(&self.cells, &self.hu, usize::MAX)
    }
}
