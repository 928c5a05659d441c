//! Readers and writers of volumes, in one program: it is linked once, and its tests share both cores.

#[path = "../common/mod.rs"]
mod common;

mod clinics;
mod conformance;
mod formats;
mod jpeg2000;
mod mask;
mod mutation;
mod nifti_write;
mod phantom;
mod refusals;
mod strangers;
mod variants;
