//! Shape and motion of the tool for given flexures, with the links' values stored as arrays.

use crate::manipulator::MAX_JOINTS;
use crate::manipulator::geometry::{Layout, Planar};

/// Capacity for links, the shaft first; a multiple of the vector length of four.
pub(super) const LINKS: usize = 36;
/// One number per link.
pub(super) type LinkArray = [f64; LINKS];
/// One number per flexure; 0 past the last.
pub(super) type FlexureArray = [f64; MAX_JOINTS];

/// Half angle, rad, up to which the series below are exact to rounding: the first omitted term is 0.25^13 /
/// 13!.
const SERIES_UP_TO_RAD: f64 = 0.25;

/// Constant properties of the links; 0 past the last.
#[derive(Debug, Clone)]
pub(super) struct Links {
    /// Number of flexures, one less than links.
    pub joints: usize,
    /// Length up to the next flexure, m.
    pub length_m: LinkArray,
    pub mass_kg: LinkArray,
    /// Distance from the link's origin to its centre of mass, m.
    pub centre_m: LinkArray,
    /// Inertia about the centre of mass, axis y.
    pub inertia_kg_m2: LinkArray,
    pub total_mass_kg: f64,
    /// Mass of everything distal to each flexure.
    pub behind_kg: FlexureArray,
}

impl Links {
    /// Converts a layout, which must have at most [`MAX_JOINTS`] flexures.
    pub fn of(layout: &Layout) -> Self {
        let body = |link: usize| layout.body.get(link).filter(|_| link <= layout.joints);
        let of = |value: fn(&crate::manipulator::geometry::LinkBody) -> f64| {
            core::array::from_fn(|link| body(link).map_or(0.0, value))
        };
        let mut length_m = [0.0; LINKS];
        length_m[0] = layout.first_joint_m;
        length_m[1..=layout.joints].copy_from_slice(&layout.length_m[..layout.joints]);
        let mass_kg: LinkArray = of(|body| body.mass_kg);
        let behind_kg = core::array::from_fn(|j| mass_kg[j + 1..].iter().sum());
        Self {
            joints: layout.joints,
            length_m,
            mass_kg,
            total_mass_kg: mass_kg.iter().sum(),
            behind_kg,
            centre_m: of(|body| body.centre_m),
            inertia_kg_m2: of(|body| body.inertia_kg_m2),
        }
    }
}

/// Positions of the links, base axes; 0 past the last.
#[derive(Debug, Clone)]
pub(super) struct Shape {
    /// Sine and cosine of half of each flexure's angle.
    pub half_sin: FlexureArray,
    pub half_cos: FlexureArray,
    /// Origin of each link: the displaced base origin, then the flexure centres, m.
    pub x: LinkArray,
    pub z: LinkArray,
    /// Direction of each link: sine and cosine of its angle to base z.
    pub sin: LinkArray,
    pub cos: LinkArray,
}

impl Shape {
    /// Creates the straight tool.
    pub fn new() -> Self {
        Self {
            half_sin: [0.0; MAX_JOINTS],
            half_cos: [1.0; MAX_JOINTS],
            x: [0.0; LINKS],
            z: [0.0; LINKS],
            sin: [0.0; LINKS],
            cos: [1.0; LINKS],
        }
    }

    /// Updates every link from the flexures' angles `q` (rad) and the mount's displacement (base axes x, y,
    /// z, m).
    #[inline(always)]
    pub fn update(&mut self, links: &Links, q: &FlexureArray, mount: &[f64; 3]) {
        half_angles(q, &mut self.half_sin, &mut self.half_cos);
        (self.x[0], self.z[0]) = (mount[0], mount[2]);
        let (mut x, mut z) = (mount[0], mount[2] + links.length_m[0]);
        let (mut sin, mut cos) = (0.0, 1.0);
        for i in 0..links.joints.min(MAX_JOINTS) {
            let (s, c) = (self.half_sin[i], self.half_cos[i]);
            let (joint_sin, joint_cos) = (2.0 * s * c, (c - s) * (c + s));
            (sin, cos) = (sin * joint_cos + cos * joint_sin, cos * joint_cos - sin * joint_sin);
            (self.x[i + 1], self.z[i + 1]) = (x, z);
            (self.sin[i + 1], self.cos[i + 1]) = (sin, cos);
            x += links.length_m[i + 1] * sin;
            z += links.length_m[i + 1] * cos;
        }
    }

    /// Returns the point at `along_m` on the axis of `link`.
    #[inline(always)]
    pub fn point(&self, link: usize, along_m: f64) -> Planar {
        [self.x[link] + along_m * self.sin[link], self.z[link] + along_m * self.cos[link]]
    }
}

/// Motion of the links relative to the base.
#[derive(Debug, Clone)]
pub(super) struct Motion {
    /// Angular velocity, rad/s.
    pub omega: LinkArray,
    /// Velocity of the link's origin, m/s.
    pub vx: LinkArray,
    pub vz: LinkArray,
    /// Velocity-product acceleration of the link's origin, m/s².
    pub ax: LinkArray,
    pub az: LinkArray,
}

