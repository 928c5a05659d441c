//! Scatter by Monte Carlo: the reference rung.
//!
//! Photons leave the source towards the detector. At each collision the scattered radiation that reaches one
//! random point of the detector is added there (forced detection: the collision density estimator of the
//! review by Andreo, Phys. Med. Biol. 36 (1991) 861), for Compton and Rayleigh scattering together;
//! absorption is a weight. Each photon has its own random numbers and each batch of photons its own sum, so
//! the result does not depend on the number of threads.

use counter_random::Key;
use rayon::prelude::*;

use super::interactions::{Coefficients, kept_energy};
use super::phantom::Phantom;
use super::photon::{Numbers, Photon, Site, Tracker};
use crate::carm::CArm;
use crate::error::{DrrError, check_range};
use crate::lane_math;
use crate::vector::{Vec3, cross, dot, norm, scale, sub};

/// Photons are summed in this many batches, whose differences give the standard error.
const BATCHES: u64 = 32;
/// Detector points nearer than this to a collision count as this far away, so that no single collision
/// dominates a pixel.
const NEAREST_M: f64 = 0.01;
/// Key of the photons' random numbers.
const SEED: u64 = 0x5ca7_7e12;

/// Parameters of the Monte Carlo sum.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MonteCarlo {
    /// Photons, 1e3 to 1e10.
    pub photons: f64,
    /// Nodes along the longer side of the detector, 1 to 512.
    pub nodes: usize,
    /// Scatterings of a photon that count: 1 for single scatter only, up to 100.
    pub orders: u32,
}

impl Default for MonteCarlo {
    fn default() -> Self {
        Self { photons: 1e6, nodes: super::NODES, orders: 100 }
    }
}

/// Scattered signal on the nodes of a detector, as a fraction of the open field's signal at the node. The
/// nodes divide the detector into equal parts.
#[derive(Debug, Clone, PartialEq)]
pub struct Estimate {
    /// Nodes along a row.
    pub columns: usize,
    /// Nodes along a column.
    pub rows: usize,
    /// One image per batch, row-major.
    batches: Vec<Vec<f64>>,
}

impl Estimate {
    /// The mean of the batches, row-major.
    pub fn image(&self) -> Vec<f64> {
        let mut mean = vec![0.0; self.columns * self.rows];
        for batch in &self.batches {
            mean.iter_mut().zip(batch).for_each(|(m, b)| *m += b);
        }
        mean.iter_mut().for_each(|m| *m /= self.batches.len() as f64);
        mean
    }

    /// Average over the nodes (column, row) that `counts` selects, and its standard error.
    pub fn average(&self, counts: impl Fn(usize, usize) -> bool) -> (f64, f64) {
        let nodes: Vec<usize> = (0..self.columns * self.rows)
            .filter(|node| counts(node % self.columns, node / self.columns))
            .collect();
        let of = |batch: &Vec<f64>| nodes.iter().map(|n| batch[*n]).sum::<f64>() / nodes.len() as f64;
        let averages: Vec<f64> = self.batches.iter().map(of).collect();
        let count = averages.len() as f64;
        let mean = averages.iter().sum::<f64>() / count;
        let squares: f64 = averages.iter().map(|a| (a - mean) * (a - mean)).sum();
        (mean, (squares / (count * (count - 1.0))).sqrt())
    }
}

/// A C-arm's detector, for photons that are scattered towards it.
struct Target<'a> {
    tracker: Tracker<'a>,
    c_arm: &'a CArm,
    /// Away from the source.
    normal: Vec3,
    source_m: Vec3,
}

impl<'a> Target<'a> {
    fn new(tracker: Tracker<'a>, c_arm: &'a CArm) -> Self {
        let normal = cross(c_arm.row_axis, c_arm.column_axis);
        let away = dot(sub(c_arm.detector_centre_m, c_arm.source_m), normal);
        let normal = if away < 0.0 { scale(normal, -1.0) } else { normal };
        Self { tracker, c_arm, normal, source_m: c_arm.source_m }
    }

    /// A point at these fractions of the detector's width and height.
    fn point_m(&self, across: f64, down: f64) -> Vec3 {
        let place = |share: f64, count: u32| share * f64::from(count) - 0.5;
        self.c_arm.pixel_m(place(across, self.c_arm.columns), place(down, self.c_arm.rows))
    }

    /// Direction from the source to a point of the detector, and the open field's signal there, times a
    /// constant: the cosine of the incidence over the squared distance.
    fn open(&self, point_m: Vec3) -> (Vec3, f64) {
        let line = sub(point_m, self.source_m);
        let distance = norm(line);
        let direction = scale(line, 1.0 / distance);
        (direction, dot(direction, self.normal).max(0.0) / (distance * distance))
    }
}

