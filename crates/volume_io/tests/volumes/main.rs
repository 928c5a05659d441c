//! Tests of volume readers and writers in one program, which is linked once and shares both cores.

#[path = "../common/mod.rs"]
mod common;

mod clinics;
mod conformance;
mod foreign_dicom;
mod foreign_headers;
mod formats;
mod grey;
mod jpeg2000;
mod mask;
mod mutation;
mod nifti_write;
mod phantom;
mod refusals;
mod strangers;
mod variants;
