//! Errors of a bone field.

/// Why a bone field rejected its input.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum BoneError {
    /// The grid is invalid.
    #[error("the volume has {0}")]
    Grid(#[from] voxel_grid::GridError),
    /// The CT does not have as many values as the grid has voxels.
    #[error(
        "the CT has {given} values, its grid has {expected} voxels; pass the volume that belongs to the grid"
    )]
    VolumeSize {
        /// Values given.
        given: usize,
        /// Voxels of the grid.
        expected: usize,
    },
    /// A parameter is out of its range.
    #[error("the bone parameter {name} is {value}; expected {expected}")]
    Parameter {
        /// Name of the parameter.
        name: &'static str,
        /// Value given.
        value: f64,
        /// Accepted range.
        expected: &'static str,
    },
    /// Memory for the first partly cut voxels could not be allocated.
    #[error(
        "out of memory: no {bytes} bytes for partly cut voxels; free memory, raise the limit (`ulimit -v`) \
         or use coarser voxels"
    )]
    Memory {
        /// Bytes requested.
        bytes: usize,
    },
    /// A burr is not finite, or larger than the field was built for.
    #[error(
        "the burr's {name} is {value}; expected {expected} (radii up to max_burr_radius_m, here \
         {max_burr_radius_m} m)"
    )]
    Burr {
        /// Name of the quantity.
        name: &'static str,
        /// Value given.
        value: f64,
        /// Accepted range.
        expected: &'static str,
        /// Largest burr radius of this field in metres.
        max_burr_radius_m: f64,
    },
    /// A snapshot belongs to another field.
    #[error(
        "the snapshot does not fit this field: {reason}; restore it into a field built from the same CT and \
         scene"
    )]
    Snapshot {
        /// What differs.
        reason: &'static str,
    },
}
