//! Constant layout of a spatial chain, and its configuration in space.
//!
//! A flexure is a series of single-DoF joints. The generalised coordinates are ordered: three of the mount
//! (base x, y, z), then those of each flexure. With one: bending (about the link's y). With three: bending,
//! lateral bending (about the rotated x), torsion (about the rotated z). With six, displacements along x, y
//! and z of the proximal link come first.

use nalgebra::{Matrix3, Vector3};

use super::algebra::{Moments, Spatial, ZERO, add_body, shift_along, turn_about};
use crate::manipulator::contact::Chain;
use crate::manipulator::geometry::{BurrBody, LinkBody, link_bodies, link_lengths_m};
use crate::manipulator::parameters::ManipulatorParameters;

/// Degrees of freedom of the mount.
pub(super) const MOUNT: usize = 3;

/// Constant data of the chain.
#[derive(Debug, Clone)]
pub(super) struct SpatialLayout<const D: usize> {
    pub joints: usize,
    pub first_joint_m: f64,
    /// Length of the link distal to each flexure.
    pub length_m: Vec<f64>,
    /// Bodies: the shaft, then one per flexure. Moments of inertia are transverse to the axis.
    pub body: Vec<LinkBody>,
    /// Moments of inertia along the axis, kg m^2.
    pub axial_inertia_kg_m2: Vec<f64>,
    pub total_mass_kg: f64,
}

impl<const D: usize> SpatialLayout<D> {
    /// Returns the mass and moments of inertia of a link.
    pub fn moments(&self, link: usize) -> Moments {
        let body = &self.body[link];
        Moments {
            mass_kg: body.mass_kg,
            across_kg_m2: body.inertia_kg_m2,
            along_kg_m2: self.axial_inertia_kg_m2[link],
        }
    }

    /// Number of coordinates before bending within a flexure.
    pub const BEND: usize = if D == 6 { 3 } else { 0 };

    pub fn new(p: &ManipulatorParameters) -> Self {
        let length_m = link_lengths_m(p);
        let body = link_bodies(p, &length_m);
        let [outer, inner] = p.tube_radii_m;
        let along = |length: &f64| p.linear_density_kg_per_m * length * 0.5 * (outer * outer + inner * inner);
        let mut axial_inertia_kg_m2 = vec![0.0];
        axial_inertia_kg_m2.extend(length_m.iter().map(along));
        if let Some(last_m) = length_m.last() {
            axial_inertia_kg_m2[length_m.len()] = along(&(last_m - p.cutter.span_m()));
        }
        axial_inertia_kg_m2[length_m.len()] += BurrBody::of(p).along_kg_m2;
        Self {
            joints: length_m.len(),
            first_joint_m: p.joint_positions_m[0],
            total_mass_kg: body.iter().map(|b| b.mass_kg).sum(),
            length_m,
            body,
            axial_inertia_kg_m2,
        }
    }

    /// Returns the total number of degrees of freedom.
    pub fn freedoms(&self) -> usize {
        MOUNT + self.joints * D
    }

    /// Returns the coordinates that move `link` relative to the previous one (the mount moves link 0).
    pub fn freedoms_of(&self, link: usize) -> core::ops::Range<usize> {
        if link == 0 { 0..MOUNT } else { MOUNT + (link - 1) * D..MOUNT + link * D }
    }

    /// Returns the first freedom of each link, then the number of freedoms.
    pub fn first_freedoms(&self) -> Vec<usize> {
        core::iter::once(0).chain((0..=self.joints).map(|link| self.freedoms_of(link).end)).collect()
    }

    /// Sets the axes, inertias and diagonal of the contact solver's chain.
    pub fn describe(&self, configuration: &Configuration<D>, diagonal: &[f64], chain: &mut Chain<6>) {
        chain.axis.copy_from_slice(&configuration.axis);
        chain.diagonal.copy_from_slice(diagonal);
        for (link, inertia) in chain.body.iter_mut().enumerate() {
            let centre = configuration.point(link, self.body[link].centre_m);
            *inertia = [ZERO; 6];
            add_body(inertia, &self.moments(link), &centre, &configuration.direction(link));
        }
    }