impl Motion {
    pub fn new() -> Self {
        let none = [0.0; LINKS];
        Self { omega: none, vx: none, vz: none, ax: none, az: none }
    }

    /// Updates every link from the flexures' rates (rad/s) and the mount's velocity (base axes x, y, z, m/s).
    #[inline(always)]
    pub fn update(&mut self, links: &Links, shape: &Shape, rate: &FlexureArray, mount: &[f64; 3]) {
        let joints = links.joints.min(MAX_JOINTS);
        for i in 0..joints {
            self.omega[i + 1] = self.omega[i] + rate[i];
        }
        let (mut dx, mut dz, mut ddx, mut ddz) = ([0.0; LINKS], [0.0; LINKS], [0.0; LINKS], [0.0; LINKS]);
        for l in 0..LINKS {
            let omega = self.omega[l];
            let (x, z) = (links.length_m[l] * shape.cos[l], -links.length_m[l] * shape.sin[l]);
            (dx[l], dz[l]) = (omega * x, omega * z);
            (ddx[l], ddz[l]) = (omega * dz[l], -omega * dx[l]);
        }
        let (mut v, mut a) = ([mount[0], mount[2]], [0.0; 2]);
        for l in 0..=joints {
            (self.vx[l], self.vz[l], self.ax[l], self.az[l]) = (v[0], v[1], a[0], a[1]);
            v = [v[0] + dx[l], v[1] + dz[l]];
            a = [a[0] + ddx[l], a[1] + ddz[l]];
        }
    }
}

/// Computes the sine and cosine of half of each angle. A flexure bends by a few degrees, for which a few
/// terms of the power series suffice, in branch-free loops; if any angle is larger, the library functions are
/// used.
#[inline(always)]
fn half_angles(q: &FlexureArray, sin: &mut FlexureArray, cos: &mut FlexureArray) {
    let mut small = true;
    for q in q {
        // False for a NaN.
        small &= (0.5 * q).abs() <= SERIES_UP_TO_RAD;
    }
    if !small {
        for i in 0..MAX_JOINTS {
            (sin[i], cos[i]) = libm::sincos(0.5 * q[i]);
        }
        return;
    }
    for i in 0..MAX_JOINTS {
        let x = 0.5 * q[i];
        let u = x * x;
        let odd = 1.0 / 362_880.0 - u * (1.0 / 39_916_800.0);
        let odd = -1.0 / 6.0 + u * (1.0 / 120.0 + u * (-1.0 / 5040.0 + u * odd));
        let even = -1.0 / 3_628_800.0 + u * (1.0 / 479_001_600.0);
        let even = 1.0 / 24.0 + u * (-1.0 / 720.0 + u * (1.0 / 40_320.0 + u * even));
        sin[i] = x + x * (u * odd);
        cos[i] = 1.0 + u * (-0.5 + u * even);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::manipulator::geometry::Configuration;
    use crate::manipulator::parameters::ManipulatorParameters;

    #[test]
    fn the_series_are_the_library_s_functions_to_rounding() {
        for k in 0..=1000 {
            let largest = 2.0 * SERIES_UP_TO_RAD * (f64::from(k) / 1000.0);
            let q: FlexureArray = core::array::from_fn(|i| largest * (i as f64 / 15.5 - 1.0));
            let (mut sin, mut cos) = ([0.0; MAX_JOINTS], [0.0; MAX_JOINTS]);
            half_angles(&q, &mut sin, &mut cos);
            for i in 0..MAX_JOINTS {
                let (s, c) = libm::sincos(0.5 * q[i]);
                assert!((sin[i] - s).abs() <= 3e-16 * s.abs() && (cos[i] - c).abs() <= 3e-16, "{}", q[i]);
            }
        }
    }

    #[test]
    fn small_and_large_angles_are_placed_as_by_the_planar_rung() {
        let layout = Layout::new(&ManipulatorParameters::jhu_27());
        let links = Links::of(&layout);
        for largest in [0.08, 0.6, 1.5] {
            let mut q = [0.0; MAX_JOINTS];
            for (i, q) in q.iter_mut().enumerate().take(27) {
                *q = largest * libm::sin(i as f64);
            }
            let mount = [1e-4, 2e-4, 3e-4];
            let (mut own, mut planar) = (Shape::new(), Configuration::new());
            own.update(&links, &q, &mount);
            planar.update(&layout, &q, &mount);
            for link in 0..=27 {
                let (a, b) = (own.point(link, 1.0), planar.point(link, 1.0));
                assert!((a[0] - b[0]).abs() < 1e-14 && (a[1] - b[1]).abs() < 1e-14, "{link}: {a:?} {b:?}");
            }
        }
    }
}
