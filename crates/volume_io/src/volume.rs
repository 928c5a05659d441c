//! The volume and its geometry: a rectangular, evenly spaced grid of Hounsfield units in world LPS coordinates.

use crate::error::VolumeError;
use std::fmt;
use std::path::Path;

use voxel_grid::{
    GridError, MAX_ORIGIN_M, MAX_VOXELS, PERPENDICULAR_TOLERANCE, Placement, VoxelGrid, sample,
};

/// A CT volume in Hounsfield units on a rectangular grid in the world frame (LPS, metres).
///
/// Voxel (i, j, k) is `hu[i + dims[0] * (j + dims[1] * k)]`, and its centre lies at
/// `origin_m + direction * (i * spacing_m[0], j * spacing_m[1], k * spacing_m[2])`.
#[derive(Clone, Debug, PartialEq)]
pub struct Volume {
    /// Voxels along i, j, k.
    pub dims: [usize; 3],
    /// Distance between neighbouring voxel centres along i, j, k, metres.
    pub spacing_m: [f64; 3],
    /// Centre of voxel (0, 0, 0), world LPS, metres.
    pub origin_m: [f64; 3],
    /// Row-major matrix whose columns are the unit vectors of i, j, k in LPS: `direction[row][axis]`.
    ///
    /// The columns are perpendicular unit vectors to rounding ([`voxel_grid`]); the determinant may be −1 (a left-handed grid), because
    /// voxels are never reordered.
    pub direction: [[f64; 3]; 3],
    /// Hounsfield units, i fastest.
    pub hu: Vec<i16>,
}

/// The identity direction matrix: i to the patient's left, j to posterior, k to superior.
pub const IDENTITY_DIRECTION: [[f64; 3]; 3] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];

impl Volume {
    /// Number of voxels.
    pub fn voxel_count(&self) -> usize {
        self.hu.len()
    }

    /// Index of voxel (i, j, k) in `hu`; `None` outside the volume.
    pub fn index(&self, voxel: [usize; 3]) -> Option<usize> {
        let [i, j, k] = voxel;
        let [ni, nj, nk] = self.dims;
        (i < ni && j < nj && k < nk).then(|| i + ni * (j + nj * k))
    }

    /// Hounsfield units of voxel (i, j, k); `None` outside the volume.
    pub fn at(&self, voxel: [usize; 3]) -> Option<i16> {
        self.index(voxel).and_then(|index| self.hu.get(index).copied())
    }

    /// World position (LPS, metres) of a continuous voxel coordinate; integers are voxel centres.
    pub fn voxel_to_world_m(&self, voxel: [f64; 3]) -> [f64; 3] {
        let step = [0, 1, 2].map(|axis| voxel[axis] * self.spacing_m[axis]);
        [0, 1, 2].map(|row| {
            let d = self.direction[row];
            self.origin_m[row] + (d[0] * step[0] + d[1] * step[1] + d[2] * step[2])
        })
    }

    /// Continuous voxel coordinate of a world position (LPS, metres): the inverse of [`Volume::voxel_to_world_m`].
    pub fn world_to_voxel(&self, world_m: [f64; 3]) -> [f64; 3] {
        let offset = [0, 1, 2].map(|row| world_m[row] - self.origin_m[row]);
        [0, 1, 2].map(|axis| {
            let along = offset[0] * self.direction[0][axis]
                + offset[1] * self.direction[1][axis]
                + offset[2] * self.direction[2][axis];
            along / self.spacing_m[axis]
        })
    }

    /// Whether a world position lies in the volume's box, to the voxels' faces.
    pub fn holds(&self, world_m: [f64; 3]) -> bool {
        sample::holds(self.dims, self.world_to_voxel(world_m))
    }

    /// Hounsfield units at a world position (LPS, metres), linear between the eight voxel centres around it; beyond the outermost centres
    /// those of the nearest. `None` outside the volume's box.
    pub fn hu_at(&self, world_m: [f64; 3]) -> Option<f64> {
        sample::hu_at(self.dims, &self.hu, self.world_to_voxel(world_m))
    }

    /// Smallest, largest and mean Hounsfield units.
    pub fn statistics(&self) -> HuStatistics {
        let mut min_hu = i16::MAX;
        let mut max_hu = i16::MIN;
        let mut sum = 0_i64;
        for &value in &self.hu {
            min_hu = min_hu.min(value);
            max_hu = max_hu.max(value);
            sum += i64::from(value);
        }
        HuStatistics { min_hu, max_hu, mean_hu: sum as f64 / self.hu.len().max(1) as f64 }
    }

    /// Checks everything a consumer relies on: matching sizes, accepted spacing, finite origin, orthonormal directions.
    ///
    /// # Errors
    /// The first violated rule, with the same variants that the readers use; `path` names the volume in the message.
    pub fn check(&self, path: &Path) -> Result<(), VolumeError> {
        self.grid(path).map(|_| ())
    }

