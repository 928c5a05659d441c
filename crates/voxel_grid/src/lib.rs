//! The voxel grid of a CT in the world (patient frame, LPS, metres): dimensions, spacing, origin and axes.
//!
//! A [`VoxelGrid`] is checked on creation and immutable, so a grid accepted by one reader is accepted by all:
//! files (`volume_io`), the message in shared memory (`messages`), the physics (`simulation`) and the X-ray
//! (`xray`) all use it. A [`Volume`] is a grid with its voxels, a [`Ct`] a volume with its hash.
//!
//! The axes are perpendicular to within rounding. Files store them with few digits (DICOM six, NIfTI as f32),
//! so axes within [`PERPENDICULAR_TOLERANCE`] are orthogonalised by Gram-Schmidt, which keeps the first axis
//! and adjusts the others. This matches DICOM, where the row direction is stored and the slice direction is
//! the normal of the image. ITK applies the same tolerance and correction to NIfTI files. Axes further off
//! are sheared and refused: only resampling could put the voxels where the file says.
//!
//! [`sample`] reads Hounsfield units between voxel centres, [`mod@slice`] is a plane through them as pixels,
//! [`density`] converts them to bone density, [`distance`] is the distance transform.
//!
//! ```
//! use voxel_grid::{GridError, VoxelGrid};
//!
//! let tilted = |cosine: f64| [[1.0, 0.0, 0.0], [cosine, 1.0, 0.0], [0.0, 0.0, 1.0]];
//! let grid = VoxelGrid::new([4, 5, 6], [1e-3; 3], [0.0; 3], tilted(5e-5))?;
//! assert_eq!(grid.axes()[1], [0.0, 1.0, 0.0]);
//! assert!(matches!(
//!     VoxelGrid::new([4, 5, 6], [1e-3; 3], [0.0; 3], tilted(5e-4)),
//!     Err(GridError::Sheared { .. })
//! ));
//! # Ok::<(), GridError>(())
//! ```

pub mod density;
pub mod distance;
pub mod sample;
pub mod slice;
mod volume;

pub use volume::{Ct, Volume};

/// Most voxels of a volume (2^29, 1 GiB of `i16`), to limit what a hostile header can claim.
pub const MAX_VOXELS: usize = 1 << 29;
/// Most voxels along one axis: keeps the projectors' 32.32 fixed-point arithmetic far from overflow.
pub const MAX_VOXELS_ALONG_AXIS: usize = 1 << 16;
/// Smallest distance between neighbouring voxels.
pub const MIN_SPACING_M: f64 = 1e-6;
/// Largest distance between neighbouring voxels.
pub const MAX_SPACING_M: f64 = 0.1;
/// Largest coordinate of the first voxel, far beyond any real patient's position.
pub const MAX_ORIGIN_M: f64 = 100.0;
/// Largest deviation from orthonormal axes that counts as rounding, in their dot products: for two axes, the
/// cosine of their angle (0.006 degrees, which moves a slice 500 mm away by 0.05 mm).
pub const PERPENDICULAR_TOLERANCE: f64 = 1e-4;
/// Axes of a grid along the world axes: i to the patient's left, j to posterior, k to superior.
const WORLD_AXES: [[f64; 3]; 3] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
/// Axes this close to perpendicular are kept bit for bit.
const EXACT: f64 = 1e-12;

/// Why a grid is invalid.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum GridError {
    /// No voxels, or too many.
    #[error(
        "{dims:?} voxels; expected 1 to {MAX_VOXELS_ALONG_AXIS} along each axis and at most {MAX_VOXELS} in \
         total: crop or resample the volume"
    )]
    Dimensions {
        /// Voxels along i, j, k.
        dims: [usize; 3],
    },
    /// An implausible voxel spacing.
    #[error(
        "a voxel spacing of {spacing_m:?} m; expected {MIN_SPACING_M:e} to {MAX_SPACING_M} m along each axis"
    )]
    Spacing {
        /// Spacing along i, j, k.
        spacing_m: [f64; 3],
    },
    /// An implausibly distant origin.
    #[error("an origin of {origin_m:?} m; expected -{MAX_ORIGIN_M} to {MAX_ORIGIN_M} m in each coordinate")]
    Origin {
        /// Centre of voxel (0, 0, 0).
        origin_m: [f64; 3],
    },
    /// Axes that are not perpendicular unit vectors.
    #[error(
        "non-orthonormal axes (deviation {deviation:.1e}, limit {PERPENDICULAR_TOLERANCE:e}): resample a \
         sheared volume to a rectangular grid first"
    )]
    Sheared {
        /// Largest deviation of a dot product of two axes; infinite if one is NaN.
        deviation: f64,
    },
}

