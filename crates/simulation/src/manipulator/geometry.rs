//! Constant layout of the chain (bodies, spheres) and its planar configuration.

use super::MAX_JOINTS;
use super::parameters::ManipulatorParameters;

/// A point or vector in the bending plane, base axes: (x, z).
pub(super) type Planar = [f64; 2];

/// The part of the tool that a proxy sphere represents.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SphereKind {
    /// The rigid shaft proximal to the first flexure.
    Shaft,
    /// Midpoint of the segment distal to this flexure.
    Segment(usize),
    /// A ball of the burr at the tip.
    Burr,
}

/// A sphere fixed to a link. Link 0 is the shaft; link i + 1 is distal to flexure i.
#[derive(Debug, Clone, Copy)]
pub(super) struct SphereLayout {
    pub kind: SphereKind,
    pub radius_m: f64,
    pub link: usize,
    /// Distance along the link axis, from the base origin (shaft) or from the link's flexure.
    pub along_m: f64,
}

/// Mass properties of a link, along its own axis.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct LinkBody {
    pub mass_kg: f64,
    /// Distance from the link's flexure (or the base origin) to the centre of mass, m.
    pub centre_m: f64,
    /// Inertia about the centre of mass, axis y.
    pub inertia_kg_m2: f64,
}

/// Constant data of the chain.
#[derive(Debug, Clone)]
pub(super) struct Layout {
    pub joints: usize,
    pub first_joint_m: f64,
    /// Length of the link distal to each flexure (the last ends at the burr centre).
    pub length_m: [f64; MAX_JOINTS],
    /// Bodies: the shaft, then one per flexure.
    pub body: [LinkBody; MAX_JOINTS + 1],
    pub total_mass_kg: f64,
}

impl Layout {
    /// Creates links and masses from validated parameters.
    pub fn new(p: &ManipulatorParameters) -> Self {
        let n = p.joint_positions_m.len();
        let mut length_m = [0.0; MAX_JOINTS];
        length_m[..n].copy_from_slice(&link_lengths_m(p));
        let mut body = [LinkBody::default(); MAX_JOINTS + 1];
        body[..=n].copy_from_slice(&link_bodies(p, &length_m[..n]));
        let total_mass_kg = body[..=n].iter().map(|b| b.mass_kg).sum();
        Self { joints: n, first_joint_m: p.joint_positions_m[0], length_m, body, total_mass_kg }
    }
}

/// Returns the length of the link distal to each flexure, m.
pub(super) fn link_lengths_m(p: &ManipulatorParameters) -> Vec<f64> {
    let z = &p.joint_positions_m;
    z.windows(2).map(|pair| pair[1] - pair[0]).chain([p.tip_offset_m]).collect()
}

/// Returns the shaft, then one body per flexure; the burr is part of the last.
pub(super) fn link_bodies(p: &ManipulatorParameters, length_m: &[f64]) -> Vec<LinkBody> {
    let transverse = 0.25 * (p.tube_radii_m[0] * p.tube_radii_m[0] + p.tube_radii_m[1] * p.tube_radii_m[1]);
    let last = length_m.len();
    let mut body =
        vec![LinkBody { mass_kg: p.shaft_mass_kg, centre_m: p.shaft_centre_m, inertia_kg_m2: 0.0 }];
    for (number, &length) in length_m.iter().enumerate() {
        // The tube ends at the centre of the burr, or of the last of its balls.
        let length = if number + 1 == last { length - p.cutter.span_m() } else { length };
        let mass = p.linear_density_kg_per_m * length;
        let inertia = mass * (length * length / 12.0 + transverse);
        body.push(LinkBody { mass_kg: mass, centre_m: 0.5 * length, inertia_kg_m2: inertia });
    }
    body[last] = with_burr(body[last], p);
    body
}

/// The burr's moments of inertia about its centre of mass.
#[derive(Debug, Clone, Copy)]
pub(super) struct BurrBody {
    /// Distance from the burr centre back to its centre of mass, m.
    pub behind_m: f64,
    pub across_kg_m2: f64,
    pub along_kg_m2: f64,
}

impl BurrBody {
    pub fn of(p: &ManipulatorParameters) -> Self {
        match p.cutter.only_radius_m() {
            Some(radius_m) => {
                let own = 0.4 * p.burr_mass_kg * radius_m * radius_m;
                Self { behind_m: 0.0, across_kg_m2: own, along_kg_m2: own }
            }
            None => {
                let solid = p.cutter.solid();
                Self {
                    behind_m: solid.behind_m,
                    across_kg_m2: p.burr_mass_kg * solid.across_m2,
                    along_kg_m2: p.burr_mass_kg * solid.along_m2,
                }
            }
        }
    }
}

