//! Scattered radiation: what photons that were scattered in the patient add to a frame.
//!
//! A ladder of two rungs: [`MonteCarlo`] follows photons and is the reference; the kernel rung sums Gaussians
//! that were fitted to it. Both give the scattered signal on a coarse grid of nodes over the detector, as a
//! fraction of the open field's signal.

mod interactions;
pub mod kernel;
mod monte_carlo;
mod pencil;
mod phantom;
mod photon;
mod stage;
mod tables;

pub use monte_carlo::{Estimate, MonteCarlo};
pub use pencil::Pencil;
pub use phantom::Phantom;
pub(crate) use stage::{ScatterImage, Stage};

use crate::carm::CArm;

/// Nodes along the longer side of the detector.
const NODES: usize = 64;

/// Columns and rows of nodes, with `most` along the longer side of the detector; never more than pixels.
fn nodes_of(c_arm: &CArm, most: usize) -> (usize, usize) {
    let side_m = [0, 1].map(|i| f64::from([c_arm.columns, c_arm.rows][i]) * c_arm.pixel_pitch_m[i]);
    let longest_m = side_m[0].max(side_m[1]);
    let count = |i: usize, pixels: u32| {
        let wanted = libm::round(most as f64 * side_m[i] / longest_m) as usize;
        wanted.clamp(1, (pixels as usize).min(most))
    };
    (count(0, c_arm.columns), count(1, c_arm.rows))
}
