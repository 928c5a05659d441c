//! Implicit surfaces: functions that are negative inside, positive outside, and close to the distance near
//! the surface.
//!
//! Lengths are in millimetres here, like every number of the anatomy. Sphere and capsule are exact; the
//! ellipsoid and the elliptic tube use the first-order distance k0 (k0 − 1) / k1 (I. Quilez, "distance
//! functions": value over gradient length), which has the exact zero set; the smooth union is Quilez's
//! quadratic blend.

use crate::volume::{cross, dot, norm};

/// a − b.
pub fn sub(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

/// a + s b.
pub fn add_scaled(a: [f64; 3], s: f64, b: [f64; 3]) -> [f64; 3] {
    [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]]
}

/// Linear ramp from 0 at `from` to 1 at `to`, smoothed with 3t² − 2t³. `from` may be larger than `to`.
pub fn smoothstep(from: f64, to: f64, x: f64) -> f64 {
    let t = ((x - from) / (to - from)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// Union of two shapes, with the edge rounded over the distance `k`.
pub fn smooth_union(a: f64, b: f64, k: f64) -> f64 {
    let h = (k - (a - b).abs()).max(0.0) / k;
    a.min(b) - h * h * k * 0.25
}

/// Distance to a sphere.
pub fn sphere(p: [f64; 3], center: [f64; 3], radius: f64) -> f64 {
    norm(sub(p, center)) - radius
}

/// A capsule from `a` to `b` whose radius changes linearly from `radius_a` to `radius_b`.
pub fn tapered_capsule(p: [f64; 3], a: [f64; 3], b: [f64; 3], radius_a: f64, radius_b: f64) -> f64 {
    let axis = sub(b, a);
    let t = (dot(sub(p, a), axis) / dot(axis, axis)).clamp(0.0, 1.0);
    norm(sub(p, add_scaled(a, t, axis))) - (radius_a + (radius_b - radius_a) * t)
}

/// Distance to a flat triangle: exact (I. Quilez, "distance functions": to its edges, or to its plane above
/// its face).
pub fn triangle(p: [f64; 3], a: [f64; 3], b: [f64; 3], c: [f64; 3]) -> f64 {
    let edges = [(a, b), (b, c), (c, a)];
    let normal = cross(sub(b, a), sub(a, c));
    let is_over =
        |(from, to): &([f64; 3], [f64; 3])| dot(cross(sub(*to, *from), normal), sub(p, *from)) >= 0.0;
    if edges.iter().all(is_over) {
        return dot(normal, sub(p, a)).abs() / norm(normal);
    }
    edges.iter().map(|(from, to)| tapered_capsule(p, *from, *to, 0.0, 0.0)).fold(f64::INFINITY, f64::min)
}

/// An ellipsoid with half axes `radii`, for an offset `q` from its centre in its own axes.
///
/// A zero in `q` drops that axis, which makes an elliptic cylinder.
pub fn ellipsoid(q: [f64; 3], radii: [f64; 3]) -> f64 {
    let scaled = [q[0] / radii[0], q[1] / radii[1], q[2] / radii[2]];
    let k0 = norm(scaled);
    let k1 = norm([scaled[0] / radii[0], scaled[1] / radii[1], scaled[2] / radii[2]]);
    if k1 < 1e-9 {
        // At the centre the distance is the smallest half axis.
        return -radii[0].min(radii[1]).min(radii[2]);
    }
    k0 * (k0 - 1.0) / k1
}

/// Piecewise-linear table of (position, value) with ascending positions; constant beyond its ends.
pub fn table<const N: usize>(rows: &[[f64; N]], x: f64) -> [f64; N] {
    let mut below = rows[0];
    if x <= below[0] {
        return below;
    }
    for &row in &rows[1..] {
        if x < row[0] {
            let t = (x - below[0]) / (row[0] - below[0]);
            let mut out = below;
            for (o, r) in out.iter_mut().zip(row) {
                *o += (r - *o) * t;
            }
            return out;
        }
        below = row;
    }
    below
}
