//! A reference phantom for accuracy tests: ellipsoids with closed-form line integrals, and their voxels.

use rayon::prelude::*;

use crate::grid::Grid;
use crate::ray::WorldRay;

/// An ellipsoid along the world axes that adds Hounsfield units to whatever it overlaps; the surroundings are
/// air (-1000 HU).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ellipsoid {
    /// Centre.
    pub centre_m: [f64; 3],
    /// Half axes.
    pub semi_axes_m: [f64; 3],
    /// Hounsfield units that it adds.
    pub added_hu: f64,
}

impl Ellipsoid {
    /// Length of the chord that the ray's line cuts.
    pub fn chord_m(&self, ray: &WorldRay) -> f64 {
        // In space scaled by the half axes, the ellipsoid is the unit sphere.
        let [mut oo, mut od, mut dd] = [0.0; 3];
        for axis in 0..3 {
            let o = (ray.origin_m[axis] - self.centre_m[axis]) / self.semi_axes_m[axis];
            let d = ray.direction_m[axis] / self.semi_axes_m[axis];
            oo += o * o;
            od += o * d;
            dd += d * d;
        }
        let discriminant = od * od - dd * (oo - 1.0);
        if discriminant > 0.0 { 2.0 * discriminant.sqrt() / dd * ray.length_m } else { 0.0 }
    }

    /// Returns true if a point lies inside.
    pub fn contains(&self, p: [f64; 3]) -> bool {
        let scaled = |axis: usize| (p[axis] - self.centre_m[axis]) / self.semi_axes_m[axis];
        let [x, y, z] = [scaled(0), scaled(1), scaled(2)];
        x * x + y * y + z * z < 1.0
    }
}

/// A thigh about the world origin: soft tissue, femoral head and shaft with cortical shells and softer
/// interiors. At `size` 1 it fills a box of 240 x 200 x 320 mm.
pub fn thigh(size: f64) -> Vec<Ellipsoid> {
    let ellipsoid = |centre_mm: [f64; 3], semi_axes_mm: [f64; 3], added_hu: f64| Ellipsoid {
        centre_m: centre_mm.map(|x| x * size * 1e-3),
        semi_axes_m: semi_axes_mm.map(|x| x * size * 1e-3),
        added_hu,
    };
    vec![
        ellipsoid([0.0, 0.0, 0.0], [95.0, 80.0, 230.0], 1040.0),
        ellipsoid([30.0, 0.0, 80.0], [24.0, 24.0, 24.0], 700.0),
        ellipsoid([30.0, 0.0, 80.0], [22.5, 22.5, 22.5], -450.0),
        ellipsoid([-20.0, 0.0, -40.0], [15.0, 15.0, 110.0], 1100.0),
        ellipsoid([-20.0, 0.0, -40.0], [10.0, 10.0, 104.0], -950.0),
    ]
}

/// Hounsfield units of the ellipsoids on a grid, x fastest; each voxel is the mean of `samples`^3 points
/// (partial volume).
pub fn voxelise(grid: &Grid, shapes: &[Ellipsoid], samples: usize) -> Vec<i16> {
    let offsets: Vec<f64> = (0..samples).map(|i| (i as f64 + 0.5) / samples as f64 - 0.5).collect();
    let count = (samples * samples * samples) as f64;
    (0..grid.voxels())
        .into_par_iter()
        .map(|linear| {
            let centre = grid.voxel_of(linear).map(|v| v as f64);
            let mut sum = 0.0;
            for z in &offsets {
                for y in &offsets {
                    for x in &offsets {
                        let p = grid.index_to_world([centre[0] + x, centre[1] + y, centre[2] + z]);
                        sum += shapes.iter().filter(|s| s.contains(p)).map(|s| s.added_hu).sum::<f64>();
                    }
                }
            }
            libm::round(-1000.0 + sum / count) as i16
        })
        .collect()
}

/// Line integral of the ellipsoids, with the inverse Hounsfield definition (`mu = mu_water (1 + HU/1000)`).
pub fn line_integral(shapes: &[Ellipsoid], ray: &WorldRay, mu_water_per_m: f64) -> f64 {
    shapes.iter().map(|s| mu_water_per_m * s.added_hu / 1000.0 * s.chord_m(ray)).sum()
}

/// Root mean square of `values - truth` over that of `truth`.
pub fn relative_rms(values: &[f64], truth: &[f64]) -> f64 {
    let difference: f64 = values.iter().zip(truth).map(|(a, b)| (a - b) * (a - b)).sum();
    (difference / truth.iter().map(|b| b * b).sum::<f64>()).sqrt()
}
