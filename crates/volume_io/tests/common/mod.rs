//! Small hand-built files, and the location of the shared data.

#![allow(clippy::unwrap_used, reason = "a file that cannot be written is a failed test")]

pub mod dicom_bytes;
pub mod nifti_bytes;
pub mod shared_data;