/// Energy that reaches a point of a plane with this normal from a collision, per unit of area, as a fraction
/// of `source_kev`.
pub(super) fn arriving(
    tracker: &Tracker<'_>,
    photon: &Photon,
    site: &Site,
    (point_m, normal): (Vec3, Vec3),
    source_kev: f64,
) -> f64 {
    let line = sub(point_m, photon.position_m);
    let distance = norm(line);
    let incidence = dot(line, normal) / distance;
    if incidence.is_nan() || incidence <= 0.0 {
        return 0.0;
    }
    let cosine = (dot(line, photon.direction) / distance).clamp(-1.0, 1.0);
    let interactions = tracker.interactions;
    let differential =
        interactions.differential(&site.coefficients, site.fractions, photon.energy_kev, cosine);
    let kept = kept_energy(photon.energy_kev, cosine);
    let after = interactions.at(photon.energy_kev * kept);
    let [water_m, bone_m] = tracker.phantom.lengths_m(photon.position_m, point_m);
    let passed =
        |c: &[Coefficients; 2]| lane_math::exp(-(water_m * c[0].total_per_m + bone_m * c[1].total_per_m));
    let energy =
        kept * differential.incoherent * passed(&after) + differential.coherent * passed(&site.coefficients);
    let nearest = distance.max(NEAREST_M);
    photon.weight * photon.energy_kev / source_kev * energy / site.total_per_m * incidence
        / (nearest * nearest)
}

impl MonteCarlo {
    /// Checks every field.
    ///
    /// # Errors
    /// A field is out of range; the error names the first one.
    pub fn validate(&self) -> Result<(), DrrError> {
        check_range("photons", self.photons, 1e3, 1e10, "1e3 to 1e10")?;
        check_range("nodes", self.nodes as f64, 1.0, 512.0, "1 to 512")?;
        check_range("orders", f64::from(self.orders), 1.0, 100.0, "1 to 100")
    }

    /// Estimates the scatter of a phantom, on the threads of the current pool. `beam` lists energies, 30 to
    /// 120 keV, and the share of the open field's signal that each has.
    ///
    /// # Errors
    /// A field or an energy is out of range.
    pub fn estimate(
        &self,
        phantom: &Phantom,
        c_arm: &CArm,
        beam: &[(f64, f64)],
    ) -> Result<Estimate, DrrError> {
        self.validate()?;
        c_arm.validate()?;
        for (energy_kev, _) in beam {
            check_range("energy_kev", *energy_kev, 30.0, 120.0, "30 to 120 keV")?;
        }
        let (columns, rows) = super::nodes_of(c_arm, self.nodes);
        let target = Target::new(Tracker::new(phantom, self.orders), c_arm);
        let per_batch = (self.photons / BATCHES as f64).ceil() as u64;
        let area_m2 = c_arm.pixels() as f64 * c_arm.pixel_pitch_m[0] * c_arm.pixel_pitch_m[1];
        let scale = area_m2 * (columns * rows) as f64 / per_batch as f64;
        let batch = |batch: u64| {
            let mut image = vec![0.0; columns * rows];
            for number in batch * per_batch..(batch + 1) * per_batch {
                let mut numbers = Numbers::of(Key::of(SEED).and(number));
                let source_kev = drawn_energy(beam, numbers.uniform());
                let aim = target.point_m(numbers.uniform(), numbers.uniform());
                let (direction, open) = target.open(aim);
                let photon =
                    Photon { position_m: c_arm.source_m, direction, energy_kev: source_kev, weight: 1.0 };
                target.tracker.follow(photon, &mut numbers, |photon, site, numbers| {
                    let (across, down) = (numbers.uniform(), numbers.uniform());
                    let point_m = target.point_m(across, down);
                    let energy =
                        arriving(&target.tracker, photon, site, (point_m, target.normal), source_kev);
                    if energy > 0.0 {
                        let node =
                            |share: f64, count: usize| ((share * count as f64) as usize).min(count - 1);
                        image[node(down, rows) * columns + node(across, columns)] +=
                            scale * open * energy / target.open(point_m).1;
                    }
                });
            }
            image
        };
        let batches = (0..BATCHES).into_par_iter().map(batch).collect();
        Ok(Estimate { columns, rows, batches })
    }
}

/// An energy of the beam, by its share of the signal.
fn drawn_energy(beam: &[(f64, f64)], uniform: f64) -> f64 {
    let all: f64 = beam.iter().map(|(_, share)| share).sum();
    let mut left = uniform * all;
    for (energy_kev, share) in beam {
        left -= share;
        if left < 0.0 {
            return *energy_kev;
        }
    }
    beam.last().map_or(0.0, |(energy_kev, _)| *energy_kev)
}
