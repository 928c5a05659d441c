//! Errors: what was refused, and how to correct it.

use thiserror::Error;

/// Bytes per GiB.
const GIB: f64 = (1_u64 << 30) as f64;

/// A refused input. The call that returned it changed nothing.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum DrrError {
    /// A number outside its range.
    #[error("{field} is {given:?}, expected {expected}")]
    OutOfRange {
        /// Name of the field, with its unit.
        field: &'static str,
        /// The given value.
        given: f64,
        /// The accepted range, in words.
        expected: &'static str,
    },
    /// A buffer of the wrong length.
    #[error("{field} has {given} elements, expected {expected}: size the buffer to the volume or detector")]
    Length {
        /// Name of the buffer.
        field: &'static str,
        /// Its actual length.
        given: usize,
        /// The required length.
        expected: usize,
    },
    /// The grid is invalid.
    #[error("the volume has {0}")]
    Grid(#[from] voxel_grid::GridError),
    /// The voxels of a volume message cannot be read in place.
    #[error("malformed volume message: {problem}")]
    BadVolume {
        /// What is wrong.
        problem: String,
    },
    /// Two direction vectors that must be perpendicular are not.
    #[error(
        "{field} are not perpendicular unit vectors (worst error {error:.3e}, limit {limit:.1e}): \
         normalise the axes"
    )]
    NotOrthonormal {
        /// The vectors concerned.
        field: &'static str,
        /// Largest deviation of their dot products from 0 or 1.
        error: f64,
        /// The accepted deviation.
        limit: f64,
    },
    /// A removed voxel is outside the volume. The whole batch is refused.
    #[error(
        "removed voxel {given} at position {position} of the batch: the volume has {voxels} voxels; \
         send linear indices x + nx*(y + ny*z)"
    )]
    VoxelIndex {
        /// The offending index.
        given: u32,
        /// Its position in the batch.
        position: usize,
        /// Number of voxels in the volume.
        voxels: usize,
    },
    /// The view's grid differs from the one that the renderer was built for.
    #[error("the volume's grid differs from the one the renderer was built for: build a new renderer")]
    GridChanged,
    /// A tool part with impossible dimensions.
    #[error("tool part {part}: {reason}")]
    ToolPart {
        /// Position of the part in the tool.
        part: usize,
        /// What is wrong and what is expected.
        reason: &'static str,
    },
    /// An object of the scene cannot be shown.
    #[error("drr.object `{name}`: its mesh {problem}")]
    Object {
        /// Name of the object.
        name: String,
        /// What is wrong.
        problem: String,
    },
    /// The reordered copy of the volume does not fit into free memory.
    #[error(
        "the reordered copy of the {} x {} x {} voxel volume needs {:.2} GiB ({bytes_each} B per voxel, plus \
         32 zeros between rows) but only {:.2} GiB are free, or a limit (`ulimit -v`) is lower: crop or \
         resample the volume, or choose the projector `preview` or `joseph`",
        dims[0], dims[1], dims[2], *needed_bytes as f64 / GIB, *available_bytes as f64 / GIB
    )]
    Memory {
        /// Voxels along each axis.
        dims: [usize; 3],
        /// Bytes per voxel.
        bytes_each: usize,
        /// Bytes of the copy.
        needed_bytes: u64,
        /// Bytes free.
        available_bytes: u64,
    },
    /// The intermediate images of the sum over slices do not fit into free memory.
    #[error(
        "the intermediate images of this C-arm ({samples} samples) need {:.2} GiB but only {:.2} GiB are \
         free, or a limit (`ulimit -v`) is lower: lower `oversampling`, narrow the detector, or choose the \
         projector `preview` or `joseph`",
        *needed_bytes as f64 / GIB, *available_bytes as f64 / GIB
    )]
    Images {
        /// Samples of all images.
        samples: usize,
        /// Bytes of the images.
        needed_bytes: u64,
        /// Bytes free.
        available_bytes: u64,
    },
    /// A frame of a batch is invalid, so the whole batch is refused.
    #[error("frame {frame} of the batch (counting from 0): {cause}")]
    Frame {
        /// Position of the frame in the batch.
        frame: usize,
        /// Why.
        #[source]
        cause: Box<DrrError>,
    },
    /// The worker threads could not be started.
    #[error("cannot start {threads} render threads ({reason}): lower `threads` or raise the process limit")]
    Threads {
        /// Number requested.
        threads: usize,
        /// The system's reason.
        reason: String,
    },
}

impl DrrError {
    /// Returns true if the machine is at fault: with more memory or threads the same frame would be rendered.
    pub fn is_of_the_machine(&self) -> bool {
        match self {
            DrrError::Memory { .. } | DrrError::Images { .. } | DrrError::Threads { .. } => true,
            DrrError::Frame { cause, .. } => cause.is_of_the_machine(),
            _ => false,
        }
    }
}

/// Refuses a number that is not finite or outside `low..=high`.
pub(crate) fn check_range(
    field: &'static str,
    given: f64,
    low: f64,
    high: f64,
    expected: &'static str,
) -> Result<(), DrrError> {
    if given.is_finite() && given >= low && given <= high {
        Ok(())
    } else {
        Err(DrrError::OutOfRange { field, given, expected })
    }
}

/// Refuses axes that deviate from orthonormal by more than `limit`.
pub(crate) fn check_orthonormal(field: &'static str, axes: &[[f64; 3]], limit: f64) -> Result<(), DrrError> {
    let mut error = 0.0_f64;
    for (i, a) in axes.iter().enumerate() {
        for (j, b) in axes.iter().enumerate().take(i + 1) {
            let want = if i == j { 1.0 } else { 0.0 };
            let deviation = (crate::vector::dot(*a, *b) - want).abs();
            // Keep a NaN as infinity: `max` would drop it.
            error = if deviation.is_nan() { f64::INFINITY } else { error.max(deviation) };
        }
    }
    if error <= limit { Ok(()) } else { Err(DrrError::NotOrthonormal { field, error, limit }) }
}
