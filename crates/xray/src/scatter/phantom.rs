//! The scattering volume: a coarse grid of mixtures of water and cortical bone.

use rayon::prelude::*;

use crate::error::DrrError;
use crate::grid::{Grid, VolumeView};
use crate::ray::{IndexRay, WorldRay};
use crate::removal::RemovedVoxels;
use crate::siddon;

/// Largest side of a cell. Scatter varies over centimetres.
const CELL_M: f64 = 4e-3;

/// Water and cortical bone in every cell.
#[derive(Debug, Clone)]
pub struct Phantom {
    grid: Grid,
    fractions: Vec<[f32; 2]>,
    largest: [f64; 2],
}

impl Phantom {
    /// Creates a phantom from the density of water and of bone in every cell, relative to water of 1.0 g/cm3
    /// and to cortical bone of 1.92 g/cm3, x fastest.
    ///
    /// # Errors
    /// The number of cells differs from the grid's.
    pub fn new(grid: Grid, fractions: Vec<[f32; 2]>) -> Result<Self, DrrError> {
        let (given, expected) = (fractions.len(), grid.voxels());
        if given != expected {
            return Err(DrrError::Length { field: "fractions", given, expected });
        }
        let largest = fractions.iter().fold([0.0_f32; 2], |l, f| [l[0].max(f[0]), l[1].max(f[1])]);
        Ok(Self { grid, fractions, largest: largest.map(f64::from) })
    }

    /// Averages a CT over cells of at most 4 mm. `of` converts Hounsfield units to densities as in
    /// [`Phantom::new`]; removed voxels have `fill_hu`.
    ///
    /// # Errors
    /// The coarse grid is refused.
    pub fn of_volume(
        view: &VolumeView<'_>,
        removed: &RemovedVoxels,
        fill_hu: i16,
        of: impl Fn(i16) -> [f32; 2],
    ) -> Result<Self, DrrError> {
        let (fine, spacing) = (view.grid(), view.grid().spacing_m());
        let side = spacing.map(|s| ((CELL_M / s) as usize).max(1));
        let each = |f: fn(usize, usize) -> usize| [0, 1, 2].map(|a| f(fine.dims()[a], side[a]));
        let dims = each(usize::div_ceil);
        let axes = [0, 1, 2].map(|a| fine.axis_steps_m()[a].map(|x| x / spacing[a]));
        let middle = side.map(|n| (n as f64 - 1.0) / 2.0);
        let coarse = [0, 1, 2].map(|a| spacing[a] * side[a] as f64);
        let grid = Grid::new(dims, coarse, fine.index_to_world(middle), axes)?;
        let table: Vec<[f32; 2]> = (i16::MIN..=i16::MAX).map(of).collect();
        let density = |hu: i16| table[usize::from(hu as u16 ^ 0x8000)];
        let [nx, ny, nz] = fine.dims();
        let per_cell = (side[0] * side[1] * side[2]) as f32;
        let mut fractions = vec![[0.0_f32; 2]; grid.voxels()];
        fractions.par_chunks_mut(dims[0] * dims[1]).enumerate().for_each(|(k, layer)| {
            for z in k * side[2]..nz.min((k + 1) * side[2]) {
                for y in 0..ny {
                    let first = nx * (y + ny * z);
                    let row = &view.hu()[first..first + nx];
                    let cells = &mut layer[y / side[1] * dims[0]..][..dims[0]];
                    for (voxels, (cell, i)) in row.chunks(side[0]).zip(cells.iter_mut().zip(0..)) {
                        for (&hu, linear) in voxels.iter().zip(first + i * side[0]..) {
                            let [water, bone] = density(if removed.contains(linear) { fill_hu } else { hu });
                            cell[0] += water;
                            cell[1] += bone;
                        }
                    }
                }
            }
            layer.iter_mut().for_each(|cell| *cell = cell.map(|x| x / per_cell));
        });
        Self::new(grid, fractions)
    }

    /// The grid of the cells.
    pub(super) fn grid(&self) -> &Grid {
        &self.grid
    }

    /// The largest density of each material in any cell.
    pub(super) fn largest(&self) -> [f64; 2] {
        self.largest
    }

    /// Densities at a position in index coordinates; none outside.
    #[inline]
    pub(super) fn at(&self, index: [f64; 3]) -> [f64; 2] {
        // Negative coordinates beyond half a cell become index 0 only within rounding of the outer face.
        let cell = index.map(|x| libm::floor(x + 0.5).max(0.0) as usize);
        let linear = self.grid.linear_of(cell);
        linear.and_then(|i| self.fractions.get(i)).map_or([0.0; 2], |f| f.map(f64::from))
    }

    /// Metres of water and of cortical bone between two points.
    pub(super) fn lengths_m(&self, from_m: [f64; 3], to_m: [f64; 3]) -> [f64; 2] {
        let ray = IndexRay::new(&self.grid, &WorldRay::between(from_m, to_m));
        let mut sums = [0.0; 2];
        siddon::walk(&self.grid, &ray, (0.0, 1.0), |linear, from, to| {
            if let Some(fractions) = self.fractions.get(linear) {
                sums[0] += f64::from(fractions[0]) * (to - from);
                sums[1] += f64::from(fractions[1]) * (to - from);
            }
        });
        sums.map(|sum| sum * ray.length_m)
    }
}
