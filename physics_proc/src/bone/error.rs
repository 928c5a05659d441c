//! What can be wrong with the inputs of a bone field.

/// Why a bone field refuses what it was given.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum BoneError {
    /// A dimension is 0, or there are more voxels than a 32-bit index can name.
    #[error(
        "the grid has {dims:?} voxels; expected at least 1 along each axis and fewer than 2^32 - 1 in all"
    )]
    Dimensions {
        /// Voxels along x, y, z.
        dims: [usize; 3],
    },
    /// A spacing is not a finite positive length.
    #[error("the voxel spacing is {spacing_m:?} m; expected three finite lengths above 0")]
    Spacing {
        /// Spacing along x, y, z in metres.
        spacing_m: [f64; 3],
    },
    /// The origin is not finite.
    #[error("the grid's origin is {origin_m:?} m; expected three finite numbers")]
    Origin {
        /// Origin in metres.
        origin_m: [f64; 3],
    },
    /// The direction matrix is sheared or scaled.
    #[error(
        "the grid's direction matrix deviates from orthonormal by {deviation}; expected at most 1e-5: resample a sheared series to a rectangular grid first"
    )]
    Direction {
        /// Largest entry of |D^T D - I|.
        deviation: f64,
    },
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
        /// What is allowed.
        expected: &'static str,
    },
    /// A burr is not finite, or larger than the field was built for.
    #[error(
        "the burr's {name} is {value}; expected {expected} (radii up to max_burr_radius_m, here {max_burr_radius_m} m)"
    )]
    Burr {
        /// Name of the quantity.
        name: &'static str,
        /// Value given.
        value: f64,
        /// What is allowed.
        expected: &'static str,
        /// Largest burr radius of this field in metres.
        max_burr_radius_m: f64,
    },
    /// A snapshot belongs to another field.
    #[error(
        "the snapshot does not fit this field: {reason}; restore it into a field built from the same CT and scene"
    )]
    Snapshot {
        /// What differs.
        reason: &'static str,
    },
}