/// A uniform grid: voxel (i, j, k) has its centre at `origin_m + i s_0 a_0 + j s_1 a_1 + k s_2 a_2`; i runs
/// fastest in memory.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VoxelGrid {
    dims: [usize; 3],
    placement: Placement,
}

impl VoxelGrid {
    /// Creates a validated grid; `axes[a]` is the direction of index axis a in the world. Left-handed grids
    /// are allowed: voxels are never reordered.
    ///
    /// # Errors
    /// Any [`GridError`].
    pub fn new(
        dims: [usize; 3],
        spacing_m: [f64; 3],
        origin_m: [f64; 3],
        axes: [[f64; 3]; 3],
    ) -> Result<VoxelGrid, GridError> {
        VoxelGrid::placed(dims, Placement::new(spacing_m, origin_m, axes)?)
    }

    /// Creates a validated grid along the world axes.
    ///
    /// # Errors
    /// As [`VoxelGrid::new`].
    pub fn axis_aligned(
        dims: [usize; 3],
        spacing_m: [f64; 3],
        origin_m: [f64; 3],
    ) -> Result<VoxelGrid, GridError> {
        VoxelGrid::new(dims, spacing_m, origin_m, WORLD_AXES)
    }

    /// Creates a grid of these dimensions at a placement.
    ///
    /// # Errors
    /// [`GridError::Dimensions`].
    pub fn placed(dims: [usize; 3], placement: Placement) -> Result<VoxelGrid, GridError> {
        voxel_count(dims)?;
        Ok(VoxelGrid { dims, placement })
    }

    /// Voxels along i, j, k.
    pub fn dims(&self) -> [usize; 3] {
        self.dims
    }

    /// Number of voxels.
    pub fn voxel_count(&self) -> usize {
        self.dims.iter().product()
    }

    /// Distance between neighbouring voxel centres along i, j, k.
    pub fn spacing_m(&self) -> [f64; 3] {
        self.placement.spacing_m
    }

    /// World position of the centre of voxel (0, 0, 0).
    pub fn origin_m(&self) -> [f64; 3] {
        self.placement.origin_m
    }

    /// World directions of i, j, k: perpendicular unit vectors.
    pub fn axes(&self) -> [[f64; 3]; 3] {
        self.placement.axes
    }

    /// Row-major matrix whose columns are the axes: `direction()[row][axis]`.
    pub fn direction(&self) -> [[f64; 3]; 3] {
        let axes = self.placement.axes;
        [0, 1, 2].map(|row| [axes[0][row], axes[1][row], axes[2][row]])
    }

    /// World position of a point in voxel coordinates; (0, 0, 0) is the centre of the first voxel.
    pub fn world_m(&self, voxel: [f64; 3]) -> [f64; 3] {
        let Placement { spacing_m, origin_m, axes } = self.placement;
        let step = [0, 1, 2].map(|axis| voxel[axis] * spacing_m[axis]);
        [0, 1, 2].map(|row| {
            origin_m[row] + (axes[0][row] * step[0] + axes[1][row] * step[1] + axes[2][row] * step[2])
        })
    }

    /// Linear index of voxel (i, j, k); `None` outside the grid.
    pub fn index(&self, [i, j, k]: [usize; 3]) -> Option<usize> {
        let [ni, nj, nk] = self.dims;
        (i < ni && j < nj && k < nk).then(|| i + ni * (j + nj * k))
    }

