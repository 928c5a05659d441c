//! Bounding box of the stored voxels that attenuate. Many CTs are mostly air around a body: no image needs to
//! cover it, and a detector plane that cuts only air shortens no ray.

use rayon::prelude::*;

use crate::pieces::pieces_from;
use crate::vector::Vec3;

/// Voxels `low..end` along each axis; those outside attenuate nothing. Empty if nothing does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct OccupiedBox {
    low: [usize; 3],
    end: [usize; 3],
}

impl OccupiedBox {
    const NOTHING: Self = Self { low: [usize::MAX; 3], end: [0; 3] };

    /// Computes the box of the voxels, x fastest, for which `attenuates` is true; voxels below `least` never
    /// attenuate.
    pub fn of<T>(dims: [usize; 3], voxels: &[T], least: T, attenuates: impl Fn(T) -> bool + Sync) -> Self
    where
        T: Copy + Sync + PartialOrd,
    {
        let [nx, ny, _] = dims;
        let row = |(n, row): (usize, &[T])| {
            let first_of = |(start, voxels): (usize, &[T])| {
                voxels.iter().position(|voxel| attenuates(*voxel)).map(|x| start + x)
            };
            let last_of = |(start, voxels): (usize, &[T])| {
                voxels.iter().rposition(|voxel| attenuates(*voxel)).map(|x| start + x)
            };
            let Some(first) = pieces_from(row, least).find_map(first_of) else { return Self::NOTHING };
            let last = pieces_from(row, least).rev().find_map(last_of).unwrap_or(first);
            let (y, z) = (n % ny, n / ny);
            Self { low: [first, y, z], end: [last + 1, y + 1, z + 1] }
        };
        voxels.par_chunks(nx).enumerate().map(row).reduce(|| Self::NOTHING, |a, b| a.hull(&b))
    }

    /// The smallest box that contains both.
    fn hull(&self, other: &Self) -> Self {
        Self {
            low: core::array::from_fn(|axis| self.low[axis].min(other.low[axis])),
            end: core::array::from_fn(|axis| self.end[axis].max(other.end[axis])),
        }
    }

    /// Includes a voxel; returns true if it lay outside.
    pub fn include(&mut self, voxel: [usize; 3]) -> bool {
        let grown = self.hull(&Self { low: voxel, end: voxel.map(|x| x + 1) });
        core::mem::replace(self, grown) != grown
    }

    /// The box's voxels along an axis.
    pub fn along(&self, axis: usize) -> core::ops::Range<usize> {
        self.low[axis].min(self.end[axis])..self.end[axis]
    }

    /// Open interval along an axis within which samples read a voxel of the box.
    #[inline(always)]
    pub fn reach(&self, axis: usize) -> [f64; 2] {
        let along = self.along(axis);
        [along.start as f64 - 1.0, along.end as f64]
    }

    /// Corners of the region in which samples read a voxel of the box.
    pub fn corners(&self) -> [Vec3; 8] {
        core::array::from_fn(|corner| [0, 1, 2].map(|axis| self.reach(axis)[corner >> axis & 1]))
    }
}
