//! O(n) factorisation of the chain's implicit operator.
//!
//! `H = M(q) + diag` is factored by the articulated-body algorithm (Featherstone 2008, Rigid Body Dynamics
//! Algorithms, ch. 7) in the bending plane. All spatial quantities are expressed at the base origin, so no
//! transforms between links are needed. A planar motion is (omega_y, v_x, v_z) at the origin, a planar force
//! (m_y, f_x, f_z).

use super::MAX_JOINTS;
use super::coupling::Freedoms;
use super::geometry::{Configuration, Layout, Planar};

/// Planar spatial motion (omega, v_x, v_z) or force (m, f_x, f_z) at the base origin.
pub(super) type Spatial = [f64; 3];

/// Symmetric 3 x 3 matrix: entries 00 01 02 11 12 22.
type Symmetric = [f64; 6];

pub(super) fn dot(a: &Spatial, b: &Spatial) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn times(m: &Symmetric, v: &Spatial) -> Spatial {
    [
        m[0] * v[0] + m[1] * v[1] + m[2] * v[2],
        m[1] * v[0] + m[3] * v[1] + m[4] * v[2],
        m[2] * v[0] + m[4] * v[1] + m[5] * v[2],
    ]
}

/// Adds scale a a' to m.
fn add_outer(m: &mut Symmetric, scale: f64, a: &Spatial) {
    m[0] += scale * a[0] * a[0];
    m[1] += scale * a[0] * a[1];
    m[2] += scale * a[0] * a[2];
    m[3] += scale * a[1] * a[1];
    m[4] += scale * a[1] * a[2];
    m[5] += scale * a[2] * a[2];
}

/// Returns the spatial velocity at the base origin for a unit joint rate of a flexure at `p`.
pub(super) fn joint_axis(p: &Planar) -> Spatial {
    [1.0, -p[1], p[0]]
}

/// Returns the planar spatial force at the base origin of a force at `p` plus a moment.
pub(super) fn force_at(p: &Planar, moment: f64, force: &Planar) -> Spatial {
    [moment + p[1] * force[0] - p[0] * force[1], force[0], force[1]]
}

/// Returns the velocity of the point `p` of a body with planar motion `v`.
pub(super) fn velocity_at(p: &Planar, v: &Spatial) -> Planar {
    [v[1] + v[0] * p[1], v[2] - v[0] * p[0]]
}

/// Generalised velocities or impulses: the flexures, then the mount along base x, y, z.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Generalised {
    pub joint: [f64; MAX_JOINTS],
    pub mount: [f64; 3],
}

impl Generalised {
    pub const ZERO: Self = Self { joint: [0.0; MAX_JOINTS], mount: [0.0; 3] };

    /// Converts the coordinates of a state, or their velocities, in which the mount's come first.
    pub fn of(all: &[f64]) -> Self {
        let mut of = Self::ZERO;
        let (mount, joint) = all.split_at(of.mount.len());
        of.mount.copy_from_slice(mount);
        of.joint.copy_from_slice(joint);
        of
    }

    /// Returns self + scale other.
    pub fn plus(&self, scale: f64, other: &Self) -> Self {
        let mut sum = *self;
        sum.add_scaled(scale, other);
        sum
    }
}

/// View of the flexures alone.
impl AsRef<[f64]> for Generalised {
    fn as_ref(&self) -> &[f64] {
        &self.joint
    }
}

/// Generalised vectors of tendons, which do not move the mount.
impl Freedoms for Generalised {
    fn dot(&self, other: &Self) -> f64 {
        let mut sum = 0.0;
        for i in 0..MAX_JOINTS {
            sum += self.joint[i] * other.joint[i];
        }
        sum
    }

    fn add_scaled(&mut self, scale: f64, other: &Self) {
        for (s, o) in self.joint.iter_mut().zip(&other.joint) {
            *s += scale * o;
        }
        for (s, o) in self.mount.iter_mut().zip(&other.mount) {
            *s += scale * o;
        }
    }

    fn clear(&mut self) {
        *self = Self::ZERO;
    }

    fn copy_to(&self, list: &mut [f64]) {
        let (mount, joints) = list.split_at_mut(self.mount.len());
        mount.copy_from_slice(&self.mount);
        joints.copy_from_slice(&self.joint[..joints.len()]);
    }
}

