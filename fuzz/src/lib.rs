//! What a fuzzer runs: every reader of foreign bytes as a function of bytes that must end without a panic,
//! without much memory and soon, whatever the bytes are. Each function checks what must hold besides.
//!
//! `tests/stable.rs` runs them with stable Rust over the kept corpus and over mutated seeds; `libfuzzer/`
//! runs them under libFuzzer. See `fuzz/README.md`.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a tool of tests: a panic is a finding"
)]

pub mod client_message;
pub mod keyframe;
pub mod log;
pub mod mesh;
pub mod openigtlink;
pub mod plan;
pub mod seeds;
pub mod settings;
pub mod urdf;
pub mod viewer;
pub mod volume;

/// A reader of foreign bytes.
pub struct Target {
    /// Its name: of its corpus folder too.
    pub name: &'static str,
    /// Reads the bytes.
    pub run: fn(&[u8]),
    /// Small valid inputs, made by the project's own writers.
    pub seeds: fn() -> Vec<Vec<u8>>,
}

/// All of them.
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
    Target { name: "mesh", run: mesh::mesh, seeds: mesh::seeds },
    Target { name: "openigtlink", run: openigtlink::openigtlink, seeds: openigtlink::seeds },
];