/// Adds the burr, a solid at the tip, to the last link's tube.
fn with_burr(tube: LinkBody, p: &ManipulatorParameters) -> LinkBody {
    let mass = tube.mass_kg + p.burr_mass_kg;
    let burr = BurrBody::of(p);
    let burr_centre = p.tip_offset_m - burr.behind_m;
    let centre = (tube.mass_kg * tube.centre_m + p.burr_mass_kg * burr_centre) / mass;
    let own = burr.across_kg_m2;
    let (dt, db) = (tube.centre_m - centre, burr_centre - centre);
    let inertia = tube.inertia_kg_m2 + own + tube.mass_kg * dt * dt + p.burr_mass_kg * db * db;
    LinkBody { mass_kg: mass, centre_m: centre, inertia_kg_m2: inertia }
}

/// Returns the shaft spheres at equal spacing, one sphere per segment, and the burr's spheres from back to
/// front. Link indices are non-decreasing.
pub(super) fn spheres(p: &ManipulatorParameters) -> Vec<SphereLayout> {
    let length_m = link_lengths_m(p);
    let n = p.joint_positions_m.len();
    let mut list = Vec::with_capacity(p.shaft_sphere_count + n + p.cutter.balls().len());
    for i in 0..p.shaft_sphere_count {
        let fraction =
            if p.shaft_sphere_count > 1 { i as f64 / (p.shaft_sphere_count - 1) as f64 } else { 0.0 };
        let [first, last] = p.shaft_sphere_span_m;
        list.push(SphereLayout {
            kind: SphereKind::Shaft,
            radius_m: p.shaft_sphere_radius_m,
            link: 0,
            along_m: first + fraction * (last - first),
        });
    }
    for i in 0..n {
        // The last segment is as long as the one before it; the remainder of the last link is the shank of
        // the burr.
        let segment = if i + 1 == n && n > 1 { length_m[i - 1].min(length_m[i]) } else { length_m[i] };
        list.push(SphereLayout {
            kind: SphereKind::Segment(i),
            radius_m: p.segment_sphere_radius_m,
            link: i + 1,
            along_m: 0.5 * segment,
        });
    }
    list.extend(p.cutter.balls().iter().rev().map(|ball| SphereLayout {
        kind: SphereKind::Burr,
        radius_m: ball.radius_m,
        link: n,
        along_m: length_m[n - 1] - ball.behind_m,
    }));
    list
}

/// Link poses in base axes for one set of joint angles and one mount displacement.
#[derive(Debug, Clone)]
pub(super) struct Configuration {
    /// Sine of half of each joint angle.
    pub half_sin: [f64; MAX_JOINTS],
    /// Cosine of half of each joint angle.
    pub half_cos: [f64; MAX_JOINTS],
    /// Origin of each link: the displaced base origin, then the flexure centres.
    pub origin: [Planar; MAX_JOINTS + 1],
    /// Direction of each link, (sin, cos) of its angle to base z.
    pub axis: [Planar; MAX_JOINTS + 1],
}

impl Configuration {
    /// Creates the straight tool.
    pub fn new() -> Self {
        Self {
            half_sin: [0.0; MAX_JOINTS],
            half_cos: [1.0; MAX_JOINTS],
            origin: [[0.0; 2]; MAX_JOINTS + 1],
            axis: [[0.0, 1.0]; MAX_JOINTS + 1],
        }
    }

    /// Updates every link from joint angles `q` (rad) and mount displacement `mount` (base axes x, y, z, m).
    pub fn update(&mut self, layout: &Layout, q: &[f64; MAX_JOINTS], mount: &[f64; 3]) {
        self.origin[0] = [mount[0], mount[2]];
        let mut origin = [mount[0], mount[2] + layout.first_joint_m];
        let (mut sin, mut cos) = (0.0, 1.0);
        for i in 0..layout.joints {
            let (half_sin, half_cos) = libm::sincos(0.5 * q[i]);
            self.half_sin[i] = half_sin;
            self.half_cos[i] = half_cos;
            let (joint_sin, joint_cos) =
                (2.0 * half_sin * half_cos, (half_cos - half_sin) * (half_cos + half_sin));
            (sin, cos) = (sin * joint_cos + cos * joint_sin, cos * joint_cos - sin * joint_sin);
            self.origin[i + 1] = origin;
            self.axis[i + 1] = [sin, cos];
            origin = [origin[0] + layout.length_m[i] * sin, origin[1] + layout.length_m[i] * cos];
        }
    }

    /// Returns the point at `along_m` on the axis of `link`.
    pub fn point(&self, link: usize, along_m: f64) -> Planar {
        [
            self.origin[link][0] + along_m * self.axis[link][0],
            self.origin[link][1] + along_m * self.axis[link][1],
        ]
    }
}
