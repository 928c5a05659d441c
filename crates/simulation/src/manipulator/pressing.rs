//! The planar chain in the contact solver's form: motions and forces (omega_y, x, z, y) at the base origin,
//! with the freedoms of the mount first.

use nalgebra::Vector3;

use super::MAX_JOINTS;
use super::articulated::Generalised;
use super::contact::{Chain, Square};
use super::geometry::{Configuration, Layout};

/// Number of freedoms of the mount: x, y, z.
pub(super) const MOUNT: usize = 3;
/// Maximum number of freedoms: mount and flexures.
pub(super) const MAX_FREEDOMS: usize = MOUNT + MAX_JOINTS;

/// Returns the first freedom of each link, then the number of freedoms.
pub(super) fn first_freedoms(joints: usize) -> Vec<usize> {
    core::iter::once(0).chain(MOUNT..=MOUNT + joints).collect()
}

/// Returns a unit force along `direction` at `point`.
pub(super) fn force(point: &Vector3<f64>, direction: &Vector3<f64>) -> [f64; 4] {
    [point.z * direction.x - point.x * direction.z, direction.x, direction.z, direction.y]
}

/// Sets the chain's axes, inertias and diagonal.
pub(super) fn describe(
    chain: &mut Chain<4>,
    layout: &Layout,
    configuration: &Configuration,
    diagonal: &Generalised,
) {
    chain.axis[0] = [0.0, 1.0, 0.0, 0.0];
    chain.axis[1] = [0.0, 0.0, 0.0, 1.0];
    chain.axis[2] = [0.0, 0.0, 1.0, 0.0];
    chain.diagonal[..MOUNT].copy_from_slice(&diagonal.mount);
    for i in 0..layout.joints {
        let p = configuration.origin[i + 1];
        chain.axis[MOUNT + i] = [1.0, -p[1], p[0], 0.0];
        chain.diagonal[MOUNT + i] = diagonal.joint[i];
    }
    for link in 0..=layout.joints {
        chain.body[link] = inertia(layout, configuration, link);
    }
}

/// Returns the inertia of a link about the base origin.
fn inertia(layout: &Layout, configuration: &Configuration, link: usize) -> Square<4> {
    let body = &layout.body[link];
    let c = configuration.point(link, body.centre_m);
    let m = body.mass_kg;
    let about = body.inertia_kg_m2 + m * (c[0] * c[0] + c[1] * c[1]);
    [[about, m * c[1], -m * c[0], 0.0], [m * c[1], m, 0.0, 0.0], [-m * c[0], 0.0, m, 0.0], [0.0, 0.0, 0.0, m]]
}

/// Returns the velocities in the order of the chain's freedoms.
pub(super) fn ordered<'o>(v: &Generalised, out: &'o mut [f64; MAX_FREEDOMS], joints: usize) -> &'o [f64] {
    out[..MOUNT].copy_from_slice(&v.mount);
    out[MOUNT..].copy_from_slice(&v.joint);
    &out[..MOUNT + joints]
}
