//! Voxel model of bone: contact of spheres and cutting by a burr.
//!
//! [`Voxels`] is the ground truth: one bit per voxel ("bone": at least the threshold and not removed) and, in
//! sparse blocks from a growing pool, the fraction of each touched voxel's cutting energy that is already
//! spent. The CT itself stays in shared memory and is borrowed by the calls that need it.
//!
//! [`BoneField`] adds two caches: which voxels are near each sphere of the tool, and which the burr can
//! reach. Both are built from the voxels alone. Every change of a voxel is recorded in a journal; before use,
//! a cache reads the journal and drops entries that may be out of date. A cache thus affects the speed of a
//! query, never its result.
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
mod outer_surface;
mod outside;
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
pub mod twist_drill;
mod voxels;
pub mod yielding;

pub use cutting::{Ball, BurrContact, BurrState, CuttingLaw, TickLoads};
pub use distance::VoxelKind;
pub use drilling::GrindReport;
pub use error::BoneError;
pub use field::BoneField;
pub use grid::{GridGeometry, VoxelIndex};
pub use material::MaterialLaw;
pub use outer_surface::{Entry, OuterSurface};
pub use outside::Outside;
pub use parameters::BoneParameters;
pub use query::{ContactBuffer, ContactKind};
pub use removal::Removal;
pub use voxels::{BoneSnapshot, Voxels};
pub use yielding::{CrushReport, Indentation, Pressing};