/// The factored operator.
#[derive(Debug, Clone)]
pub(super) struct Articulated {
    joints: usize,
    /// Joint axes.
    pub axis: [Spatial; MAX_JOINTS],
    /// Articulated inertia times axis.
    pub bias: [Spatial; MAX_JOINTS],
    /// 1 / (axis . bias + diagonal).
    pub inverse: [f64; MAX_JOINTS],
    /// Inverse of the root's 2 x 2 matrix (x, z): entries xx, xz, zz.
    root: [f64; 3],
    /// Inverse of the out-of-plane operator.
    pub lateral: f64,
}

impl Articulated {
    pub fn new(joints: usize) -> Self {
        Self {
            joints,
            axis: [[0.0; 3]; MAX_JOINTS],
            bias: [[0.0; 3]; MAX_JOINTS],
            inverse: [0.0; MAX_JOINTS],
            root: [0.0; 3],
            lateral: 0.0,
        }
    }

    /// Factors M(configuration) + diag(`diagonal`).
    pub fn factor(&mut self, layout: &Layout, configuration: &Configuration, diagonal: &Generalised) {
        let mut inertia: Symmetric = [0.0; 6];
        for i in (0..self.joints).rev() {
            add_body(&mut inertia, layout, configuration, i + 1);
            let axis = joint_axis(&configuration.origin[i + 1]);
            let bias = times(&inertia, &axis);
            let inverse = 1.0 / (dot(&axis, &bias) + diagonal.joint[i]);
            add_outer(&mut inertia, -inverse, &bias);
            self.axis[i] = axis;
            self.bias[i] = bias;
            self.inverse[i] = inverse;
        }
        add_body(&mut inertia, layout, configuration, 0);
        let (xx, xz, zz) = (inertia[3] + diagonal.mount[0], inertia[4], inertia[5] + diagonal.mount[2]);
        let inverse = 1.0 / (xx * zz - xz * xz);
        self.root = [zz * inverse, -xz * inverse, xx * inverse];
        self.lateral = 1.0 / (layout.total_mass_kg + diagonal.mount[1]);
    }

    /// Solves H x = `generalised` + sum over links of `force` (planar, at the origin; index 0 is the shaft).
    pub fn solve(&self, force: &[Spatial; MAX_JOINTS + 1], generalised: &Generalised) -> Generalised {
        let mut torque = [0.0; MAX_JOINTS];
        let mut sum: Spatial = [0.0; 3];
        for i in (0..self.joints).rev() {
            for k in 0..3 {
                sum[k] += force[i + 1][k];
            }
            let t = (generalised.joint[i] + dot(&self.axis[i], &sum)) * self.inverse[i];
            for k in 0..3 {
                sum[k] -= self.bias[i][k] * t;
            }
            torque[i] = t;
        }
        let rhs = [generalised.mount[0] + sum[1] + force[0][1], generalised.mount[2] + sum[2] + force[0][2]];
        let mut out = Generalised::ZERO;
        out.mount[0] = self.root[0] * rhs[0] + self.root[1] * rhs[1];
        out.mount[1] = self.lateral * generalised.mount[1];
        out.mount[2] = self.root[1] * rhs[0] + self.root[2] * rhs[1];
        let mut v: Spatial = [0.0, out.mount[0], out.mount[2]];
        for i in 0..self.joints {
            out.joint[i] = torque[i] - dot(&self.bias[i], &v) * self.inverse[i];
            for k in 0..3 {
                v[k] += self.axis[i][k] * out.joint[i];
            }
        }
        out
    }

    /// Computes the motions of all links for generalised velocities `x`.
    pub fn link_motions(&self, x: &Generalised, out: &mut [Spatial; MAX_JOINTS + 1]) {
        let mut v: Spatial = [0.0, x.mount[0], x.mount[2]];
        out[0] = v;
        for i in 0..self.joints {
            for k in 0..3 {
                v[k] += self.axis[i][k] * x.joint[i];
            }
            out[i + 1] = v;
        }
    }
}

/// Adds the rigid-body inertia of `link` about the base origin.
fn add_body(inertia: &mut Symmetric, layout: &Layout, configuration: &Configuration, link: usize) {
    let body = &layout.body[link];
    let c = configuration.point(link, body.centre_m);
    let m = body.mass_kg;
    inertia[0] += body.inertia_kg_m2 + m * (c[0] * c[0] + c[1] * c[1]);
    inertia[1] += m * c[1];
    inertia[2] -= m * c[0];
    inertia[3] += m;
    inertia[5] += m;
}
