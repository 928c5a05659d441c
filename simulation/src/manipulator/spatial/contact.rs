//! Contacts and joint stops of a spatial chain: Gauss-Seidel on accumulated impulses, swept along the chain.
//!
//! Each row obeys the same laws as in the planar rung (`manipulator::contact`). No contact matrix is formed: a sweep runs from base to
//! tip, propagates the motion caused by its own impulses across each joint, and relaxes the rows of each link as it passes. One solve at
//! the end of the sweep propagates the effect back toward the base. A sweep therefore costs O(n), whatever the number of contacts.

use nalgebra::{UnitQuaternion, Vector3};

use super::algebra::{Spatial, ZERO, add_scaled, dot, force_at, times};
use super::articulated::Articulated;
use super::coupling::Coupling;
use super::layout::{Configuration, SpatialLayout};
use super::state::SpatialState;
use crate::contact_plane::ContactPlane;
use crate::manipulator::MAX_TENDONS;
use crate::manipulator::contact::{ContactStep, LastContacts, Outcome};
use crate::manipulator::parameters::{ContactParameters, ManipulatorParameters};
use crate::manipulator::pressed::PressedStops;
use crate::manipulator::row::{Stop, cone, search_on, search_share, tangents};
use crate::manipulator::state::ContactResult;

/// One contact.
#[derive(Debug, Clone, Copy)]
pub(super) struct Row {
    pub contact: usize,
    pub sphere: usize,
    pub link: usize,
    pub point: Vector3<f64>,
    /// Normal and tangents, base axes.
    pub direction: [Vector3<f64>; 3],
    /// Unit forces along them at the contact point.
    force: [Spatial; 3],
    friction: f64,
    /// Velocity of the contact point due to the base motion alone.
    drive: [f64; 3],
    compliance: f64,
    target: f64,
    inverse: f64,
    tangential: [f64; 3],
    pub impulse: [f64; 3],
    shift: f64,
    before: [f64; 3],
    direction_of_search: [f64; 3],
}

/// Stop of a bending or lateral coordinate.
#[derive(Debug, Clone, Copy)]
struct FreedomStop {
    freedom: usize,
    stop: Stop,
    /// Motion of the distal link caused by a unit impulse in the joint.
    response: Spatial,
}

/// Workspace of the contact solver.
#[derive(Debug, Clone)]
pub(super) struct ContactSolver {
    pub row: Vec<Row>,
    stop: Vec<FreedomStop>,
    pub refused: usize,
    pub max_overlap_m: f64,
    used: Vec<bool>,
    /// Generalised impulses of the stops, link impulses of the contacts.
    generalised: Vec<f64>,
    link_impulse: Vec<Spatial>,
    /// Generalised velocities under the current impulses, before the sweep, and their search direction.
    pub velocity: Vec<f64>,
    velocity_before: Vec<f64>,
    velocity_direction: Vec<f64>,
    motion: Vec<Spatial>,
}

impl ContactSolver {
    pub fn new(freedoms: usize, links: usize, contacts: usize) -> Self {
        Self {
            row: Vec::with_capacity(contacts),
            stop: Vec::with_capacity(freedoms),
            refused: 0,
            max_overlap_m: 0.0,
            used: vec![false; contacts],
            generalised: vec![0.0; freedoms],
            link_impulse: vec![ZERO; links],
            velocity: vec![0.0; freedoms],
            velocity_before: vec![0.0; freedoms],
            velocity_direction: vec![0.0; freedoms],
            motion: vec![ZERO; links],
        }
    }