    /// The volume's grid.
    ///
    /// # Errors
    /// As [`Volume::check`].
    pub fn grid(&self, path: &Path) -> Result<VoxelGrid, VolumeError> {
        let count = voxel_count(path, "dims", self.dims)?;
        if self.hu.len() != count {
            return Err(VolumeError::Header {
                path: path.into(),
                field: "hu".into(),
                given: format!("{} voxels", self.hu.len()),
                expected: format!("{count} voxels for dimensions {:?}", self.dims),
            });
        }
        let names = GeometryFields { spacing: "spacing_m", direction: "direction", origin: "origin_m" };
        let (spacing_m, origin_m, axes) = (self.spacing_m, self.origin_m, columns(self.direction));
        let stated = StatedGeometry { spacing_m, origin_m, axes };
        let placement = placement(path, names, stated, &mut Vec::new())?;
        VoxelGrid::placed(self.dims, placement).map_err(|_| too_large(path, "dims", self.dims))
    }

    /// A volume of these voxels at this placement.
    pub(crate) fn placed(dims: [usize; 3], placement: &Placement, hu: Vec<i16>) -> Volume {
        let (spacing_m, origin_m) = (placement.spacing_m(), placement.origin_m());
        Volume { dims, spacing_m, origin_m, direction: columns(placement.axes()), hu }
    }
}

/// Smallest, largest and mean Hounsfield units of a volume.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HuStatistics {
    /// Smallest value.
    pub min_hu: i16,
    /// Largest value.
    pub max_hu: i16,
    /// Mean value.
    pub mean_hu: f64,
}

/// Summary of a volume that was read; its `Display` is a short text of several lines.
#[derive(Clone, Debug, PartialEq)]
pub struct VolumeInfo {
    /// File format, for example `NIfTI-1 (gzip)`.
    pub format: String,
    /// Stored voxel type, for example `int16 big-endian`.
    pub stored_as: String,
    /// The file's own unit of length, and whether it was stated or assumed.
    pub units: String,
    /// Voxels along i, j, k.
    pub dims: [usize; 3],
    /// Voxel spacing, metres.
    pub spacing_m: [f64; 3],
    /// Centre of voxel (0, 0, 0), LPS, metres.
    pub origin_m: [f64; 3],
    /// Axis directions, see [`Volume::direction`].
    pub direction: [[f64; 3]; 3],
    /// Range and mean.
    pub hu: HuStatistics,
    /// Every assumption and every change of values that the reader made.
    pub notes: Vec<String>,
}

impl VolumeInfo {
    /// Describes `volume`, with what its reader knows about the file.
    pub fn new(
        volume: &Volume,
        format: String,
        stored_as: String,
        units: String,
        notes: Vec<String>,
    ) -> Self {
        Self {
            format,
            stored_as,
            units,
            dims: volume.dims,
            spacing_m: volume.spacing_m,
            origin_m: volume.origin_m,
            direction: volume.direction,
            hu: volume.statistics(),
            notes,
        }
    }
}

impl fmt::Display for VolumeInfo {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [ni, nj, nk] = self.dims;
        let spacing_mm = self.spacing_m.map(|s| s * 1e3);
        let size_mm = [0, 1, 2].map(|axis| self.dims[axis] as f64 * spacing_mm[axis]);
        let origin_mm = self.origin_m.map(|o| o * 1e3);
        writeln!(f, "format     {}, {}", self.format, self.stored_as)?;
        writeln!(f, "units      {}", self.units)?;
        writeln!(f, "voxels     {ni} x {nj} x {nk}")?;
        writeln!(f, "spacing    {:.4} x {:.4} x {:.4} mm", spacing_mm[0], spacing_mm[1], spacing_mm[2])?;
        writeln!(f, "size       {:.1} x {:.1} x {:.1} mm", size_mm[0], size_mm[1], size_mm[2])?;
        writeln!(f, "origin     ({:.3}, {:.3}, {:.3}) mm LPS", origin_mm[0], origin_mm[1], origin_mm[2])?;
        for (axis, name) in ["i", "j", "k"].iter().enumerate() {
            let d = [0, 1, 2].map(|row| self.direction[row][axis]);
            writeln!(f, "axis {name}     ({:+.5}, {:+.5}, {:+.5}) LPS", d[0], d[1], d[2])?;
        }
        let hu = self.hu;
        write!(f, "HU         {} to {}, mean {:.1}", hu.min_hu, hu.max_hu, hu.mean_hu)?;
        for note in &self.notes {
            write!(f, "\nnote       {note}")?;
        }
        Ok(())
    }
}

/// The field names a format uses for its geometry, for error messages.
#[derive(Clone, Copy)]
pub(crate) struct GeometryFields {
    pub spacing: &'static str,
    pub direction: &'static str,
    pub origin: &'static str,
}

