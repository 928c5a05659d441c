//! Bone as voxels: what a sphere touches, and what a burr cuts away.
//!
//! [`Voxels`] is the ground truth: one bit per voxel ("bone": at least the threshold and not removed) and, in
//! sparse blocks from a pool that grows, the fraction of each touched voxel's cutting energy that is already
//! spent. The CT itself stays in shared memory and is borrowed by the calls that need it.
//!
//! [`BoneField`] adds two caches: which voxels are near each sphere of the tool, and which the burr can
//! reach. Both are built from the voxels alone. Every change of a voxel is recorded in a journal; before a
//! cache is used it reads the journal and drops the entries that may be out of date. So a cache decides how
//! fast an answer comes, never what it is.
//!
//! A voxel with spent fraction s holds the fraction 1 - s of its volume: its surface has receded by s voxel
//! widths. Contact and drilling use the same definition of that surface ([`query`], [`drilling`]), so a burr
//! that rests on bone always overlaps the voxels it rests on, and neither the contact nor the drilled depth
//! jumps when a voxel is removed.
//!
//! Only construction, snapshots, [`BoneField::predrill_capsule`] and [`BoneField::make_room`] allocate
//! memory.

mod buried;
pub mod cutting;
mod distance;
pub mod drilling;
mod edge;
mod error;
mod field;
mod gather;
mod grid;
pub mod material;
mod near;
mod occupancy;
mod parameters;
mod patch;
pub mod query;
mod reach;
mod remembered;
pub mod removal;
mod spline;
mod strength;
mod surface;
mod tracked;
mod voxels;
pub mod yielding;

pub use cutting::{Ball, BurrContact, BurrState, CuttingLaw, Work};
pub use distance::Matter;
pub use drilling::GrindReport;
pub use error::BoneError;
pub use field::BoneField;
pub use grid::{GridGeometry, VoxelIndex};
pub use material::MaterialLaw;
pub use parameters::BoneParameters;
pub use query::{ContactBuffer, ContactKind};
pub use removal::Removal;
pub use voxels::{BoneSnapshot, Voxels};
pub use yielding::{CrushReport, Indentation, Pressing};