    /// Takes the usable contacts, ordered by sphere, then by input order.
    pub fn collect<const D: usize>(
        &mut self,
        layout: &SpatialLayout<D>,
        configuration: &Configuration<D>,
        rotation: &UnitQuaternion<f64>,
        contacts: &[ContactPlane],
    ) {
        self.row.clear();
        self.stop.clear();
        self.max_overlap_m = 0.0;
        let considered = &contacts[..contacts.len().min(self.row.capacity())];
        for (index, contact) in considered.iter().enumerate() {
            let Some(sphere) = layout.spheres.get(contact.sphere_index) else { continue };
            if !contact.is_usable() {
                continue;
            }
            let normal = rotation.inverse_transform_vector(contact.normal.as_ref());
            let [t0, t1] = tangents(&normal);
            let point = configuration.point(sphere.link, sphere.along_m) - normal * sphere.radius_m;
            let direction = [normal, t0, t1];
            self.max_overlap_m = self.max_overlap_m.max(-contact.gap_m);
            self.row.push(Row {
                contact: index,
                sphere: contact.sphere_index,
                link: sphere.link,
                point,
                direction,
                force: direction.map(|d| force_at(&point, &Vector3::zeros(), &d)),
                friction: 0.0,
                drive: [0.0; 3],
                compliance: 0.0,
                target: 0.0,
                inverse: 0.0,
                tangential: [0.0; 3],
                impulse: [0.0; 3],
                shift: 0.0,
                before: [0.0; 3],
                direction_of_search: [0.0; 3],
            });
        }
        self.refused = contacts.len() - self.row.len();
        self.row.sort_unstable_by_key(|row| (row.sphere, row.contact));
    }

    /// Adds a stop for every bending or lateral coordinate that the free motion would bring near its limit.
    pub fn collect_stops<const D: usize>(
        &mut self,
        p: &ManipulatorParameters,
        layout: &SpatialLayout<D>,
        dt: f64,
        state: &SpatialState,
        pressed: &PressedStops,
        free: &[f64],
    ) {
        let law = p.stop_law();
        for joint in 0..layout.joints {
            let bend = layout.bend(joint);
            for k in bend..=if D > 1 { bend + 1 } else { bend } {
                let near = law.near(dt, state.position[k], free[k], state.stop_torque[k]);
                if let Some(stop) = near.filter(|_| !pressed.has(k)) {
                    self.stop.push(FreedomStop { freedom: k, stop, response: ZERO });
                }
            }
        }
    }

    /// Whether there is anything to solve.
    pub fn is_empty(&self) -> bool {
        self.row.is_empty() && self.stop.is_empty()
    }

    /// Completes the rows once the mobilities are known, warm-started with the last tick's impulses.
    pub fn prepare<const D: usize>(
        &mut self,
        step: &ContactStep,
        layout: &SpatialLayout<D>,
        state: &SpatialState,
        articulated: &Articulated,
        coupling: &Coupling,
    ) {
        self.used.fill(false);
        let mut last = LastContacts { results: &state.results[..state.result_count], used: &mut self.used };
        for row in &mut self.row {
            let sphere = &layout.spheres[row.sphere];
            let plane = &step.planes[row.contact];
            let base_velocity = step.drive.linear + step.drive.angular.cross(&row.point);
            row.drive = row.direction.map(|d| d.dot(&base_velocity));
            row.friction = step.parameters.friction_of(sphere.kind);
            row.compliance = step.compliance();
            let mobility = articulated.mobility(layout.freedoms_of(row.link).end);
            let response = row.force.map(|f| times(mobility, &f));
            let along = row.force.map(|f| coupling.takes_up(row.link, &f));
            let entry = |a: usize, b: usize| {
                let coupled = if coupling.active {
                    coupling.product(&along[a], &coupling.weigh(&along[b]))
                } else {
                    0.0
                };
                dot(&row.force[a], &response[b]) - coupled
            };
            row.inverse = 1.0 / (entry(0, 0) + row.compliance);
            row.tangential = [entry(1, 1), entry(1, 2), entry(2, 2)];
            let [_, t0, t1] = row.direction;
            (row.target, row.impulse) = last.start(step, plane, &[t0, t1]);
        }
        for stop in &mut self.stop {
            let (rate, response) = articulated.unit_response(stop.freedom);
            let z = coupling.freedom_response(stop.freedom);
            let w = if coupling.active { coupling.weigh(&z) } else { [0.0; MAX_TENDONS] };
            stop.stop.inverse = 1.0 / (coupling.less(rate, &z, &w) + stop.stop.compliance);
            stop.response = response;
        }
    }

