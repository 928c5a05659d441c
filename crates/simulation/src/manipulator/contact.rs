//! Contacts and joint stops, for every rung.
//!
//! A normal row requires `v_n + P / (k_c dt^2) >= -gap / dt`: the sphere may close its gap within the step
//! (speculative contact), and at rest the overlap equals force / k_c. Any overlap beyond what the last
//! contact force explains is pushed out at a bounded speed. A yielding obstacle carries no more than its
//! strength: the sphere then penetrates deeper, and the obstacle recedes after the step. An obstacle being
//! cut recedes within the step by the depth that the force cuts ([`crate::contact_plane::RecessionLaw`]): the
//! sphere penetrates deeper by that amount at the same force. Coulomb friction holds per contact: the impulse
//! either stops the sliding or lies on the circle mu P_n and opposes the remaining sliding. The rows are
//! solved together by Newton's method (`newton`) on the chain's own recursion (`chain`).

pub(in crate::manipulator) mod chain;
mod dense;
mod laws;
mod newton;
mod patch;
#[cfg(test)]
mod tests;

use nalgebra::{UnitQuaternion, Vector3};

use super::geometry::{SphereKind, SphereLayout};
use super::parameters::ContactParameters;
use super::row::{StopLaw, push_out, tangents, target};
use super::state::{ContactResult, StepReport};
use crate::contact_plane::ContactPlane;
use laws::{ContactRow, StopRow};
use newton::Problem;
use patch::Patch;

pub(super) use chain::{Chain, Operator, Square};
pub(super) use dense::{Dense, Factor, lanes, lanes_mut};

/// Cosine between two normals above which a contact inherits the last tick's impulses of a contact on the
/// same sphere.
const SAME_NORMAL_COSINE: f64 = 0.9;

/// Maximum rows of a freedom's stops: two sides of two parts.
const MOST_STOPS: usize = 4;

/// Maximum overlap, beyond what the contact force explains, that is pushed out per step, m. A longer step
/// must not throw the tool farther.
const PUSH_OUT_M: f64 = 50.0e-6;

/// Motion of the base frame in this step, base axes.
#[derive(Debug, Clone, Copy)]
pub(super) struct BaseDrive {
    /// R_world_base before the step.
    pub rotation: UnitQuaternion<f64>,
    /// Mean velocity of the base origin, m/s.
    pub linear: Vector3<f64>,
    /// Mean angular velocity, rad/s.
    pub angular: Vector3<f64>,
}

/// Quantities shared by all contacts of a step.
#[derive(Debug, Clone, Copy)]
pub(super) struct ContactStep<'a> {
    /// Time step, s.
    pub dt: f64,
    pub drive: &'a BaseDrive,
    pub planes: &'a [ContactPlane],
    pub parameters: &'a ContactParameters,
    pub spheres: &'a [SphereLayout],
    /// Results of the last step, ordered by sphere.
    pub results: &'a [ContactResult],
    /// Whether the burr turns; a stationary burr has the tube's friction.
    pub burr_turns: bool,
    /// SIMD support of this CPU.
    pub arch: pulp::Arch,
}

impl ContactStep<'_> {
    /// Returns 1 / (k_c dt^2).
    pub fn compliance(&self) -> f64 {
        1.0 / (self.parameters.stiffness_n_per_m * self.dt * self.dt)
    }
}

impl ContactParameters {
    /// Returns the Coulomb coefficient of a sphere.
    pub(super) fn friction_of(&self, kind: SphereKind, burr_turns: bool) -> f64 {
        if kind == SphereKind::Burr && burr_turns {
            self.burr_friction_coefficient
        } else {
            self.friction_coefficient
        }
    }
}

/// A contact on the tool, in the step's input order within a sphere.
#[derive(Debug, Clone, Copy)]
pub(super) struct Contact {
    index: usize,
    sphere: usize,
    /// Contact point, base axes.
    pub point: Vector3<f64>,
    /// Normal and tangents, base axes.
    direction: [Vector3<f64>; 3],
}

/// Position of a contact on the tool: link, contact point, and unit forces on the link along the directions.
#[derive(Debug, Clone, Copy)]
pub(super) struct ContactPlacement<const N: usize> {
    pub link: usize,
    pub point: Vector3<f64>,
    pub force: [[f64; N]; 3],
}

/// Contacts and stops, and the chain or other operator that they act on.
#[derive(Debug, Clone)]
pub(super) struct ContactSolver<const N: usize, O = Chain<N>> {
    pub chain: O,
    pub contact: Vec<Contact>,
    row: Vec<ContactRow<N>>,
    stop: Vec<StopRow>,
    patch: Patch,
    order: Vec<(usize, usize)>,
    used: Vec<bool>,
    /// Motions of the links without contact.
    free_motion: Vec<[f64; N]>,
}

