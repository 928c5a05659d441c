//! A volume's placement as stated in its header, and the summary of a volume that was read.

use crate::error::{Field, VolumeError};
use std::fmt;
use std::path::Path;

use voxel_grid::{GridError, MAX_ORIGIN_M, PERPENDICULAR_TOLERANCE, Placement, Volume, VoxelGrid};

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

impl HuStatistics {
    /// Computes the statistics of voxels.
    pub fn of(hu: &[i16]) -> HuStatistics {
        let sum: i64 = hu.iter().copied().map(i64::from).sum();
        HuStatistics {
            min_hu: hu.iter().copied().min().unwrap_or(i16::MAX),
            max_hu: hu.iter().copied().max().unwrap_or(i16::MIN),
            mean_hu: sum as f64 / hu.len().max(1) as f64,
        }
    }
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
    /// Grid of the voxels.
    pub grid: VoxelGrid,
    /// Range and mean.
    pub hu: HuStatistics,
    /// Every assumption and every change of values by the reader.
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
        let (grid, hu) = (volume.grid, HuStatistics::of(&volume.hu));
        Self { format, stored_as, units, grid, hu, notes }
    }
}

impl fmt::Display for VolumeInfo {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let dims @ [ni, nj, nk] = self.grid.dims();
        let spacing_mm = self.grid.spacing_m().map(|s| s * 1e3);
        let size_mm = [0, 1, 2].map(|axis| dims[axis] as f64 * spacing_mm[axis]);
        let origin_mm = self.grid.origin_m().map(|o| o * 1e3);
        writeln!(f, "format     {}, {}", self.format, self.stored_as)?;
        writeln!(f, "units      {}", self.units)?;
        writeln!(f, "voxels     {ni} x {nj} x {nk}")?;
        writeln!(f, "spacing    {:.4} x {:.4} x {:.4} mm", spacing_mm[0], spacing_mm[1], spacing_mm[2])?;
        writeln!(f, "size       {:.1} x {:.1} x {:.1} mm", size_mm[0], size_mm[1], size_mm[2])?;
        writeln!(f, "origin     ({:.3}, {:.3}, {:.3}) mm LPS", origin_mm[0], origin_mm[1], origin_mm[2])?;
        for (name, d) in ["i", "j", "k"].iter().zip(self.grid.axes()) {
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
    /// Converts a [`GridError`] to an error with the format's own field names; `axes` are the given unit
    /// axes.
    fn error(self, path: &Path, error: GridError, axes: [[f64; 3]; 3]) -> VolumeError {
        match error {
            GridError::Spacing { spacing_m } => {
                VolumeError::Spacing(Field::new(path, self.spacing, format!("{spacing_m:?} m")))
            }
            GridError::Origin { origin_m } => VolumeError::header(
                path,
                self.origin,
                format!("{origin_m:?} m"),
                format!("a finite position within {MAX_ORIGIN_M} m"),
            ),
            GridError::Sheared { .. } => {
                let angle =
                    |a: usize, b: usize| libm::acos(dot(axes[a], axes[b]).clamp(-1.0, 1.0)).to_degrees();
                let (ij, ik, jk) = (angle(0, 1), angle(0, 2), angle(1, 2));
                let given = format!("angles i-j {ij:.4}, i-k {ik:.4}, j-k {jk:.4} degrees");
                VolumeError::Sheared(Field::new(path, self.direction, given), PERPENDICULAR_TOLERANCE)
            }
            GridError::Dimensions { dims } => too_large(path, "dims", dims),
        }
    }
}

/// Builds a grid that is not read from a file; `path` names it in errors.
///
/// # Errors
/// The same variants as a reader's.
pub fn grid_of(
    path: &Path,
    dims: [usize; 3],
    spacing_m: [f64; 3],
    origin_m: [f64; 3],
    axes: [[f64; 3]; 3],
) -> Result<VoxelGrid, VolumeError> {
    let names = GeometryFields { spacing: "spacing_m", direction: "direction", origin: "origin_m" };
    voxel_count(path, "dims", dims)?;
    VoxelGrid::new(dims, spacing_m, origin_m, axes).map_err(|error| names.error(path, error, axes))
}

/// Builds the volume of voxels at a placement.
pub(crate) fn placed(
    path: &Path,
    dims: [usize; 3],
    placement: Placement,
    hu: Vec<i16>,
) -> Result<Volume, VolumeError> {
    let grid = VoxelGrid::placed(dims, placement).map_err(|_| too_large(path, "dims", dims))?;
    Ok(Volume { grid, hu })
}

/// Refuses a volume whose number of voxels does not match its grid.
pub(crate) fn check_length(path: &Path, volume: &Volume) -> Result<(), VolumeError> {
    let (given, expected) = (volume.hu.len(), volume.grid.voxel_count());
    if given == expected {
        return Ok(());
    }
    let dims = volume.grid.dims();
    Err(VolumeError::header(
        path,
        "hu",
        format!("{given} voxels"),
        format!("{expected} voxels for dimensions {dims:?}"),
    ))
}

/// Cosines between axes up to this are `f32` rounding, and not worth a note.
const NOTED_COSINE: f64 = 1e-6;

/// A volume's geometry as stated in a header, not yet checked. LPS.
#[derive(Clone, Copy, Debug)]
pub(crate) struct StatedGeometry {
    pub spacing_m: [f64; 3],
    pub origin_m: [f64; 3],
    /// One direction per axis, of any positive length.
    pub axes: [[f64; 3]; 3],
}

/// Builds the placement stated in a header. Adds a note if its axes had to be made perpendicular.
pub(crate) fn placement(
    path: &Path,
    names: GeometryFields,
    stated: StatedGeometry,
    notes: &mut Vec<String>,
) -> Result<Placement, VolumeError> {
    let StatedGeometry { spacing_m, origin_m, axes } = stated;
    let singular = || VolumeError::SingularDirection(Field::new(path, names.direction, format!("{axes:?}")));
    let mut unit = [[0.0; 3]; 3];
    for (out, axis) in unit.iter_mut().zip(axes) {
        let length = norm(axis);
        if !(length.is_finite() && length > 1e-12) {
            return Err(singular());
        }
        // Adding zero turns −0 into +0, so that files with the same geometry compare and print the same.
        *out = axis.map(|c| c / length + 0.0);
    }
    // Linear dependence and shear are different errors: a volume of zero thickness cannot be resampled, a
    // sheared one can.
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

/// Returns the number of voxels, if within the limit; `field` names the dimensions.
pub(crate) fn voxel_count(path: &Path, field: &str, dims: [usize; 3]) -> Result<usize, VolumeError> {
    if dims.contains(&0) {
        return Err(VolumeError::header(
            path,
            field,
            format!("{dims:?}"),
            "at least one voxel along every axis",
        ));
    }
    voxel_grid::voxel_count(dims).map_err(|_| too_large(path, field, dims))
}

fn too_large(path: &Path, field: &str, dims: [usize; 3]) -> VolumeError {
    VolumeError::TooLarge(Field::new(path, field, format!("{} x {} x {}", dims[0], dims[1], dims[2])))
}

/// Transposes: matrix columns as an array of vectors, or the reverse.
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