    /// Sweeps until no row changes its velocity by more than the tolerance, or the iteration limit is reached. The solution is in
    /// `velocity` afterwards.
    pub fn solve<const D: usize>(
        &mut self,
        layout: &SpatialLayout<D>,
        articulated: &mut Articulated,
        coupling: &Coupling,
        free: &[f64],
        parameters: &ContactParameters,
    ) -> Outcome {
        let (max_iterations, tolerance) = (parameters.max_iterations, parameters.tolerance_m_per_s);
        self.velocity_direction.fill(0.0);
        self.respond(layout, articulated, coupling, free);
        let mut outcome = Outcome { iterations: 0, residual: 0.0 };
        let mut last = 0.0;
        loop {
            outcome.iterations += 1;
            outcome.residual = 0.0;
            self.keep();
            self.sweep(layout, articulated, coupling, &mut outcome.residual);
            self.respond(layout, articulated, coupling, free);
            if outcome.residual <= tolerance || outcome.iterations >= max_iterations {
                return outcome;
            }
            last = self.accelerate(last);
            articulated.link_motions(layout, &self.velocity, &mut self.motion);
        }
    }

    /// Velocities under the current impulses.
    fn respond<const D: usize>(
        &mut self,
        layout: &SpatialLayout<D>,
        articulated: &mut Articulated,
        coupling: &Coupling,
        free: &[f64],
    ) {
        self.link_impulse.fill(ZERO);
        self.generalised.fill(0.0);
        for row in &self.row {
            for (force, impulse) in row.force.iter().zip(row.impulse) {
                add_scaled(&mut self.link_impulse[row.link], impulse, force);
            }
        }
        for stop in &self.stop {
            self.generalised[stop.freedom] += stop.stop.sign * stop.stop.impulse;
        }
        articulated.solve(layout, Some(&self.link_impulse), &self.generalised, &mut self.velocity);
        coupling.correct(&mut self.velocity);
        for (v, free) in self.velocity.iter_mut().zip(free) {
            *v += free;
        }
        articulated.link_motions(layout, &self.velocity, &mut self.motion);
    }

    fn keep(&mut self) {
        self.row.iter_mut().for_each(|row| row.before = row.impulse);
        self.stop.iter_mut().for_each(|FreedomStop { stop, .. }| stop.before = stop.impulse);
        self.velocity_before.copy_from_slice(&self.velocity);
    }

    /// One sweep from base to tip; `motion` and `velocity` hold the values before it.
    fn sweep<const D: usize>(
        &mut self,
        layout: &SpatialLayout<D>,
        articulated: &Articulated,
        coupling: &Coupling,
        residual: &mut f64,
    ) {
        let (mut carried, mut moving) = (ZERO, false);
        let mut weight = [0.0; MAX_TENDONS];
        let (mut row, mut stop) = (0, 0);
        for link in 0..=layout.joints {
            if row == self.row.len() && stop == self.stop.len() {
                return;
            }
            for k in layout.freedoms_of(link) {
                let rate = if moving { articulated.carry_outward(k, &mut carried) } else { 0.0 };
                if stop < self.stop.len() && self.stop[stop].freedom == k {
                    let z = coupling.freedom_response(k);
                    let rate = coupling.less(self.velocity[k] + rate, &z, &weight);
                    let change = self.stop[stop].stop.relax(rate, residual);
                    add_scaled(&mut carried, change, &self.stop[stop].response);
                    moving |= change != 0.0;
                    if coupling.active {
                        let w = coupling.weigh(&z.map(|z| z * change));
                        weight = core::array::from_fn(|t| weight[t] + w[t]);
                    }
                    stop += 1;
                }
            }
            let mobility = articulated.mobility(layout.freedoms_of(link).end);
            while row < self.row.len() && self.row[row].link == link {
                let mut local = self.motion[link];
                add_scaled(&mut local, 1.0, &carried);
                if coupling.active {
                    for t in 0..coupling.count {
                        add_scaled(&mut local, -weight[t], &coupling.link_response[t][link]);
                    }
                }
                let force = self.row[row].relax(&local, residual);
                if force != ZERO {
                    add_scaled(&mut carried, 1.0, &times(mobility, &force));
                    moving = true;
                    if coupling.active {
                        let w = coupling.weigh(&coupling.takes_up(link, &force));
                        weight = core::array::from_fn(|t| weight[t] + w[t]);
                    }
                }
                row += 1;
            }
        }
    }