impl GeometryFields {
    /// Turns a [`GridError`] into an error with the format's own field names; `axes` are the unit axes given.
    fn error(self, path: &Path, error: GridError, axes: [[f64; 3]; 3]) -> VolumeError {
        let path = path.to_owned();
        match error {
            GridError::Spacing { spacing_m } => {
                VolumeError::Spacing { path, field: self.spacing.into(), given: format!("{spacing_m:?} m") }
            }
            GridError::Origin { origin_m } => VolumeError::Header {
                path,
                field: self.origin.into(),
                given: format!("{origin_m:?} m"),
                expected: format!("a finite position within {MAX_ORIGIN_M} m"),
            },
            GridError::Sheared { .. } => {
                let angle =
                    |a: usize, b: usize| libm::acos(dot(axes[a], axes[b]).clamp(-1.0, 1.0)).to_degrees();
                let (ij, ik, jk) = (angle(0, 1), angle(0, 2), angle(1, 2));
                VolumeError::Sheared {
                    path,
                    field: self.direction.into(),
                    given: format!("angles i-j {ij:.4}, i-k {ik:.4}, j-k {jk:.4} degrees"),
                    tolerance: PERPENDICULAR_TOLERANCE,
                }
            }
            GridError::Dimensions { dims } => too_large(&path, "dims", dims),
        }
    }
}

/// Cosines between axes up to this are the rounding of `f32`, and not worth a note.
const NOTED_COSINE: f64 = 1e-6;

/// A volume's geometry as a header states it, not yet checked. LPS.
#[derive(Clone, Copy, Debug)]
pub(crate) struct StatedGeometry {
    pub spacing_m: [f64; 3],
    pub origin_m: [f64; 3],
    /// One direction an axis, of any positive length.
    pub axes: [[f64; 3]; 3],
}

/// The placement that a header states. Notes if its axes had to be made perpendicular.
pub(crate) fn placement(
    path: &Path,
    names: GeometryFields,
    stated: StatedGeometry,
    notes: &mut Vec<String>,
) -> Result<Placement, VolumeError> {
    let StatedGeometry { spacing_m, origin_m, axes } = stated;
    let singular = || VolumeError::SingularDirection {
        path: path.into(),
        field: names.direction.into(),
        given: format!("{axes:?}"),
    };
    let mut unit = [[0.0; 3]; 3];
    for (out, axis) in unit.iter_mut().zip(axes) {
        let length = norm(axis);
        if !(length.is_finite() && length > 1e-12) {
            return Err(singular());
        }
        // Adding zero turns −0 into +0, so that two files with the same geometry compare and print the same.
        *out = axis.map(|c| c / length + 0.0);
    }
    // Linear dependence and shear are different errors: a volume of zero thickness cannot be resampled, a sheared one can.
    let triple = dot(unit[0], cross(unit[1], unit[2]));
    if !(triple.is_finite() && triple.abs() > 1e-6) {
        return Err(singular());
    }
    let placed = Placement::new(spacing_m, origin_m.map(|o| o + 0.0), unit)
        .map_err(|error| names.error(path, error, unit))?;
    let cosine =
        [(0, 1), (0, 2), (1, 2)].map(|(a, b)| dot(unit[a], unit[b]).abs()).into_iter().fold(0.0, f64::max);
    if cosine > NOTED_COSINE {
        notes.push(format!(
            "the axes were made perpendicular (largest cosine {cosine:.1e}: rounded decimals)"
        ));
    }
    Ok(placed)
}

/// The number of voxels, if within the limit; `field` names the dimensions.
pub(crate) fn voxel_count(path: &Path, field: &str, dims: [usize; 3]) -> Result<usize, VolumeError> {
    if dims.contains(&0) {
        return Err(VolumeError::Header {
            path: path.into(),
            field: field.into(),
            given: format!("{dims:?}"),
            expected: "at least one voxel along every axis".into(),
        });
    }
    voxel_grid::voxel_count(dims).map_err(|_| too_large(path, field, dims))
}

fn too_large(path: &Path, field: &str, dims: [usize; 3]) -> VolumeError {
    VolumeError::TooLarge {
        path: path.into(),
        field: field.into(),
        given: format!("{} x {} x {}", dims[0], dims[1], dims[2]),
        limit: MAX_VOXELS,
    }
}

/// Transposes: columns of a matrix as an array of vectors, or the reverse.
pub(crate) fn columns(m: [[f64; 3]; 3]) -> [[f64; 3]; 3] {
    [0, 1, 2].map(|column| [0, 1, 2].map(|row| m[row][column]))
}

pub(crate) fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub(crate) fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

pub(crate) fn norm(a: [f64; 3]) -> f64 {
    dot(a, a).sqrt()
}
