//! X-ray images for the command line: pose files and image files.

pub mod dicom;
pub mod files;
pub mod poses;
pub mod series;