    /// Extrapolates along the last sweeps' direction by nonsmooth nonlinear conjugate gradients (see the planar rung).
    fn accelerate(&mut self, last: f64) -> f64 {
        let mut squared = 0.0;
        for row in &self.row {
            let weight = [1.0 / row.inverse, row.tangential[0], row.tangential[2]];
            for j in 0..3 {
                let change = row.impulse[j] - row.before[j];
                squared += weight[j] * change * change;
            }
        }
        for FreedomStop { stop, .. } in &self.stop {
            let change = stop.impulse - stop.before;
            squared += change * change / stop.inverse;
        }
        let share = search_share(squared, last);
        for row in &mut self.row {
            for j in 0..3 {
                search_on(share, &mut row.impulse[j], row.before[j], &mut row.direction_of_search[j]);
            }
        }
        for FreedomStop { stop, .. } in &mut self.stop {
            search_on(share, &mut stop.impulse, stop.before, &mut stop.direction);
        }
        for k in 0..self.velocity.len() {
            let direction = &mut self.velocity_direction[k];
            search_on(share, &mut self.velocity[k], self.velocity_before[k], direction);
        }
        squared
    }

    /// Result of the `k`-th row.
    pub fn result(&self, k: usize, dt: f64, rotation: &UnitQuaternion<f64>) -> ContactResult {
        let row = &self.row[k];
        let friction = row.direction[1] * row.impulse[1] + row.direction[2] * row.impulse[2];
        ContactResult {
            contact_index: row.contact,
            sphere_index: row.sphere,
            normal: rotation * row.direction[0],
            normal_force_n: row.impulse[0] / dt,
            friction_force_n: rotation * (friction / dt),
        }
    }

    /// Writes the solution's stop torques for the next warm start; returns how many stops carry torque.
    pub fn stop_torques(&self, dt: f64, torque: &mut [f64]) -> usize {
        torque.fill(0.0);
        for FreedomStop { freedom, stop, .. } in &self.stop {
            torque[*freedom] = stop.sign * stop.impulse / dt;
        }
        self.stop.iter().filter(|stop| stop.stop.impulse > 0.0).count()
    }
}

impl Row {
    /// Relaxes the contact on a link that moves with `motion`; returns the impulse change as a force on the link.
    fn relax(&mut self, motion: &Spatial, residual: &mut f64) -> Spatial {
        let old = self.impulse;
        let velocity = dot(&self.force[0], motion) + self.drive[0];
        let wanted = self.target - velocity - self.compliance * old[0];
        let normal = (old[0] + wanted * self.inverse).max(0.0);
        *residual = residual.max((normal - old[0]).abs() / self.inverse);
        self.impulse = [normal, 0.0, 0.0];
        let radius = self.friction * normal;
        if radius > 0.0 {
            let [w00, w01, w11] = self.tangential;
            let free = [
                dot(&self.force[1], motion) + self.drive[1] - w00 * old[1] - w01 * old[2],
                dot(&self.force[2], motion) + self.drive[2] - w01 * old[1] - w11 * old[2],
            ];
            let [a, b] = cone(&self.tangential, &free, radius, &mut self.shift);
            *residual = residual.max((w00 * (a - old[1])).abs()).max((w11 * (b - old[2])).abs());
            (self.impulse[1], self.impulse[2]) = (a, b);
        }
        let mut force = ZERO;
        for j in 0..3 {
            add_scaled(&mut force, self.impulse[j] - old[j], &self.force[j]);
        }
        force
    }
}
