//! CT volumes: readers, phantoms with known landmarks, and geometry in world LPS.
//!
//! Every reader returns a [`Volume`](voxel_grid::Volume): Hounsfield units as `i16`, i fastest, with spacing,
//! origin and direction in the world frame (LPS, metres). Readers never resample or reorder voxels; they only
//! convert the geometry, which [`voxel_grid`] checks. [`resample`] is explicit.
//!
//! **Boundary:** knows nothing about processes or scenes. **Invariants:** every length in a file is checked
//! before memory is allocated for it; no file outside a header's folder is opened unless the caller allows
//! it; sheared, unevenly spaced, incomplete or mixed volumes are refused, never assumed to be uniform.
//!
//! ```
//! use volume_io::{read, write_nrrd};
//! use voxel_grid::{Volume, VoxelGrid};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let grid = VoxelGrid::axis_aligned([2, 2, 2], [1e-3; 3], [0.0, 0.0, 0.1])?;
//! let volume = Volume { grid, hu: vec![-1000, 0, 40, 300, 700, 1000, 1500, 1900] };
//! let folder = tempfile::tempdir()?;
//! let path = folder.path().join("block.nrrd");
//! write_nrrd(&path, &volume)?;
//! let again = read(&path)?;
//! assert_eq!(again.at([1, 1, 1]), Some(1900));
//! assert!((again.grid.world_m([1.0, 0.0, 0.0])[0] - 1e-3).abs() < 1e-12);
//! # Ok(())
//! # }
//! ```

mod data_files;
mod dicom;
mod error;
mod gzip;
mod hash;
mod input;
mod mask;
mod metaimage;
mod nifti;
mod nifti_header;
mod nifti_write;
mod nrrd;
mod nrrd_write;
mod options;
pub mod phantom;
mod read;
mod rectify;
mod resample;
mod scalar;
mod sources;
mod text_header;
mod volume;

pub use error::{Field, VolumeError};
pub use hash::{identified, volume_hash};
pub use input::DataFiles;
pub use mask::{MaskModel, mask_to_hu};
pub use nifti_write::write_nifti;
pub use nrrd_write::write_nrrd;
pub use options::{GreyScale, Label, ReadOptions, SliceHandling};
pub use read::{read, read_as, read_with_info};
pub use resample::resample;
pub use sources::{Sources, sources};
pub use volume::{HuStatistics, VolumeInfo, grid_of};
pub use voxel_grid::distance::squared_distance_m2;
