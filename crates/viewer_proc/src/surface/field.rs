//! The voxels that the surface encloses: Hounsfield units minus the drilled voxels.

use voxel_grid::VoxelGrid;

/// Which voxels have been drilled away; the Hounsfield units are kept unchanged.
#[derive(Debug, Clone)]
pub struct Field {
    grid: VoxelGrid,
    threshold_hu: i16,
    removed: Vec<u64>,
    removed_count: u64,
}

/// Whether a voxel is still present.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Voxel {
    /// Present.
    Present,
    /// Drilled away.
    Removed,
}

impl Field {
    /// Creates a field with nothing drilled.
    pub fn new(grid: VoxelGrid, threshold_hu: i16) -> Field {
        Field { grid, threshold_hu, removed: vec![0; grid.voxel_count().div_ceil(64)], removed_count: 0 }
    }

    /// The grid.
    pub fn grid(&self) -> &VoxelGrid {
        &self.grid
    }

    /// Number of removed voxels.
    pub fn removed_count(&self) -> u64 {
        self.removed_count
    }

    /// Removes or restores a voxel. Returns whether that changed anything.
    pub fn set(&mut self, index: u32, voxel: Voxel) -> bool {
        if index as usize >= self.grid.voxel_count() {
            return false;
        }
        let (word, bit) = (index as usize / 64, 1u64 << (index % 64));
        let removed = voxel == Voxel::Removed;
        let was = self.removed[word] & bit != 0;
        if was == removed {
            return false;
        }
        self.removed[word] ^= bit;
        self.removed_count = if removed { self.removed_count + 1 } else { self.removed_count - 1 };
        true
    }

    /// Whether a voxel was drilled away; false outside the grid.
    pub fn is_removed(&self, index: usize) -> bool {
        self.removed.get(index / 64).is_some_and(|word| word >> (index % 64) & 1 != 0)
    }

    /// Linear indices of the removed voxels.
    pub fn removed(&self) -> Vec<u32> {
        let bits = |(word, bits): (usize, &u64)| {
            let bits = *bits;
            (0..64u32).filter(move |bit| bits >> bit & 1 != 0).map(move |bit| word as u32 * 64 + bit)
        };
        self.removed.iter().enumerate().filter(|(_, bits)| **bits != 0).flat_map(bits).collect()
    }

    /// Fills a row along i, starting at `first`, with the HU above the threshold; negative is outside.
    /// Outside the grid there is no bone, so the surface is closed. A drilled voxel is as far outside as it
    /// was inside, so the surface runs half-way between it and its neighbours.
    pub fn row(&self, hu: &[i16], first: [i64; 3], values: &mut [f32]) {
        values.fill(OUTSIDE);
        let [ni, nj, nk] = self.grid.dims();
        let [i, j, k] = first;
        let inside = |x: i64, n: usize| x >= 0 && (x as usize) < n;
        if !(inside(j, nj) && inside(k, nk)) {
            return;
        }
        let (from, to) = (i.clamp(0, ni as i64), (i + values.len() as i64).clamp(0, ni as i64));
        let row = (k as usize * nj + j as usize) * ni;
        let values = values.get_mut((from - i).max(0) as usize..).unwrap_or_default();
        let Some(hu) = hu.get(row + from as usize..row + to as usize) else { return };
        for ((value, hu), index) in values.iter_mut().zip(hu).zip(row + from as usize..) {
            let above = f32::from(*hu) - f32::from(self.threshold_hu);
            // A voxel at the threshold is bone, as in the physics.
            let above = if above == 0.0 { 0.5 } else { above };
            *value = if self.removed[index / 64] >> (index % 64) & 1 != 0 { -above.abs() } else { above };
        }
    }
}

const OUTSIDE: f32 = -1000.0;
