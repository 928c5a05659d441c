//! Reference phantoms for accuracy tests: ellipsoids and cylinders with closed-form line integrals, and their voxels.

use rayon::prelude::*;

use crate::detector::FrameSeed;
use crate::grid::Grid;
use crate::ray::WorldRay;
use crate::vector::{Vec3, add_scaled, dot, norm, scale, sub};

/// An ellipsoid along the world axes that adds Hounsfield units to whatever it overlaps; the surroundings are air (-1000 HU).
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

    fn contains(&self, p: [f64; 3]) -> bool {
        let scaled = |axis: usize| (p[axis] - self.centre_m[axis]) / self.semi_axes_m[axis];
        let [x, y, z] = [scaled(0), scaled(1), scaled(2)];
        x * x + y * y + z * z < 1.0
    }
}

/// A thigh about the world origin: soft tissue, femoral head and shaft with cortical shells and softer interiors. At `size` 1 it fills a
/// box of 240 x 200 x 320 mm.
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

/// Hounsfield units of the ellipsoids on a grid, x fastest; each voxel is the mean of `samples`^3 points (partial volume).
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

/// A shape of [`Phantom`]: adds Hounsfield units to whatever it overlaps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Solid {
    /// Along the world axes.
    Ellipsoid(Ellipsoid),
    /// With flat ends.
    Cylinder {
        /// Centre.
        centre_m: [f64; 3],
        /// Half of its length along its axis, as a vector.
        half_axis_m: [f64; 3],
        /// Radius.
        radius_m: f64,
        /// Hounsfield units that it adds.
        added_hu: f64,
    },
}

impl Solid {
    fn added_hu(&self) -> f64 {
        match self {
            Self::Ellipsoid(e) => e.added_hu,
            Self::Cylinder { added_hu, .. } => *added_hu,
        }
    }

    /// Length of the chord that the ray's line cuts.
    pub fn chord_m(&self, ray: &WorldRay) -> f64 {
        let (centre_m, half, radius_m) = match *self {
            Self::Ellipsoid(e) => return e.chord_m(ray),
            Self::Cylinder { centre_m, half_axis_m, radius_m, .. } => (centre_m, half_axis_m, radius_m),
        };
        let half_length = norm(half);
        let axis = scale(half, 1.0 / half_length);
        // Measured from the point of the line closest to the centre, to avoid cancellation.
        let d = scale(ray.direction_m, 1.0 / ray.length_m);
        let o = sub(ray.origin_m, centre_m);
        let o = add_scaled(o, -dot(o, d), d);
        let (oz, dz) = (dot(o, axis), dot(d, axis));
        let (ox, dx) = (add_scaled(o, -oz, axis), add_scaled(d, -dz, axis));
        let (a, b, c) = (dot(dx, dx), dot(ox, dx), dot(ox, ox) - radius_m * radius_m);
        let caps = if dz.abs() < 1e-12 {
            if oz.abs() > half_length {
                return 0.0;
            }
            (f64::NEG_INFINITY, f64::INFINITY)
        } else {
            let (p, q) = ((-half_length - oz) / dz, (half_length - oz) / dz);
            (p.min(q), p.max(q))
        };
        let mantle = if a < 1e-20 {
            if c > 0.0 {
                return 0.0;
            }
            (f64::NEG_INFINITY, f64::INFINITY)
        } else {
            let discriminant = b * b - a * c;
            if discriminant <= 0.0 {
                return 0.0;
            }
            ((-b - discriminant.sqrt()) / a, (-b + discriminant.sqrt()) / a)
        };
        (caps.1.min(mantle.1) - caps.0.max(mantle.0)).max(0.0)
    }

    fn contains(&self, p: Vec3) -> bool {
        match self {
            Self::Ellipsoid(e) => e.contains(p),
            Self::Cylinder { centre_m, half_axis_m, radius_m, .. } => {
                let q = sub(p, *centre_m);
                let length = norm(*half_axis_m);
                let z = dot(q, *half_axis_m) / length;
                z.abs() < length && dot(q, q) - z * z < radius_m * radius_m
            }
        }
    }

