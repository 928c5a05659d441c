//! CT volumes for the hub: readers, a synthetic femur with known landmarks, and geometry in world LPS.
//!
//! Everything ends as one [`Volume`]: Hounsfield units as `i16`, i fastest, with spacing, origin and direction in the world frame
//! (LPS, metres). Reading never resamples or reorders voxels, it only converts the geometry; [`resample`] is for who asks.

mod dicom_scan;
mod dicom_series;
mod dicom_slice;
mod edt;
mod error;
mod hash;
mod input;
mod mask;
mod metaimage;
mod nifti;
mod nifti_header;
mod nrrd;
mod nrrd_write;
pub mod phantom;
mod read;
mod resample;
mod scalar;
mod text_header;
mod volume;

pub use edt::squared_distance_m2;
pub use error::VolumeError;
pub use hash::{volume_hash, volume_hash_of_parts};
pub use input::DataFiles;
pub use mask::{MaskModel, mask_to_hu};
pub use nrrd_write::write_nrrd;
pub use read::{read, read_where, read_with_info};
pub use resample::resample;
pub use volume::{
    HuStatistics, IDENTITY_DIRECTION, MAX_SPACING_M, MAX_VOXELS, MIN_SPACING_M, ORTHOGONALITY_TOLERANCE,
    Volume, VolumeInfo,
};