    /// Voxel (i, j, k) of a linear index; `None` outside the grid.
    pub fn voxel(&self, index: usize) -> Option<[usize; 3]> {
        let [ni, nj, _] = self.dims;
        (index < self.voxel_count()).then(|| [index % ni, index / ni % nj, index / (ni * nj)])
    }
}

/// A grid without dimensions, for readers that learn them last.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Placement {
    spacing_m: [f64; 3],
    origin_m: [f64; 3],
    axes: [[f64; 3]; 3],
}

impl Placement {
    /// Creates a validated placement, as [`VoxelGrid::new`] does.
    ///
    /// # Errors
    /// Any [`GridError`] except [`GridError::Dimensions`].
    pub fn new(spacing_m: [f64; 3], origin_m: [f64; 3], axes: [[f64; 3]; 3]) -> Result<Placement, GridError> {
        // Written so that NaN fails.
        if !spacing_m.iter().all(|s| (MIN_SPACING_M..=MAX_SPACING_M).contains(s)) {
            return Err(GridError::Spacing { spacing_m });
        }
        if !origin_m.iter().all(|x| x.abs() <= MAX_ORIGIN_M) {
            return Err(GridError::Origin { origin_m });
        }
        Ok(Placement { spacing_m, origin_m, axes: perpendicular(axes)? })
    }

    /// Distance between neighbouring voxel centres along i, j, k.
    pub fn spacing_m(&self) -> [f64; 3] {
        self.spacing_m
    }

    /// World position of the centre of voxel (0, 0, 0).
    pub fn origin_m(&self) -> [f64; 3] {
        self.origin_m
    }

    /// World directions of i, j, k: perpendicular unit vectors.
    pub fn axes(&self) -> [[f64; 3]; 3] {
        self.axes
    }
}

/// Returns the number of voxels if it is within the limits.
///
/// # Errors
/// [`GridError::Dimensions`].
pub fn voxel_count(dims: [usize; 3]) -> Result<usize, GridError> {
    let each = dims.iter().all(|n| (1..=MAX_VOXELS_ALONG_AXIS).contains(n));
    // Cannot overflow: three axes of at most 2^16.
    let count = if each { dims.iter().product() } else { 0 };
    if each && count <= MAX_VOXELS { Ok(count) } else { Err(GridError::Dimensions { dims }) }
}

fn perpendicular(axes: [[f64; 3]; 3]) -> Result<[[f64; 3]; 3], GridError> {
    let deviation = deviation(&axes);
    if deviation > PERPENDICULAR_TOLERANCE {
        return Err(GridError::Sheared { deviation });
    }
    if deviation <= EXACT {
        return Ok(axes);
    }
    let [x, y, z] = axes;
    let x = unit(x);
    let y = unit(without(y, x, dot(x, y)));
    let z = unit(without(without(z, x, dot(x, z)), y, dot(y, z)));
    Ok([x, y, z])
}