    /// Returns the index of the bending coordinate of flexure `joint`.
    pub fn bend(&self, joint: usize) -> usize {
        MOUNT + joint * D + Self::BEND
    }

    /// Returns the indices of the coordinates that have stops: bending in the plane and, in space, across it.
    pub fn stopped(&self) -> impl Iterator<Item = usize> + use<D> {
        let bends = 1 + usize::from(D > 1);
        (0..self.joints).flat_map(move |joint| {
            let bend = MOUNT + joint * D + Self::BEND;
            bend..bend + bends
        })
    }
}

/// Link poses in base axes.
#[derive(Debug, Clone)]
pub(super) struct Configuration<const D: usize> {
    /// Origin of each link: the displaced base origin, then the flexures after their displacement.
    pub origin: Vec<Vector3<f64>>,
    /// Axes of each link as columns.
    pub rotation: Vec<Matrix3<f64>>,
    /// Motion of everything distal to a joint per unit of its velocity.
    pub axis: Vec<Spatial>,
}

impl<const D: usize> Configuration<D> {
    pub fn new(layout: &SpatialLayout<D>) -> Self {
        let links = layout.joints + 1;
        Self {
            origin: vec![Vector3::zeros(); links],
            rotation: vec![Matrix3::identity(); links],
            axis: vec![[0.0; 6]; layout.freedoms()],
        }
    }

    /// Updates every link from the coordinates `q`.
    pub fn update(&mut self, layout: &SpatialLayout<D>, q: &[f64]) {
        let mut r = Matrix3::identity();
        let mut p = Vector3::new(q[0], q[1], q[2]);
        for k in 0..MOUNT {
            self.axis[k] = shift_along(&r.column(k).into_owned());
        }
        self.origin[0] = p;
        self.rotation[0] = r;
        for i in 0..layout.joints {
            let length = if i == 0 { layout.first_joint_m } else { layout.length_m[i - 1] };
            p += r.column(2) * length;
            let first = MOUNT + i * D;
            if D == 6 {
                for k in 0..3 {
                    self.axis[first + k] = shift_along(&r.column(k).into_owned());
                }
                p += r * Vector3::new(q[first], q[first + 1], q[first + 2]);
            }
            let bend = layout.bend(i);
            self.axis[bend] = turn_about(&p, &r.column(1).into_owned());
            turn_columns(&mut r, 2, 0, q[bend]);
            if D > 1 {
                self.axis[bend + 1] = turn_about(&p, &r.column(0).into_owned());
                turn_columns(&mut r, 1, 2, q[bend + 1]);
                self.axis[bend + 2] = turn_about(&p, &r.column(2).into_owned());
                turn_columns(&mut r, 0, 1, q[bend + 2]);
            }
            self.origin[i + 1] = p;
            self.rotation[i + 1] = r;
        }
    }

    /// Returns the point at `along_m` on the axis of `link`.
    pub fn point(&self, link: usize, along_m: f64) -> Vector3<f64> {
        self.origin[link] + self.rotation[link].column(2) * along_m
    }

    /// Returns the unit axis of `link`.
    pub fn direction(&self, link: usize) -> Vector3<f64> {
        self.rotation[link].column(2).into_owned()
    }
}

/// Rotates columns `a` and `b` of a rotation matrix by `angle` from `a` toward `b`: a rotation about the
/// third column.
fn turn_columns(r: &mut Matrix3<f64>, a: usize, b: usize, angle: f64) {
    let (sin, cos) = libm::sincos(angle);
    let (u, v) = (r.column(a).into_owned(), r.column(b).into_owned());
    r.set_column(a, &(u * cos + v * sin));
    r.set_column(b, &(v * cos - u * sin));
}
