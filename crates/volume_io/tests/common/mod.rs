//! Small hand-built files, and the location of the shared data.

#![allow(clippy::unwrap_used, reason = "a file that cannot be written is a failed test")]

pub mod dicom_bytes;
pub mod nifti_bytes;
pub mod shared_data;

use std::io::Write;
use std::path::PathBuf;
use tempfile::TempDir;
use volume_io::{VolumeError, read};
use voxel_grid::Volume;

use dicom_bytes::{DicomSlice, write_series};

/// Writes a file in its own folder.
pub fn store(name: &str, bytes: &[u8]) -> (TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    std::fs::write(&path, bytes).unwrap();
    (folder, path)
}

pub fn read_bytes(name: &str, bytes: &[u8]) -> Result<Volume, VolumeError> {
    let (_folder, path) = store(name, bytes);
    read(path)
}

/// Writes a series in its own folder.
pub fn series(slices: &[DicomSlice]) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    write_series(folder.path(), slices);
    folder
}

pub fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    encoder.write_all(bytes).unwrap();
    encoder.finish().unwrap()
}

pub fn near(a: &[f64], b: &[f64], tolerance: f64) {
    let is_near = a.len() == b.len() && a.iter().zip(b).all(|(x, y)| (x - y).abs() <= tolerance);
    assert!(is_near, "{a:?} is not {b:?} within {tolerance}");
}