impl<const N: usize> ContactSolver<N> {
    /// Creates a solver on a chain; for `first`, see [`Chain::new`]. `contacts` is the maximum per step.
    pub fn new(first: Vec<usize>, contacts: usize) -> Self {
        let (links, freedoms) = (first.len() - 1, first[first.len() - 1]);
        Self::on(Chain::new(first), (links, freedoms), contacts)
    }
}

impl<const N: usize, O: Operator<N>> ContactSolver<N, O> {
    /// Creates a solver on an operator with this number of links and freedoms. `contacts` is the maximum per
    /// step.
    pub fn on(chain: O, (links, freedoms): (usize, usize), contacts: usize) -> Self {
        Self {
            chain,
            contact: Vec::with_capacity(contacts),
            row: Vec::with_capacity(contacts),
            stop: Vec::with_capacity(MOST_STOPS * freedoms),
            patch: Patch::default(),
            order: Vec::with_capacity(contacts),
            used: vec![false; contacts],
            free_motion: vec![[0.0; N]; links],
        }
    }

    /// Removes all contacts and stops.
    pub fn clear(&mut self) {
        self.contact.clear();
        self.row.clear();
        self.stop.clear();
        self.order.clear();
        self.patch = Patch::default();
    }

    /// Collects the usable contacts, ordered by sphere, then by input order, warm-started with the last
    /// tick's impulses. Spheres are ordered by link. Only contacts whose index satisfies `enters` are
    /// included; `place` returns the contact of a sphere, by index, for its normal and tangents.
    pub fn collect(
        &mut self,
        step: &ContactStep,
        report: &mut StepReport,
        enters: impl Fn(usize) -> bool,
        place: impl Fn(usize, &[Vector3<f64>; 3]) -> ContactPlacement<N>,
    ) {
        let spheres = step.spheres;
        self.clear();
        let considered = &step.planes[..step.planes.len().min(self.used.len())];
        let usable = |c: &ContactPlane| c.sphere_index < spheres.len() && c.is_usable();
        for (index, plane) in considered.iter().enumerate().filter(|(_, c)| usable(c)) {
            self.order.push((plane.sphere_index, index));
        }
        report.refused_contact_count = step.planes.len() - self.order.len();
        report.max_overlap_m = 0.0;
        self.order.retain(|(_, index)| enters(*index));
        self.order.sort_unstable();
        self.used.fill(false);
        let mut last = LastContacts { results: step.results, used: &mut self.used };
        for &(sphere, index) in &self.order {
            let plane = &step.planes[index];
            let normal = step.drive.rotation.inverse_transform_vector(plane.normal.as_ref());
            let [t0, t1] = tangents(&normal);
            let direction = [normal, t0, t1];
            let ContactPlacement { link, point, force } = place(sphere, &direction);
            let mut base_velocity = step.drive.linear + step.drive.angular.cross(&point);
            if let Some(surface) = &plane.surface_m_per_s {
                base_velocity -= step.drive.rotation.inverse_transform_vector(surface);
            }
            let mut row = ContactRow::new(link, force);
            row.drive = direction.map(|d| d.dot(&base_velocity));
            row.friction = step.parameters.friction_of(spheres[sphere].kind, step.burr_turns);
            row.compliance = step.compliance();
            ([row.target, row.push], row.impulse) = last.start(step, plane, &[t0, t1]);
            row.strength = plane.strength_n * step.dt;
            row.recedes = plane.give.m_per_n > 0.0;
            if row.recedes {
                self.patch = Patch::new(&plane.give, step.dt);
            }
            row.impulse[0] = row.impulse[0].min(row.strength);
            report.max_overlap_m = report.max_overlap_m.max(-plane.gap_m);
            self.row.push(row);
            self.contact.push(Contact { index, sphere, point, direction });
        }
        report.contact_count = self.contact.len();
    }

    /// Adds the stop of a freedom at `position` rad if the free motion, at `rate` rad/s, would bring it near
    /// its stop; of a stop that is `pressed`, only the hard part. `last_nm` is the stop's last torque. Must
    /// be called in ascending order of freedoms.
    pub fn collect_stop(
        &mut self,
        (dt, law): (f64, &StopLaw),
        (freedom, pressed): (usize, bool),
        (position, rate): (f64, f64),
        last_nm: f64,
    ) {
        let [soft, hard] = law.near(dt, position, rate, last_nm);
        let parts = soft.filter(|_| !pressed).into_iter().chain(hard);
        self.stop.extend(parts.map(|stop| StopRow::new(freedom, stop)));
    }

    /// Adds both stops of a freedom at `position` rad, wherever it moves. Otherwise like
    /// [`Self::collect_stop`].
    pub fn collect_both_stops(
        &mut self,
        (dt, law): (f64, &StopLaw),
        freedom: usize,
        position: f64,
        last_nm: f64,
    ) {
        for sign in [-1.0, 1.0] {
            let parts = law.side(dt, sign, position, last_nm);
            self.stop.extend(parts.map(|stop| StopRow::new(freedom, stop)));
        }
    }

