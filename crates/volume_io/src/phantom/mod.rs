//! Synthetic volumes with exactly known geometry: a right proximal femur, a pelvis, a two-density block, a
//! sphere.
//!
//! None of them depicts a patient. They are pure functions of their specification: bitwise identical on every
//! machine and for every number of threads, with the same shape at every voxel spacing.

mod anatomy;
mod femur;
mod fill;
mod noise;
mod pelvis;
mod shapes;
mod solids;

pub use femur::{FemurLandmarks, FemurSpec, femur, femur_landmarks};
pub use pelvis::{PelvisSpec, pelvis};
pub use solids::{BlockSpec, SphereSpec, block, sphere};
