//! Small files built by hand, and where the shared data lie.

#![allow(clippy::unwrap_used, reason = "a file that cannot be written is a failed test")]

pub mod dicom_bytes;
pub mod nifti_bytes;
pub mod shared_data;
