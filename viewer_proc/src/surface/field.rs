//! The voxels that the surface encloses: Hounsfield units minus the drilled voxels.

/// The grid of a volume in the patient frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Geometry {
    /// Centre of voxel (0, 0, 0), m.
    pub origin_m: [f64; 3],
    /// Distance between voxel centres, m.
    pub spacing_m: [f64; 3],
    /// Unit axes of i, j, k, one after the other.
    pub direction: [f64; 9],
    /// Number of voxels along i, j, k.
    pub dimensions: [usize; 3],
}

impl Geometry {
    /// Converts a point from voxels to the patient frame (m).
    pub fn world_m(&self, voxel: [f64; 3]) -> [f64; 3] {
        core::array::from_fn(|row| {
            let part = |axis: usize| self.direction[3 * axis + row] * self.spacing_m[axis] * voxel[axis];
            self.origin_m[row] + part(0) + part(1) + part(2)
        })
    }

    /// Converts a gradient from per voxel to the patient frame (per m).
    pub fn world_gradient(&self, gradient: [f64; 3]) -> [f64; 3] {
        core::array::from_fn(|row| {
            (0..3).map(|axis| self.direction[3 * axis + row] * gradient[axis] / self.spacing_m[axis]).sum()
        })
    }

    /// Number of voxels.
    pub fn voxel_count(&self) -> usize {
        self.dimensions.iter().product()
    }

    /// i, j, k of a linear index; `None` outside the grid.
    pub fn voxel(&self, index: u32) -> Option<[usize; 3]> {
        let [ni, nj, _] = self.dimensions;
        let index = index as usize;
        (index < self.voxel_count()).then(|| [index % ni, index / ni % nj, index / (ni * nj)])
    }
}

/// Which voxels have been drilled away; the Hounsfield units stay where they are.
#[derive(Debug, Clone)]
pub struct Field {
    geometry: Geometry,
    threshold_hu: i16,
    removed: Vec<u64>,
    removed_count: u64,
}

/// Whether a voxel is still there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Voxel {
    /// It is.
    Present,
    /// It was drilled away.
    Removed,
}

impl Field {
    /// A field with nothing drilled.
    pub fn new(geometry: Geometry, threshold_hu: i16) -> Field {
        Field {
            geometry,
            threshold_hu,
            removed: vec![0; geometry.voxel_count().div_ceil(64)],
            removed_count: 0,
        }
    }

    /// The grid.
    pub fn geometry(&self) -> &Geometry {
        &self.geometry
    }

    /// Number of removed voxels.
    pub fn removed_count(&self) -> u64 {
        self.removed_count
    }

    /// Removes or restores a voxel. Returns whether that changed anything.
    pub fn set(&mut self, index: u32, voxel: Voxel) -> bool {
        if index as usize >= self.geometry.voxel_count() {
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

    /// Linear indices of the removed voxels.
    pub fn removed(&self) -> Vec<u32> {
        let bits = |(word, bits): (usize, &u64)| {
            let bits = *bits;
            (0..64u32).filter(move |bit| bits >> bit & 1 != 0).map(move |bit| word as u32 * 64 + bit)
        };
        self.removed.iter().enumerate().filter(|(_, bits)| **bits != 0).flat_map(bits).collect()
    }

    /// HU above the threshold at the voxels of a row along i, starting at `first`; negative is outside. Outside the grid there is no bone,
    /// so the surface is closed. A drilled voxel is as far outside as it was inside, so the surface runs half-way between it and its
    /// neighbours.
    pub fn row(&self, hu: &[i16], first: [i64; 3], values: &mut [f32]) {
        values.fill(OUTSIDE);
        let [ni, nj, nk] = self.geometry.dimensions;
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