    fn centre_m(&self) -> Vec3 {
        match self {
            Self::Ellipsoid(e) => e.centre_m,
            Self::Cylinder { centre_m, .. } => *centre_m,
        }
    }

    /// Half extents of the bounding box along the world axes.
    fn reach_m(&self) -> Vec3 {
        match self {
            Self::Ellipsoid(e) => e.semi_axes_m,
            Self::Cylinder { half_axis_m, radius_m, .. } => half_axis_m.map(|h| h.abs() + radius_m),
        }
    }

    /// True if a ball about a point is inside; `None` if the surface may intersect it.
    fn holds_ball(&self, p: Vec3, radius: f64) -> Option<bool> {
        let q = sub(p, self.centre_m());
        match self {
            Self::Ellipsoid(e) => {
                // |q / s| changes by at most 1 / min(s) per metre.
                let scaled: f64 =
                    (0..3).map(|i| (q[i] / e.semi_axes_m[i]) * (q[i] / e.semi_axes_m[i])).sum::<f64>().sqrt();
                let slack = radius / e.semi_axes_m.into_iter().fold(f64::INFINITY, f64::min);
                if scaled - slack > 1.0 {
                    Some(false)
                } else if scaled + slack < 1.0 {
                    Some(true)
                } else {
                    None
                }
            }
            Self::Cylinder { half_axis_m, radius_m, .. } => {
                let length = norm(*half_axis_m);
                let z = dot(q, *half_axis_m) / length;
                let across = (dot(q, q) - z * z).max(0.0).sqrt();
                if z.abs() - radius > length || across - radius > *radius_m {
                    Some(false)
                } else if z.abs() + radius < length && across + radius < *radius_m {
                    Some(true)
                } else {
                    None
                }
            }
        }
    }
}

/// Ellipsoids and cylinders about the world origin with closed-form line integrals.
#[derive(Debug, Clone, PartialEq)]
pub struct Phantom {
    /// The shapes; they add up.
    pub solids: Vec<Solid>,
}

impl Phantom {
    /// A pelvis-like phantom in a box of 256 x 256 x 200 mm: a body, a shell, a femoral head and neck, a hollow oblique shaft, 80 small
    /// ellipsoids (trabeculae) and a row of beads, placed by a seeded hash.
    pub fn pelvis(seed: u64) -> Self {
        let ellipsoid = |centre: [f64; 3], semi: [f64; 3], added_hu: f64| {
            let mm = |v: [f64; 3]| v.map(|x| x * 1e-3);
            Solid::Ellipsoid(Ellipsoid { centre_m: mm(centre), semi_axes_m: mm(semi), added_hu })
        };
        let cylinder = |centre: [f64; 3], half: [f64; 3], radius_mm: f64, added_hu: f64| Solid::Cylinder {
            centre_m: centre.map(|x| x * 1e-3),
            half_axis_m: half.map(|x| x * 1e-3),
            radius_m: radius_mm * 1e-3,
            added_hu,
        };
        let mut solids = vec![
            ellipsoid([0.0, 5.0, 0.0], [105.0, 75.0, 94.0], 1040.0),
            ellipsoid([-30.0, 10.0, 30.0], [48.0, 40.0, 50.0], 500.0),
            ellipsoid([-30.0, 10.0, 30.0], [43.0, 35.0, 45.0], -420.0),
            ellipsoid([40.0, 0.0, 25.0], [24.0, 24.0, 24.0], 700.0),
            ellipsoid([40.0, 0.0, 25.0], [22.0, 22.0, 22.0], -400.0),
            cylinder([52.0, 0.0, 8.0], [12.0, 2.0, -14.0], 11.0, 500.0),
            cylinder([62.0, 4.0, -42.0], [6.0, 3.0, -40.0], 14.0, 1200.0),
            cylinder([62.0, 4.0, -42.0], [6.0, 3.0, -39.0], 8.0, -1000.0),
        ];
        let random = |i: u64| (FrameSeed { seed, frame: 1 }.hash(i) >> 11) as f64 / (1_u64 << 53) as f64;
        for i in 0..80_u64 {
            let r = |k: u64| random(16 * i + k);
            let centre = [-30.0, 10.0, 30.0];
            let spread = [34.0, 26.0, 36.0];
            let at = [0, 1, 2].map(|a| centre[a] + spread[a] * (2.0 * r(a as u64) - 1.0) * 0.7);
            let semi = [3, 4, 5].map(|k| 1.5 + 3.0 * r(k));
            solids.push(ellipsoid(at, semi, 150.0 + 250.0 * r(6)));
        }
        for i in 0..10 {
            solids.push(ellipsoid([-70.0 + 14.0 * f64::from(i), -40.0, -50.0], [1.5; 3], 1200.0));
        }
        Self { solids }
    }

