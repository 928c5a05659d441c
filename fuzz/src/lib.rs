//! Fuzz targets: every reader of untrusted bytes as a function that must return without a panic, quickly and
//! with little memory, for any bytes. Each function also asserts the reader's other guarantees.
//!
//! `tests/stable.rs` runs them with stable Rust on the stored corpus and on mutated seeds; `libfuzzer/` runs
//! them under libFuzzer. See `fuzz/README.md`.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a tool of tests: a panic is a finding"
)]

pub mod client_message;
pub mod fmu;
pub mod keyframe;
pub mod log;
pub mod measurements;
pub mod mesh;
pub mod openigtlink;
pub mod plan;
pub mod seeds;
pub mod settings;
pub mod urdf;
pub mod viewer;
pub mod volume;

/// A reader of untrusted bytes.
pub struct Target {
    /// Name of the target and of its corpus archive.
    pub name: &'static str,
    /// Reads the bytes.
    pub run: fn(&[u8]),
    /// Returns small valid inputs, created by the project's own writers.
    pub seeds: fn() -> Vec<Vec<u8>>,
}

/// All targets.
pub const TARGETS: &[Target] = &[
    Target { name: "log", run: log::log, seeds: seeds::logs },
    Target { name: "chunk_content", run: log::chunk_content, seeds: seeds::chunks },
    Target { name: "scene", run: settings::scene, seeds: seeds::scenes },
    Target { name: "settings", run: settings::settings, seeds: seeds::settings },
    Target { name: "keyframe", run: keyframe::keyframe, seeds: keyframe::seeds },
    Target { name: "client_message", run: client_message::client_message, seeds: client_message::seeds },
    Target { name: "viewer", run: viewer::viewer, seeds: viewer::seeds },
    Target { name: "nifti", run: volume::nifti, seeds: seeds::nifti },
    Target { name: "nrrd", run: volume::nrrd, seeds: seeds::nrrd },
    Target { name: "metaimage", run: volume::metaimage, seeds: seeds::metaimage },
    Target { name: "dicom", run: volume::dicom, seeds: seeds::dicom },
    Target { name: "plan", run: plan::plan, seeds: plan::seeds },
    Target { name: "urdf", run: urdf::urdf, seeds: urdf::seeds },
    Target { name: "fmu", run: fmu::fmu, seeds: fmu::seeds },
    Target { name: "mesh", run: mesh::mesh, seeds: mesh::seeds },
    Target { name: "measurements", run: measurements::measurements, seeds: measurements::seeds },
    Target { name: "openigtlink", run: openigtlink::openigtlink, seeds: openigtlink::seeds },
];
