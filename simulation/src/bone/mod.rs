//! Bone as a voxel field: what a sphere touches, and what a burr takes away.
//!
//! The CT stays where it is (shared memory) and is lent to the calls that need it. The field keeps one bit a voxel
//! ("bone": at least the threshold and not removed) and, in sparse blocks from a fixed pool, the fraction of each touched
//! voxel's cutting energy that is already spent.
//!
//! A voxel with spent fraction s holds the fraction 1 - s of its volume: its surface has receded by s voxel widths. Contact
//! and drilling use the same measure of where that surface is ([`query`], [`drilling`]), so a burr that rests on bone always
//! overlaps what it rests on, and neither the contact nor the drilled depth jumps when a voxel vanishes.
//!
//! Nothing here allocates after construction, except snapshots, `predrill_capsule` and construction itself.

mod buried;
pub mod drilling;
mod error;
mod field;
mod gather;
mod grid;
pub mod material;
mod near;
mod occupancy;
mod parameters;
pub mod query;
mod reach;
mod remembered;
pub mod removal;
mod spline;
mod strength;
mod surface;
mod tracked;
mod voxels;

pub use drilling::{BurrState, CuttingLaw, GrindReport};
pub use error::BoneError;
pub use field::BoneField;
pub use grid::{GridGeometry, VoxelIndex};
pub use material::MaterialLaw;
pub use parameters::BoneParameters;
pub use query::{ContactBuffer, ContactKind};
pub use removal::Removal;
pub use voxels::{BoneSnapshot, Voxels};