    /// Line integral, with the inverse Hounsfield definition (`mu = mu_water (1 + HU/1000)`).
    pub fn line_integral(&self, ray: &WorldRay, mu_water_per_m: f64) -> f64 {
        self.solids.iter().map(|s| mu_water_per_m * s.added_hu() / 1000.0 * s.chord_m(ray)).sum()
    }

    /// Hounsfield units on a grid along the world axes, x fastest; a voxel that a surface intersects is the mean of `samples`^3 points.
    pub fn voxelise(&self, grid: &Grid, samples: usize) -> Vec<i16> {
        let (dims, spacing) = (grid.dims(), grid.spacing_m());
        let mut hu = vec![-1000_i16; grid.voxels()];
        hu.par_chunks_mut(dims[0] * dims[1]).enumerate().for_each(|(k, slice)| {
            let mut sum = vec![-1000.0_f32; slice.len()];
            for solid in &self.solids {
                add_to_slice(solid, grid, k, samples, spacing, &mut sum);
            }
            for (out, value) in slice.iter_mut().zip(&sum) {
                *out = libm::roundf(*value) as i16;
            }
        });
        hu
    }
}

fn add_to_slice(solid: &Solid, grid: &Grid, k: usize, samples: usize, spacing: Vec3, sum: &mut [f32]) {
    let dims = grid.dims();
    let (centre, reach) = (solid.centre_m(), solid.reach_m());
    let centre = grid.world_to_index(centre);
    let range = |axis: usize| {
        let half = reach[axis] / spacing[axis] + 1.0;
        let first = libm::floor(centre[axis] - half).max(0.0) as usize;
        first..(libm::ceil(centre[axis] + half).max(0.0) as usize + 1).min(dims[axis])
    };
    if !range(2).contains(&k) {
        return;
    }
    let ball = 0.5 * norm(spacing);
    for j in range(1) {
        for i in range(0) {
            let p = grid.index_to_world([i as f64, j as f64, k as f64]);
            let share = match solid.holds_ball(p, ball) {
                Some(inside) => f64::from(u8::from(inside)),
                None => share_inside(solid, p, spacing, samples),
            };
            sum[j * dims[0] + i] += (share * solid.added_hu()) as f32;
        }
    }
}

/// Fraction of a voxel's `samples`^3 points that lie inside.
fn share_inside(solid: &Solid, centre: Vec3, spacing: Vec3, samples: usize) -> f64 {
    let offset = |i: usize, axis: usize| ((i as f64 + 0.5) / samples as f64 - 0.5) * spacing[axis];
    let mut count = 0_u32;
    for z in 0..samples {
        for y in 0..samples {
            for x in 0..samples {
                let p = [centre[0] + offset(x, 0), centre[1] + offset(y, 1), centre[2] + offset(z, 2)];
                count += u32::from(solid.contains(p));
            }
        }
    }
    f64::from(count) / (samples * samples * samples) as f64
}

/// Root mean square of `values - truth` over that of `truth`.
pub fn relative_rms(values: &[f64], truth: &[f64]) -> f64 {
    let difference: f64 = values.iter().zip(truth).map(|(a, b)| (a - b) * (a - b)).sum();
    (difference / truth.iter().map(|b| b * b).sum::<f64>()).sqrt()
}