    /// Returns whether the hard part of a freedom's stop on this side is part of the problem.
    pub fn has_hard_stop(&self, freedom: usize, sign: f64) -> bool {
        self.stop.iter().any(|row| row.freedom == freedom && row.stop.is_hard && row.stop.sign == sign)
    }

    /// Returns whether there is anything to solve.
    pub fn is_empty(&self) -> bool {
        self.row.is_empty() && self.stop.is_empty()
    }

    /// Solves for the impulses. `free` holds the velocities of the freedoms without contact.
    pub fn solve(&mut self, free: &[f64], step: &ContactStep, report: &mut StepReport) {
        let chain = &mut self.chain;
        chain.motions_of(free, &mut self.free_motion);
        let (row, stop) = (&mut self.row[..], &mut self.stop[..]);
        let patch = self.patch;
        let (free_motion, parameters) = (&self.free_motion, step.parameters);
        let outcome = step.arch.dispatch(Problem { chain, row, stop, patch, free_motion, free, parameters });
        report.contact_iterations = outcome.iterations;
        report.contact_residual_m_per_s = outcome.residual;
    }

    /// Adds the impulses of the solution to each link and each freedom.
    pub fn impulses(&self, mut link: impl FnMut(usize, f64, &[f64; N]), mut freedom: impl FnMut(usize, f64)) {
        for row in &self.row {
            for (impulse, force) in row.impulse.iter().zip(&row.force) {
                link(row.link, *impulse, force);
            }
        }
        for StopRow { freedom: k, stop, .. } in &self.stop {
            freedom(*k, stop.sign * stop.impulse);
        }
    }

    /// Returns the result of the `k`-th contact.
    pub fn result(&self, k: usize, dt: f64, rotation: &UnitQuaternion<f64>) -> ContactResult {
        let (contact, impulse) = (&self.contact[k], &self.row[k].impulse);
        let [normal, t0, t1] = contact.direction;
        ContactResult {
            contact_index: contact.index,
            sphere_index: contact.sphere,
            normal: rotation * normal,
            normal_force_n: impulse[0] / dt,
            friction_force_n: rotation * ((t0 * impulse[1] + t1 * impulse[2]) / dt),
        }
    }

    /// Calls `each` with the freedom and the torque of every part of a stop in the solution, for the next
    /// warm start. Returns how many stops carry torque.
    pub fn stop_torques(&self, dt: f64, mut each: impl FnMut(usize, f64)) -> usize {
        for StopRow { freedom, stop, .. } in &self.stop {
            each(*freedom, stop.sign * stop.impulse / dt);
        }
        self.stop.iter().filter(|row| !row.stop.is_hard && row.stop.impulse > 0.0).count()
    }
}

/// The last tick's contacts, and which of them a contact of this tick has already inherited.
pub(super) struct LastContacts<'s> {
    /// Results, ordered by sphere.
    pub results: &'s [ContactResult],
    pub used: &'s mut [bool],
}

impl LastContacts<'_> {
    /// Returns the target velocity of a contact, the part of it that pushes out overlap, and the warm-start
    /// impulse (normal, and along the tangents, base axes).
    pub fn start(
        &mut self,
        step: &ContactStep,
        plane: &ContactPlane,
        tangents: &[Vector3<f64>; 2],
    ) -> ([f64; 2], [f64; 3]) {
        let (mut last, mut impulse) = (0.0, [0.0; 3]);
        if let Some(old) = self.continued_by(plane) {
            let friction = step.drive.rotation.inverse_transform_vector(&old.friction_force_n);
            last = old.normal_force_n;
            impulse = [last, friction.dot(&tangents[0]), friction.dot(&tangents[1])].map(|f| f * step.dt);
        }
        let parameters = step.parameters;
        let explained = last / parameters.stiffness_n_per_m;
        let fastest = parameters.push_out_speed_m_per_s.min(PUSH_OUT_M / step.dt);
        ([target, push_out].map(|of| of(plane.gap_m, explained, fastest, step.dt)), impulse)
    }

    /// Returns the last tick's result that this contact inherits. Each result is used once.
    fn continued_by(&mut self, plane: &ContactPlane) -> Option<&ContactResult> {
        let sphere = plane.sphere_index;
        let start = self.results.partition_point(|r| r.sphere_index < sphere);
        let mut best = None;
        let mut best_cosine = SAME_NORMAL_COSINE;
        for (k, result) in self.results.iter().enumerate().skip(start) {
            if result.sphere_index != sphere {
                break;
            }
            let cosine = result.normal.dot(plane.normal.as_ref());
            if !self.used[k] && cosine > best_cosine {
                best = Some(k);
                best_cosine = cosine;
            }
        }
        best.map(|k| {
            self.used[k] = true;
            &self.results[k]
        })
    }
}