/// Largest deviation of the axes' dot products from those of orthonormal axes; infinite if one is NaN.
fn deviation(axes: &[[f64; 3]; 3]) -> f64 {
    let mut largest = 0.0_f64;
    for (i, a) in axes.iter().enumerate() {
        for (j, b) in axes.iter().enumerate().take(i + 1) {
            let off = (dot(*a, *b) - if i == j { 1.0 } else { 0.0 }).abs();
            // `max` would drop a NaN.
            largest = if off.is_nan() { f64::INFINITY } else { largest.max(off) };
        }
    }
    largest
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn unit(a: [f64; 3]) -> [f64; 3] {
    let length = dot(a, a).sqrt();
    a.map(|x| x / length)
}

/// `a` minus its component `along` in the direction of the unit vector.
fn without(a: [f64; 3], unit: [f64; 3], along: f64) -> [f64; 3] {
    [0, 1, 2].map(|i| a[i] - unit[i] * along)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const AXES: [[f64; 3]; 3] = WORLD_AXES;

    fn with(
        dims: [usize; 3],
        spacing_m: [f64; 3],
        origin_m: [f64; 3],
        axes: [[f64; 3]; 3],
    ) -> Option<GridError> {
        VoxelGrid::new(dims, spacing_m, origin_m, axes).err()
    }

    #[test]
    fn every_part_has_its_range() {
        for dims in [[0, 4, 4], [4, 65_537, 1], [1024, 1024, 513], [usize::MAX; 3]] {
            assert_eq!(with(dims, [1e-3; 3], [0.0; 3], AXES), Some(GridError::Dimensions { dims }));
        }
        assert_eq!(with([1024, 1024, 512], [1e-3; 3], [0.0; 3], AXES), None);
        for bad in [0.0, -1e-3, 9e-7, 0.11, f64::INFINITY, f64::NAN] {
            assert!(matches!(
                with([4; 3], [1e-3, bad, 1e-3], [0.0; 3], AXES),
                Some(GridError::Spacing { .. })
            ));
        }
        for bad in [100.1, -1e9, f64::INFINITY, f64::NAN] {
            assert!(matches!(with([4; 3], [1e-3; 3], [0.0, 0.0, bad], AXES), Some(GridError::Origin { .. })));
        }
        for bad in [f64::NAN, f64::INFINITY, 1e200, 0.0] {
            let axes = [[bad, 0.0, 0.0], AXES[1], AXES[2]];
            assert!(matches!(with([4; 3], [1e-3; 3], [0.0; 3], axes), Some(GridError::Sheared { .. })));
        }
    }

    #[test]
    fn a_left_handed_grid_is_taken_as_it_is() {
        let axes = [AXES[1], AXES[0], [0.0, 0.0, -1.0]];
        let mirrored = [AXES[1], AXES[0], AXES[2]];
        for axes in [axes, mirrored] {
            assert_eq!(VoxelGrid::new([4; 3], [1e-3; 3], [0.0; 3], axes).unwrap().axes(), axes);
        }
    }

    proptest! {
        /// Axes within the tolerance become perpendicular to within rounding, move by no more than their
        /// error, and are then kept bit for bit.
        #[test]
        fn axes_within_the_tolerance_become_perpendicular_once(
            turn in prop::array::uniform3(-3.0..3.0_f64),
            off in prop::array::uniform9(-2.5e-5..2.5e-5_f64),
        ) {
            let exact = rotated(turn);
            let mut axes = exact;
            for (value, off) in axes.iter_mut().flatten().zip(off) {
                *value += off;
            }
            let grid = VoxelGrid::new([4; 3], [1e-3; 3], [0.0; 3], axes).unwrap();
            prop_assert!(deviation(&grid.axes()) <= 1e-15, "{}", deviation(&grid.axes()));
            for (a, b) in grid.axes().iter().flatten().zip(axes.iter().flatten()) {
                prop_assert!((a - b).abs() <= PERPENDICULAR_TOLERANCE);
            }
            let again = VoxelGrid::new([4; 3], [1e-3; 3], [0.0; 3], grid.axes()).unwrap();
            prop_assert_eq!(again, grid);
        }

        #[test]
        fn the_tolerance_decides(cosine in -1e-2..1e-2_f64) {
            let axes = [AXES[0], [cosine, (1.0 - cosine * cosine).sqrt(), 0.0], AXES[2]];
            let refused = VoxelGrid::new([4; 3], [1e-3; 3], [0.0; 3], axes).is_err();
            prop_assert_eq!(refused, cosine.abs() > PERPENDICULAR_TOLERANCE);
        }
    }

    /// Axes rotated about x, then y, then z.
    fn rotated(turn: [f64; 3]) -> [[f64; 3]; 3] {
        let mut axes = AXES;
        for (about, angle) in turn.into_iter().enumerate() {
            let (s, c) = angle.sin_cos();
            let (i, j) = ((about + 1) % 3, (about + 2) % 3);
            for axis in &mut axes {
                (axis[i], axis[j]) = (c * axis[i] - s * axis[j], s * axis[i] + c * axis[j]);
            }
        }
        axes
    }
}
