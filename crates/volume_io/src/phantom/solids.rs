//! Blocks and spheres of constant Hounsfield units, for tests with closed-form answers.

use super::fill::{Field, fill, grid_along_axes};
use crate::error::VolumeError;
use crate::volume::{dot, norm};
use voxel_grid::Volume;

/// A rectangular block of two materials that meet in a plane, surrounded by air: for skiving tests and
/// density steps.
#[derive(Clone, Debug, PartialEq)]
pub struct BlockSpec {
    /// Voxels along x, y, z.
    pub dims: [usize; 3],
    /// Voxel spacing, metres.
    pub spacing_m: [f64; 3],
    /// Centre of voxel (0, 0, 0), world LPS, metres.
    pub origin_m: [f64; 3],
    /// Air between the edge of the volume and the block along x, y, z, metres; 0 fills the volume.
    pub margin_m: [f64; 3],
    /// A point of the plane between the two materials, world, metres.
    pub plane_point_m: [f64; 3],
    /// Normal of that plane (any length but zero); it points into the `hu_ahead` material.
    pub plane_normal: [f64; 3],
    /// Hounsfield units on the side the normal points away from.
    pub hu_behind: i16,
    /// Hounsfield units on the side the normal points to.
    pub hu_ahead: i16,
    /// Hounsfield units around the block.
    pub hu_outside: i16,
}

impl Default for BlockSpec {
    /// 40 x 30 x 30 mm at 0.5 mm, centred at the world origin; soft below and hard above the plane z = 0; 2.5
    /// mm of air around it.
    fn default() -> Self {
        Self {
            dims: [80, 60, 60],
            spacing_m: [0.5e-3; 3],
            origin_m: [-0.01975, -0.01475, -0.01475],
            margin_m: [2.5e-3; 3],
            plane_point_m: [0.0; 3],
            plane_normal: [0.0, 0.0, 1.0],
            hu_behind: 200,
            hu_ahead: 1400,
            hu_outside: -1000,
        }
    }
}

/// Voxels along the axes, and the centre of the first one: at least `extent_m`, centred at 0.
fn centred(extent_m: [f64; 3], spacing_m: f64) -> ([usize; 3], [f64; 3]) {
    // A spacing that divides the extent but for rounding needs no voxel more. Casts saturate.
    let dims = extent_m.map(|extent_m| (libm::ceil(extent_m / spacing_m - 1e-6) as usize).max(1));
    (dims, dims.map(|count| -0.5 * spacing_m * (count - 1) as f64))
}

impl BlockSpec {
    /// The default block in voxels of another size, metres: the same object at the same place, in a volume of
    /// at least the same extent.
    pub fn with_spacing(spacing_m: f64) -> Self {
        let usual = Self::default();
        if spacing_m == usual.spacing_m[0] {
            return usual;
        }
        let extent_m = [0, 1, 2].map(|axis| usual.dims[axis] as f64 * usual.spacing_m[axis]);
        let (dims, origin_m) = centred(extent_m, spacing_m);
        let margin_m = [0, 1, 2].map(|axis| {
            let size_m = extent_m[axis] - 2.0 * usual.margin_m[axis];
            // A centre on the surface counts as inside, whatever its rounding.
            (0.5 * (dims[axis] as f64 * spacing_m - size_m) - 1e-9).max(0.0)
        });
        Self { dims, spacing_m: [spacing_m; 3], origin_m, margin_m, ..usual }
    }
}

impl SphereSpec {
    /// The default ball in voxels of another size, metres: the same object at the same place, in a volume of
    /// at least the same extent.
    pub fn with_spacing(spacing_m: f64) -> Self {
        let usual = Self::default();
        if spacing_m == usual.spacing_m[0] {
            return usual;
        }
        let extent_m = [0, 1, 2].map(|axis| usual.dims[axis] as f64 * usual.spacing_m[axis]);
        let (dims, origin_m) = centred(extent_m, spacing_m);
        Self { dims, spacing_m: [spacing_m; 3], origin_m, ..usual }
    }
}

