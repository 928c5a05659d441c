//! Spatial vectors (Featherstone 2008, Rigid Body Dynamics Algorithms, ch. 2) in base axes, all expressed at
//! the base origin.

use nalgebra::Vector3;

/// A motion (omega, v at the base origin) or a force (moment about the base origin, f), base axes.
pub(in crate::manipulator) type Spatial = [f64; 6];

/// A symmetric 6 x 6 operator from motions to forces or back.
pub(in crate::manipulator) type Operator = [[f64; 6]; 6];

pub(in crate::manipulator) const ZERO: Spatial = [0.0; 6];

pub(in crate::manipulator) fn dot(a: &Spatial, b: &Spatial) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3] + a[4] * b[4] + a[5] * b[5]
}

/// Adds scale b to a.
pub(super) fn add_scaled(a: &mut Spatial, scale: f64, b: &Spatial) {
    for (a, b) in a.iter_mut().zip(b) {
        *a += scale * b;
    }
}

/// Returns m v.
pub(super) fn times(m: &Operator, v: &Spatial) -> Spatial {
    // Accumulates columns, which equal rows in a symmetric m: six SIMD lanes without a horizontal sum.
    let mut out = ZERO;
    for (row, x) in m.iter().zip(v) {
        add_scaled(&mut out, *x, row);
    }
    out
}

/// Adds scale a a' to m.
pub(super) fn add_outer(m: &mut Operator, scale: f64, a: &Spatial) {
    for (row, x) in m.iter_mut().zip(a) {
        add_scaled(row, scale * x, a);
    }
}

fn join(upper: Vector3<f64>, lower: Vector3<f64>) -> Spatial {
    [upper.x, upper.y, upper.z, lower.x, lower.y, lower.z]
}

/// Returns the angular part: angular velocity, or moment.
pub(super) fn upper(a: &Spatial) -> Vector3<f64> {
    Vector3::new(a[0], a[1], a[2])
}

/// Returns the linear part: velocity of the base origin, or force.
pub(super) fn lower(a: &Spatial) -> Vector3<f64> {
    Vector3::new(a[3], a[4], a[5])
}

/// Returns the unit rotation about `axis` through `p`.
pub(in crate::manipulator) fn turn_about(p: &Vector3<f64>, axis: &Vector3<f64>) -> Spatial {
    join(*axis, p.cross(axis))
}

/// Returns the unit translation along `axis`.
pub(in crate::manipulator) fn shift_along(axis: &Vector3<f64>) -> Spatial {
    join(Vector3::zeros(), *axis)
}

/// Returns a force at `p` plus a moment.
pub(in crate::manipulator) fn force_at(
    p: &Vector3<f64>,
    moment: &Vector3<f64>,
    force: &Vector3<f64>,
) -> Spatial {
    join(moment + p.cross(force), *force)
}

/// Returns the velocity of point `p` of a body with motion `v`.
pub(super) fn velocity_at(p: &Vector3<f64>, v: &Spatial) -> Vector3<f64> {
    lower(v) + upper(v).cross(p)
}

/// Returns v x s: the rate of change of a motion vector that moves with `v`.
pub(super) fn cross_motion(v: &Spatial, s: &Spatial) -> Spatial {
    let (w, o) = (upper(v), lower(v));
    join(w.cross(&upper(s)), w.cross(&lower(s)) + o.cross(&upper(s)))
}

/// Returns v x* f: the rate of change of a force vector that moves with `v`.
pub(super) fn cross_force(v: &Spatial, f: &Spatial) -> Spatial {
    let (w, o) = (upper(v), lower(v));
    join(w.cross(&upper(f)) + o.cross(&lower(f)), w.cross(&lower(f)))
}

/// Mass of a body of revolution, and its moments of inertia about its centre.
pub(super) struct Moments {
    pub mass_kg: f64,
    pub across_kg_m2: f64,
    pub along_kg_m2: f64,
}

/// Adds the inertia of a body of revolution with this centre and unit axis.
pub(super) fn add_body(m: &mut Operator, body: &Moments, c: &Vector3<f64>, axis: &Vector3<f64>) {
    let Moments { mass_kg: mass, across_kg_m2: across, along_kg_m2: along } = *body;
    let squared = c.norm_squared();
    for i in 0..3 {
        for j in 0..3 {
            let own = (along - across) * axis[i] * axis[j] - mass * c[i] * c[j];
            m[i][j] += own + if i == j { across + mass * squared } else { 0.0 };
        }
        m[i + 3][i + 3] += mass;
    }
    // m c x in the upper right block, its transpose in the lower left.
    let skew = [[0.0, -c.z, c.y], [c.z, 0.0, -c.x], [-c.y, c.x, 0.0]];
    for i in 0..3 {
        for j in 0..3 {
            m[i][j + 3] += mass * skew[i][j];
            m[j + 3][i] += mass * skew[i][j];
        }
    }
}
