//! Scatter of one thin beam behind a slab of water, to which the kernels are fitted.

use counter_random::Key;
use rayon::prelude::*;

use super::monte_carlo::arriving;
use super::phantom::Phantom;
use super::photon::{Numbers, Photon, Tracker};
use crate::error::{DrrError, check_range};
use crate::grid::Grid;

/// Side of the slab.
const SIDE_M: f64 = 4.0;
/// Cells across the slab, and through it.
const CELLS: [usize; 3] = [40, 40, 8];
/// Photons summed together.
const BATCHES: u64 = 32;
const SEED: u64 = 0x5ca7_7e13;

/// A thin beam that crosses a slab of water at right angles, and a detector parallel to the slab.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pencil {
    /// Photon energy, 30 to 120 keV.
    pub energy_kev: f64,
    /// Thickness of the slab, 1 mm to 0.8 m.
    pub thickness_m: f64,
    /// From the slab's far face to the detector, 0 to 5 m.
    pub gap_m: f64,
}

impl Pencil {
    /// Scattered energy per square metre of the detector, as a fraction of the beam's energy: the average
    /// over each ring of `rings` equal widths within `radius_m` of the beam's axis.
    ///
    /// # Errors
    /// A field is out of range.
    pub fn kernel_per_m2(&self, radius_m: f64, rings: usize, photons: u64) -> Result<Vec<f64>, DrrError> {
        let Self { energy_kev, thickness_m, gap_m } = *self;
        check_range("energy_kev", energy_kev, 30.0, 120.0, "30 to 120 keV")?;
        check_range("thickness_m", thickness_m, 1e-3, 0.8, "0.001 to 0.8 m")?;
        check_range("gap_m", gap_m, 0.0, 5.0, "0 to 5 m")?;
        let [across, _, through] = CELLS.map(|n| n as f64);
        let spacing_m = [SIDE_M / across, SIDE_M / across, thickness_m / through];
        let grid = Grid::centred(CELLS, spacing_m)?;
        let phantom = Phantom::new(grid, vec![[1.0, 0.0]; grid.voxels()])?;
        let tracker = Tracker::new(&phantom, 100);
        let (normal, detector_m) = ([0.0, 0.0, 1.0], thickness_m / 2.0 + gap_m);
        let per_batch = photons.div_ceil(BATCHES);
        let width_m = radius_m / rings as f64;
        let batch = |batch: u64| {
            let mut sums = vec![0.0; rings];
            for number in batch * per_batch..(batch + 1) * per_batch {
                let mut numbers = Numbers::of(Key::of(SEED).and(number));
                let position_m = [0.0, 0.0, -thickness_m];
                let photon = Photon { position_m, direction: normal, energy_kev, weight: 1.0 };
                tracker.follow(photon, &mut numbers, |photon, site, numbers| {
                    let (share, turn) = (numbers.uniform(), numbers.uniform());
                    let (s, c) = libm::sincos(core::f64::consts::TAU * turn);
                    let r_m = share * radius_m;
                    let point_m = [r_m * c, r_m * s, detector_m];
                    let energy = arriving(&tracker, photon, site, (point_m, normal), energy_kev);
                    // Points are uniform in radius, so a ring's mean over its area weights them by it.
                    let ring = ((share * rings as f64) as usize).min(rings - 1);
                    let middle_m = (ring as f64 + 0.5) * width_m;
                    sums[ring] += energy * r_m / middle_m * rings as f64;
                });
            }
            sums
        };
        let batches: Vec<Vec<f64>> = (0..BATCHES).into_par_iter().map(batch).collect();
        let total = |ring: usize| batches.iter().map(|sums| sums[ring]).sum::<f64>();
        Ok((0..rings).map(|ring| total(ring) / (per_batch * BATCHES) as f64).collect())
    }
}