/// A ball of constant Hounsfield units.
#[derive(Clone, Debug, PartialEq)]
pub struct SphereSpec {
    /// Voxels along x, y, z.
    pub dims: [usize; 3],
    /// Voxel spacing, metres.
    pub spacing_m: [f64; 3],
    /// Centre of voxel (0, 0, 0), world LPS, metres.
    pub origin_m: [f64; 3],
    /// Centre of the ball, world, metres.
    pub center_m: [f64; 3],
    /// Radius of the ball, metres.
    pub radius_m: f64,
    /// Hounsfield units inside.
    pub hu_inside: i16,
    /// Hounsfield units outside.
    pub hu_outside: i16,
}

impl Default for SphereSpec {
    /// A ball of 10 mm radius, 1000 HU, at the world origin in 64³ voxels of 0.5 mm.
    fn default() -> Self {
        Self {
            dims: [64; 3],
            spacing_m: [0.5e-3; 3],
            origin_m: [-0.01575; 3],
            center_m: [0.0; 3],
            radius_m: 0.010,
            hu_inside: 1000,
            hu_outside: -1000,
        }
    }
}

/// Builds the block: a voxel has the material at its centre (a centre on the plane counts as ahead).
///
/// # Errors
/// [`VolumeError::Argument`] for a zero or non-finite normal or a negative margin; otherwise as the grid.
pub fn block(spec: &BlockSpec) -> Result<Volume, VolumeError> {
    let length = norm(spec.plane_normal);
    if !(length.is_finite() && length > 0.0) {
        return Err(VolumeError::argument(
            "plane_normal",
            format!("{:?}", spec.plane_normal),
            "a finite vector that is not zero",
        ));
    }
    if !spec.margin_m.iter().all(|margin_m| margin_m.is_finite() && *margin_m >= 0.0) {
        return Err(VolumeError::argument("margin_m", format!("{:?}", spec.margin_m), "zero or more metres"));
    }
    let grid = grid_along_axes("block phantom", spec.dims, spec.spacing_m, spec.origin_m)?;
    Ok(fill(grid, spec, 1))
}

/// Builds the ball: a voxel is inside when its centre is (a centre on the surface counts as inside).
///
/// # Errors
/// [`VolumeError::Argument`] for a radius that is not positive; otherwise as the grid.
pub fn sphere(spec: &SphereSpec) -> Result<Volume, VolumeError> {
    if !(spec.radius_m.is_finite() && spec.radius_m > 0.0) {
        return Err(VolumeError::argument(
            "radius_m",
            format!("{}", spec.radius_m),
            "a positive radius in metres",
        ));
    }
    let grid = grid_along_axes("sphere phantom", spec.dims, spec.spacing_m, spec.origin_m)?;
    Ok(fill(grid, spec, 1))
}

impl Field for BlockSpec {
    type Region = ();

    fn region(&self, _center_m: [f64; 3], _radius_m: f64) {}

    fn hu(&self, (): (), p: [f64; 3]) -> f64 {
        let inside = (0..3).all(|axis| {
            // The volume ends half a voxel beyond the outermost centres.
            let low = self.origin_m[axis] - 0.5 * self.spacing_m[axis] + self.margin_m[axis];
            let high = self.origin_m[axis] + (self.dims[axis] as f64 - 0.5) * self.spacing_m[axis]
                - self.margin_m[axis];
            (low..=high).contains(&p[axis])
        });
        if !inside {
            return f64::from(self.hu_outside);
        }
        let offset = super::shapes::sub(p, self.plane_point_m);
        f64::from(if dot(offset, self.plane_normal) >= 0.0 { self.hu_ahead } else { self.hu_behind })
    }
}

impl Field for SphereSpec {
    type Region = ();

    fn region(&self, _center_m: [f64; 3], _radius_m: f64) {}

    fn hu(&self, (): (), p: [f64; 3]) -> f64 {
        let inside = super::shapes::sphere(p, self.center_m, self.radius_m) <= 0.0;
        f64::from(if inside { self.hu_inside } else { self.hu_outside })
    }
}
