//! Hounsfield units between voxel centres.

use crate::VoxelGrid;

impl VoxelGrid {
    /// Voxel coordinates of a world position (LPS, metres); voxel centres are at integers. The inverse of
    /// [`VoxelGrid::world_m`].
    #[inline]
    pub fn voxel_at(&self, world_m: [f64; 3]) -> [f64; 3] {
        let (origin_m, axes, spacing_m) = (self.origin_m(), self.axes(), self.spacing_m());
        let off = [0, 1, 2].map(|row| world_m[row] - origin_m[row]);
        [0, 1, 2].map(|axis| {
            let direction = axes[axis];
            (off[0] * direction[0] + off[1] * direction[1] + off[2] * direction[2]) / spacing_m[axis]
        })
    }

    /// Linear index of the voxel that contains a point in voxel coordinates; `None` outside the grid.
    #[inline]
    pub fn index_of(&self, voxel: [f64; 3]) -> Option<usize> {
        let dims = self.dims();
        if !holds(dims, voxel) {
            return None;
        }
        // Adding half a voxel and rounding down gives the nearest centre; casting a positive number rounds
        // down.
        let [i, j, k] = [0, 1, 2].map(|axis| ((voxel[axis] + 0.5) as usize).min(dims[axis] - 1));
        Some(i + dims[0] * (j + dims[1] * k))
    }
}

/// Returns true if a point in voxel coordinates lies in the box of these voxels, up to their outer faces;
/// false for NaN.
#[inline]
pub fn holds(dims: [usize; 3], voxel: [f64; 3]) -> bool {
    (0..3).all(|axis| (-0.5..=dims[axis] as f64 - 0.5).contains(&voxel[axis]))
}

/// Hounsfield units at a point in voxel coordinates: trilinear between the eight surrounding voxel centres,
/// clamped to the nearest centre beyond the outermost ones. `None` outside the box of the voxels. `hu`: i
/// fastest.
#[inline]
pub fn hu_at(dims: [usize; 3], hu: &[i16], voxel: [f64; 3]) -> Option<f64> {
    if !holds(dims, voxel) {
        return None;
    }
    let strides = [1, dims[0], dims[0] * dims[1]];
    // For each axis, the memory offsets and weights of its two centres.
    let (mut offsets, mut shares) = ([[0; 2]; 3], [[0.0; 2]; 3]);
    for axis in 0..3 {
        let place = voxel[axis].clamp(0.0, (dims[axis] - 1) as f64);
        // Casting rounds a positive number down.
        let low = place as usize;
        let share = place - low as f64;
        offsets[axis] = [low * strides[axis], (low + usize::from(share > 0.0)) * strides[axis]];
        shares[axis] = [1.0 - share, share];
    }
    let mut sum = 0.0;
    for k in 0..2 {
        for j in 0..2 {
            for i in 0..2 {
                let weight = shares[0][i] * shares[1][j] * shares[2][k];
                sum += weight * f64::from(*hu.get(offsets[0][i] + offsets[1][j] + offsets[2][k])?);
            }
        }
    }
    Some(sum)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A field that is linear in position is sampled exactly, on a grid rotated by 36.87 degrees about z.
    #[test]
    fn a_linear_field_is_read_exactly_on_an_oblique_grid() {
        let axes = [[0.8, 0.6, 0.0], [-0.6, 0.8, 0.0], [0.0, 0.0, 1.0]];
        let grid = VoxelGrid::new([9, 8, 7], [1e-3, 2e-3, 0.5e-3], [0.01, -0.02, 0.03], axes).unwrap();
        let hu: Vec<i16> = (0..grid.voxel_count())
            .map(|index| {
                let [i, j, k] = grid.voxel(index).unwrap();
                (10 * i + 100 * j + 7 * k) as i16
            })
            .collect();
        for voxel in [[0.0; 3], [3.25, 2.5, 1.75], [8.0, 7.0, 6.0], [0.1, 6.9, 3.3]] {
            let world_m = grid.world_m(voxel);
            let back = grid.voxel_at(world_m);
            assert!(voxel.iter().zip(back).all(|(a, b)| (a - b).abs() < 1e-12), "{voxel:?} {back:?}");
            let found = hu_at(grid.dims(), &hu, back).unwrap();
            let expected = 10.0 * voxel[0] + 100.0 * voxel[1] + 7.0 * voxel[2];
            assert!((found - expected).abs() < 1e-9, "{voxel:?}: {found}, expected {expected}");
        }
        assert_eq!(grid.index_of([3.4, 2.6, 1.0]), Some(3 + 9 * (3 + 8)));
        for outside in [[-0.6, 0.0, 0.0], [0.0, 7.6, 0.0], [f64::NAN, 0.0, 0.0], [f64::INFINITY, 0.0, 0.0]] {
            assert_eq!(
                (grid.index_of(outside), hu_at(grid.dims(), &hu, outside)),
                (None, None),
                "{outside:?}"
            );
        }
    }
}
