//! Fills a grid from a function of position, in parallel. Each voxel is computed independently, so the result
//! cannot depend on the number of threads.

use crate::error::VolumeError;
use crate::volume::grid_of;
use std::path::Path;
use std::sync::{Mutex, PoisonError};
use voxel_grid::{Volume, VoxelGrid};

/// Edge of the cubes in which a field may skip work, voxels.
pub const BLOCK: usize = 8;

/// A field of Hounsfield units over the world.
pub trait Field: Sync {
    /// What holds for all points within `radius_m` of `center_m`; computed once per block of voxels.
    type Region: Copy;
    /// Classifies a ball. Must not change any voxel's value, only the work to compute it.
    fn region(&self, center_m: [f64; 3], radius_m: f64) -> Self::Region;
    /// Hounsfield units at a point of a classified ball.
    fn hu(&self, region: Self::Region, point_m: [f64; 3]) -> f64;
}

/// A grid along the world axes; `name` is that of the phantom.
///
/// # Errors
/// A dimension, the spacing or the origin is out of range.
pub fn grid_along_axes(
    name: &str,
    dims: [usize; 3],
    spacing_m: [f64; 3],
    origin_m: [f64; 3],
) -> Result<VoxelGrid, VolumeError> {
    let axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    grid_of(Path::new(name), dims, spacing_m, origin_m, axes)
}

/// A thread's slabs: their numbers and voxels.
type Share<'v> = Vec<(usize, &'v mut [i16])>;

/// Samples `field` at the voxel centres of a grid along the world axes with `threads` threads (0: as many as
/// the machine offers).
pub fn fill<F: Field>(grid: VoxelGrid, field: &F, threads: usize) -> Volume {
    let mut hu = vec![0_i16; grid.voxel_count()];
    let slab_voxels = grid.dims()[0] * grid.dims()[1] * BLOCK;
    let threads = match threads {
        0 => std::thread::available_parallelism().map_or(1, usize::from),
        n => n,
    };
    let mut shares: Vec<Share> = (0..threads).map(|_| Vec::new()).collect();
    for (slab, voxels) in hu.chunks_mut(slab_voxels).enumerate() {
        shares[slab % threads].push((slab, voxels));
    }
    let shares: Vec<Mutex<Share>> = shares.into_iter().map(Mutex::new).collect();
    let fill_share = |share: &Mutex<Share>| {
        for (slab, voxels) in std::mem::take(&mut *share.lock().unwrap_or_else(PoisonError::into_inner)) {
            fill_slab(grid, field, slab, voxels);
        }
    };
    std::thread::scope(|scope| {
        for share in &shares[1..] {
            // What has no thread is filled below.
            let _ = std::thread::Builder::new().spawn_scoped(scope, || fill_share(share));
        }
        shares.iter().for_each(fill_share);
    });
    Volume { grid, hu }
}

/// Fills the slices from `slab * BLOCK` on that `voxels` holds.
fn fill_slab<F: Field>(grid: VoxelGrid, field: &F, slab: usize, voxels: &mut [i16]) {
    let [ni, nj, _] = grid.dims();
    let (origin_m, spacing_m) = (grid.origin_m(), grid.spacing_m());
    let first_k = slab * BLOCK;
    let slices = voxels.len() / (ni * nj);
    let at = |axis: usize, index: f64| origin_m[axis] + index * spacing_m[axis];
    let middle = (BLOCK as f64 - 1.0) / 2.0;
    // Half the diagonal between the outermost voxel centres of a block.
    let radius_m = crate::volume::norm(spacing_m) * middle;
    for j0 in (0..nj).step_by(BLOCK) {
        for i0 in (0..ni).step_by(BLOCK) {
            let center =
                [at(0, i0 as f64 + middle), at(1, j0 as f64 + middle), at(2, first_k as f64 + middle)];
            let region = field.region(center, radius_m);
            for k in 0..slices {
                let z = at(2, (first_k + k) as f64);
                for j in j0..(j0 + BLOCK).min(nj) {
                    let y = at(1, j as f64);
                    for i in i0..(i0 + BLOCK).min(ni) {
                        let value = field.hu(region, [at(0, i as f64), y, z]);
                        voxels[i + ni * (j + nj * k)] = to_hu(value);
                    }
                }
            }
        }
    }
}

/// Checks the edge of the voxels of an anatomical phantom, and the point that it is built around; `point` is
/// that field's name.
///
/// # Errors
/// [`VolumeError::Argument`]: one is out of range.
pub fn check_placement(spacing_m: f64, point: &'static str, point_m: [f64; 3]) -> Result<(), VolumeError> {
    let refuse = |field: &'static str, given: String, expected: &str| {
        Err(VolumeError::argument(field, given, expected))
    };
    if !(0.249e-3..=2.001e-3).contains(&spacing_m) {
        return refuse("spacing_m", format!("{spacing_m} m"), "0.25e-3 to 2e-3 m");
    }
    if !point_m.iter().all(|c| c.abs() <= 10.0) {
        return refuse(point, format!("{point_m:?} m"), "within 10 m of the world origin");
    }
    Ok(())
}

/// The nearest whole number, halves upward, clamped to `i16`.
pub fn to_hu(value: f64) -> i16 {
    // Shifted to be positive, so that the cast rounds down.
    ((value.clamp(-32768.0, 32767.0) + 32768.5) as i64 - 32768) as i16
}

/// Asserts that every `stride`-th voxel equals the field evaluated without skipping, that is, in this region.
#[cfg(test)]
pub fn assert_filled_by<F: Field>(volume: &Volume, field: &F, everywhere: F::Region, stride: usize) {
    for (index, &hu) in volume.hu.iter().enumerate().step_by(stride) {
        let voxel = volume.grid.voxel(index).unwrap();
        let p = volume.grid.world_m(voxel.map(|n| n as f64));
        assert_eq!(to_hu(field.hu(everywhere, p)), hu, "voxel {voxel:?}");
    }
}
