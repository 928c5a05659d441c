//! A phantom for accuracy tests: ellipsoids and cylinders with closed-form line integrals, and their voxels.

use markups::vector::{dot, length, minus, plus};
use rayon::prelude::*;
use xray::ray::WorldRay;
use xray::reference::Ellipsoid;
use xray::{FrameSeed, Grid};

/// A shape of [`Phantom`]; adds Hounsfield units wherever it overlaps others.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Solid {
    /// Ellipsoid with axes along the world axes.
    Ellipsoid(Ellipsoid),
    /// Cylinder with flat ends.
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

    /// Returns the length of the ray's chord through the shape.
    pub fn chord_m(&self, ray: &WorldRay) -> f64 {
        let (centre_m, half, radius_m) = match *self {
            Self::Ellipsoid(e) => return e.chord_m(ray),
            Self::Cylinder { centre_m, half_axis_m, radius_m, .. } => (centre_m, half_axis_m, radius_m),
        };
        let half_length = length(half);
        let axis = half.map(|x| x * (1.0 / half_length));
        // Measured from the point of the line closest to the centre, to avoid cancellation.
        let d = ray.direction_m.map(|x| x * (1.0 / ray.length_m));
        let o = minus(ray.origin_m, centre_m);
        let o = plus(o, -dot(o, d), d);
        let (oz, dz) = (dot(o, axis), dot(d, axis));
        let (ox, dx) = (plus(o, -oz, axis), plus(d, -dz, axis));
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

    fn contains(&self, p: [f64; 3]) -> bool {
        match self {
            Self::Ellipsoid(e) => e.contains(p),
            Self::Cylinder { centre_m, half_axis_m, radius_m, .. } => {
                let q = minus(p, *centre_m);
                let half_m = length(*half_axis_m);
                let z = dot(q, *half_axis_m) / half_m;
                z.abs() < half_m && dot(q, q) - z * z < radius_m * radius_m
            }
        }
    }

    fn centre_m(&self) -> [f64; 3] {
        match self {
            Self::Ellipsoid(e) => e.centre_m,
            Self::Cylinder { centre_m, .. } => *centre_m,
        }
    }

    /// Half extents of the bounding box along the world axes.
    fn reach_m(&self) -> [f64; 3] {
        match self {
            Self::Ellipsoid(e) => e.semi_axes_m,
            Self::Cylinder { half_axis_m, radius_m, .. } => half_axis_m.map(|h| h.abs() + radius_m),
        }
    }

    /// Whether a ball around a point is inside; `None` if the surface may intersect it.
    fn holds_ball(&self, p: [f64; 3], radius: f64) -> Option<bool> {
        let q = minus(p, self.centre_m());
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
                let half_m = length(*half_axis_m);
                let z = dot(q, *half_axis_m) / half_m;
                let across = (dot(q, q) - z * z).max(0.0).sqrt();
                if z.abs() - radius > half_m || across - radius > *radius_m {
                    Some(false)
                } else if z.abs() + radius < half_m && across + radius < *radius_m {
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
    /// A pelvis-like phantom in a box of 256 x 256 x 200 mm: a body, a shell, a femoral head and neck, a
    /// hollow oblique shaft, 80 small ellipsoids (trabeculae) and a row of beads, placed by a seeded hash.
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

    /// Returns the line integral, with the inverse Hounsfield definition (`mu = mu_water (1 + HU/1000)`).
    pub fn line_integral(&self, ray: &WorldRay, mu_water_per_m: f64) -> f64 {
        self.solids.iter().map(|s| mu_water_per_m * s.added_hu() / 1000.0 * s.chord_m(ray)).sum()
    }

    /// Returns Hounsfield units on a grid along the world axes, x fastest; a voxel intersected by a surface
    /// is the mean of `samples`^3 points.
    pub fn voxelise(&self, grid: &Grid, samples: usize) -> Vec<i16> {
        let (dims, spacing) = (grid.dims(), grid.spacing_m());
        let mut hu = vec![-1000_i16; grid.voxels()];
        hu.par_chunks_mut(dims[0] * dims[1]).enumerate().for_each(|(k, slice)| {
            let mut sum = vec![-1000.0_f32; slice.len()];
            for solid in &self.solids {
                add_to_slice(solid, grid, k, samples, spacing, &mut sum);
            }
            for (out, value) in slice.iter_mut().zip(&sum) {
                *out = value.round() as i16;
            }
        });
        hu
    }
}

fn add_to_slice(solid: &Solid, grid: &Grid, k: usize, samples: usize, spacing: [f64; 3], sum: &mut [f32]) {
    let dims = grid.dims();
    let (centre, reach) = (solid.centre_m(), solid.reach_m());
    let centre = grid.world_to_index(centre);
    let range = |axis: usize| {
        let half = reach[axis] / spacing[axis] + 1.0;
        let first = (centre[axis] - half).floor().max(0.0) as usize;
        first..((centre[axis] + half).ceil().max(0.0) as usize + 1).min(dims[axis])
    };
    if !range(2).contains(&k) {
        return;
    }
    let ball = 0.5 * length(spacing);
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

/// Returns the fraction of a voxel's `samples`^3 points that are inside.
fn share_inside(solid: &Solid, centre: [f64; 3], spacing: [f64; 3], samples: usize) -> f64 {
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
