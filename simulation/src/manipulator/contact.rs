//! Contacts and joint stops: block Gauss-Seidel on accumulated impulses, in probe space, sped up by conjugate gradients.
//!
//! A normal row asks for `v_n + P / (k_c dt^2) >= -gap / dt`: the sphere may use up its gap within the step
//! (speculative contact), and at rest the overlap is force / k_c. An overlap that the contact's last force does not
//! explain is pushed out at a bounded speed. Friction is Coulomb's cone, solved exactly per contact: the impulse is
//! what stops the sliding, or lies on the circle mu P_n against the sliding that remains.

use nalgebra::{UnitQuaternion, Vector3};

use super::articulated::{Articulated, Generalised, Spatial};
use super::delassus::Delassus;
use super::geometry::{Configuration, Layout, SphereKind};
use super::parameters::ManipulatorParameters;
use super::pressed::PressedStops;
use super::row::{EMPTY_ROW, EMPTY_STOP, Row, Stop, target};
use super::state::{ContactResult, ManipulatorState};
use super::{MAX_CONTACTS, MAX_JOINTS, MAX_ROWS, MAX_SPHERES};
use crate::contact_plane::ContactPlane;

/// Contacts of the last tick continue those of this one if their sphere is the same and the normals' cosine is above
/// this.
const SAME_NORMAL_COSINE: f64 = 0.9;
/// A flexure enters the solver when the free step would bring it beyond this share of its stop.
pub(super) const STOP_SHARE: f64 = 0.9;
/// Fastest return of a flexure that is past its stop, rad/s.
pub(super) const STOP_RETURN_RAD_PER_S: f64 = 5.0;

/// How the base frame moves in this step, base axes.
#[derive(Debug, Clone, Copy)]
pub(super) struct BaseDrive {
    /// World from base before the step.
    pub rotation: UnitQuaternion<f64>,
    /// Mean velocity of the base origin, m/s.
    pub linear: Vector3<f64>,
    /// Mean angular velocity, rad/s.
    pub angular: Vector3<f64>,
}

/// How the solver ended.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Outcome {
    pub iterations: usize,
    pub residual: f64,
}

/// Workspace of the contact solver.
#[derive(Debug, Clone)]
pub(super) struct ContactSolver {
    pub delassus: Delassus,
    row: [Row; MAX_CONTACTS],
    /// First row of each sphere probe, and the number of rows after the last.
    first_row: [usize; MAX_SPHERES + 1],
    pub row_count: usize,
    pub refused: usize,
    pub max_overlap_m: f64,
    stop: [Stop; MAX_JOINTS],
    velocity: [f64; MAX_ROWS],
    lateral_velocity: f64,
    velocity_before: [f64; MAX_ROWS],
    lateral_before: f64,
    velocity_direction: [f64; MAX_ROWS],
    lateral_direction: f64,
    impulse: [f64; MAX_ROWS],
    pub lateral_impulse: f64,
    /// The machine's vector instructions.
    pub arch: pulp::Arch,
}

/// [`ContactSolver::solve`], compiled for each instruction set; no bit depends on it, as no operation is reordered or fused.
struct Solve<'a> {
    solver: &'a mut ContactSolver,
    articulated: &'a Articulated,
    free: &'a Generalised,
    limits: (usize, f64),
}

impl pulp::WithSimd for Solve<'_> {
    type Output = Outcome;

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) -> Outcome {
        self.solver.sweep(self.articulated, self.free, self.limits)
    }
}

impl ContactSolver {
    pub fn new() -> Self {
        Self {
            delassus: Delassus::new(),
            row: [EMPTY_ROW; MAX_CONTACTS],
            first_row: [0; MAX_SPHERES + 1],
            row_count: 0,
            refused: 0,
            max_overlap_m: 0.0,
            stop: [EMPTY_STOP; MAX_JOINTS],
            velocity: [0.0; MAX_ROWS],
            lateral_velocity: 0.0,
            velocity_before: [0.0; MAX_ROWS],
            lateral_before: 0.0,
            velocity_direction: [0.0; MAX_ROWS],
            lateral_direction: 0.0,
            impulse: [0.0; MAX_ROWS],
            lateral_impulse: 0.0,
            arch: pulp::Arch::new(),
        }
    }

    /// Accepts the usable contacts, ordered by sphere (then by input order), with their probes.
    pub fn collect(&mut self, layout: &Layout, configuration: &Configuration, contacts: &[ContactPlane]) {
        self.delassus.clear();
        self.row_count = 0;
        self.max_overlap_m = 0.0;
        let mut counts = [0usize; MAX_SPHERES + 1];
        let mut accepted = 0;
        let usable = |c: &ContactPlane| {
            let n = c.normal.as_ref();
            c.sphere_index < layout.spheres.len()
                && c.gap_m.is_finite()
                && (n.norm_squared() - 1.0).abs() < 1e-6
        };
        let considered = &contacts[..contacts.len().min(MAX_CONTACTS)];
        for contact in considered.iter().filter(|c| usable(c)) {
            counts[contact.sphere_index + 1] += 1;
            accepted += 1;
        }
        self.refused = contacts.len() - accepted;
        for s in 0..MAX_SPHERES {
            if counts[s + 1] > 0 {
                self.delassus.add_sphere(layout, configuration, s);
            }
            counts[s + 1] += counts[s];
        }
        for (index, contact) in considered.iter().enumerate().filter(|(_, c)| usable(c)) {
            let place = &mut counts[contact.sphere_index];
            self.row[*place] = Row { contact: index, sphere: contact.sphere_index, ..EMPTY_ROW };
            *place += 1;
            self.max_overlap_m = self.max_overlap_m.max(-contact.gap_m);
        }
        self.row_count = accepted;
        let mut probe = 0;
        for k in 0..accepted {
            if k > 0 && self.row[k].sphere != self.row[k - 1].sphere {
                probe += 1;
                self.first_row[probe] = k;
            }
            self.row[k].probe = probe;
        }
        self.first_row[self.delassus.sphere_count] = accepted;
    }

    /// Adds a stop row for every flexure that the free motion would bring near its stop, if that is not pressed.
    pub fn collect_stops(
        &mut self,
        p: &ManipulatorParameters,
        dt: f64,
        (state, pressed): (&ManipulatorState, &PressedStops),
        free: &Generalised,
    ) {
        let limit = p.joint_limit_rad;
        for i in 0..p.joint_positions_m.len() {
            let q = state.joint_position_rad[i];
            let predicted = q + dt * free.joint[i];
            if predicted.abs().max(q.abs()) <= STOP_SHARE * limit || pressed.has(i) {
                continue;
            }
            let sign = if predicted > 0.0 { -1.0 } else { 1.0 };
            let stiffness = p.joint_stop_stiffness_nm_per_rad;
            let last = (sign * state.stop_torque_nm[i]).max(0.0);
            self.stop[self.delassus.joint_count] = Stop {
                sign,
                compliance: 1.0 / (stiffness * dt * dt),
                target: target(limit + sign * q, last / stiffness, STOP_RETURN_RAD_PER_S, dt),
                impulse: last * dt,
                ..EMPTY_STOP
            };
            self.delassus.add_joint(i);
        }
    }

    /// Whether there is anything to solve.
    pub fn is_empty(&self) -> bool {
        self.row_count == 0 && self.delassus.joint_count == 0
    }

    /// Completes the rows once R is known, with the impulses of the last tick as the start.
    pub fn prepare(
        &mut self,
        p: &ManipulatorParameters,
        layout: &Layout,
        (dt, drive, lateral): (f64, &BaseDrive, f64),
        contacts: &[ContactPlane],
        state: &ManipulatorState,
    ) {
        let mut used = [false; MAX_CONTACTS];
        let stiffness = p.contact.stiffness_n_per_m;
        for k in 0..self.row_count {
            let mut row = self.row[k];
            let contact = &contacts[row.contact];
            let normal = drive.rotation.inverse_transform_vector(contact.normal.as_ref());
            let sphere = &layout.spheres[row.sphere];
            let tangents = row.orient(&normal, sphere.radius_m);
            let centre = self.delassus.centre(row.probe);
            let lateral_m = state.mount_displacement_m[1];
            let point = Vector3::new(centre[0], lateral_m, centre[1]) - normal * sphere.radius_m;
            let base_velocity = drive.linear + drive.angular.cross(&point);
            row.drive = [normal, tangents[0], tangents[1]].map(|d| d.dot(&base_velocity));
            row.friction = match sphere.kind {
                SphereKind::Burr => p.contact.burr_friction_coefficient,
                _ => p.contact.friction_coefficient,
            };
            row.compliance = 1.0 / (stiffness * dt * dt);
            row.inverse =
                1.0 / (self.mobility(row.probe, lateral, &row.normal, &row.normal) + row.compliance);
            let [t0, t1] = &row.tangent;
            row.tangential = [
                self.mobility(row.probe, lateral, t0, t0),
                self.mobility(row.probe, lateral, t0, t1),
                self.mobility(row.probe, lateral, t1, t1),
            ];
            let mut last = 0.0;
            if let Some(old) =
                previous(&state.results[..state.result_count], &mut used, row.sphere, contact.normal.as_ref())
            {
                let friction = drive.rotation.inverse_transform_vector(&old.friction_force_n);
                last = old.normal_force_n;
                row.impulse = [last * dt, friction.dot(&tangents[0]) * dt, friction.dot(&tangents[1]) * dt];
            }
            row.target = target(contact.gap_m, last / stiffness, p.contact.push_out_speed_m_per_s, dt);
            self.row[k] = row;
        }
        for k in 0..self.delassus.joint_count {
            let row = 3 * self.delassus.sphere_count + k;
            self.stop[k].inverse = 1.0 / (self.delassus.column(row)[row] + self.stop[k].compliance);
        }
    }

    /// a' R b at one sphere, the out-of-plane mobility included.
    fn mobility(&self, probe: usize, lateral: f64, a: &[f64; 4], b: &[f64; 4]) -> f64 {
        let mut sum = lateral * a[3] * b[3];
        for i in 0..3 {
            let column = self.delassus.column(3 * probe + i);
            for j in 0..3 {
                sum += a[i] * column[3 * probe + j] * b[j];
            }
        }
        sum
    }

    /// Sweeps until no row changes its velocity by more than `tolerance`, at most `max_iterations` times.
    pub fn solve(
        &mut self,
        articulated: &Articulated,
        free: &Generalised,
        (max_iterations, tolerance): (usize, f64),
    ) -> Outcome {
        self.arch.dispatch(Solve { solver: self, articulated, free, limits: (max_iterations, tolerance) })
    }

    #[inline(always)]
    fn sweep(
        &mut self,
        articulated: &Articulated,
        free: &Generalised,
        (max_iterations, tolerance): (usize, f64),
    ) -> Outcome {
        let lateral = articulated.lateral;
        self.delassus.velocities(articulated, free, &mut self.velocity);
        self.lateral_velocity = free.mount[1];
        self.apply_start(lateral);
        self.velocity_direction.fill(0.0);
        self.lateral_direction = 0.0;
        let mut outcome = Outcome { iterations: 0, residual: 0.0 };
        let mut last = 0.0;
        while outcome.iterations < max_iterations {
            outcome.iterations += 1;
            outcome.residual = 0.0;
            self.keep();
            for probe in 0..self.delassus.sphere_count {
                self.relax_sphere(probe, lateral, &mut outcome.residual);
            }
            for k in 0..self.delassus.joint_count {
                self.relax_stop(k, &mut outcome.residual);
            }
            if outcome.residual <= tolerance || outcome.iterations == max_iterations {
                break;
            }
            last = self.accelerate(last);
        }
        self.accumulate();
        outcome
    }

    /// Applies the start impulses to the probe velocities.
    #[inline(always)]
    fn apply_start(&mut self, lateral: f64) {
        self.accumulate();
        for row in 0..self.delassus.rows() {
            let impulse = self.impulse[row];
            if impulse != 0.0 {
                add_scaled(&mut self.velocity, impulse, self.delassus.column(row));
            }
        }
        self.lateral_velocity += lateral * self.lateral_impulse;
    }

    /// Sums the row impulses by probe.
    #[inline(always)]
    fn accumulate(&mut self) {
        let rows = self.delassus.rows();
        self.impulse[..rows].fill(0.0);
        self.lateral_impulse = 0.0;
        for row in &self.row[..self.row_count] {
            let sum = row.combined(&row.impulse);
            for j in 0..3 {
                self.impulse[3 * row.probe + j] += sum[j];
            }
            self.lateral_impulse += sum[3];
        }
        for k in 0..self.delassus.joint_count {
            self.impulse[3 * self.delassus.sphere_count + k] = self.stop[k].sign * self.stop[k].impulse;
        }
    }

    /// Remembers impulses and velocities before a sweep.
    #[inline(always)]
    fn keep(&mut self) {
        for row in &mut self.row[..self.row_count] {
            row.before = row.impulse;
        }
        for stop in &mut self.stop[..self.delassus.joint_count] {
            stop.before = stop.impulse;
        }
        let rows = self.delassus.rows();
        self.velocity_before[..rows].copy_from_slice(&self.velocity[..rows]);
        self.lateral_before = self.lateral_velocity;
    }

    /// Goes on along the last sweeps' direction: nonsmooth nonlinear conjugate gradients on the sweep (Silcowitz,
    /// Niebe, Erleben 2010, "A nonsmooth nonlinear conjugate gradient method for interactive contact force problems",
    /// Visual Computer 26). `last` is the squared gradient of the sweep before, 0 at the start; returns this one's.
    #[inline(always)]
    fn accelerate(&mut self, last: f64) -> f64 {
        let mut squared = 0.0;
        for row in &self.row[..self.row_count] {
            let weight = [1.0 / row.inverse, row.tangential[0], row.tangential[2]];
            for j in 0..3 {
                let change = row.impulse[j] - row.before[j];
                squared += weight[j] * change * change;
            }
        }
        for stop in &self.stop[..self.delassus.joint_count] {
            let change = stop.impulse - stop.before;
            squared += change * change / stop.inverse;
        }
        let beta = if last > 0.0 && squared <= last { squared / last } else { 0.0 };
        for row in &mut self.row[..self.row_count] {
            for j in 0..3 {
                let change = row.impulse[j] - row.before[j];
                row.impulse[j] += beta * row.direction[j];
                row.direction[j] = beta * row.direction[j] + change;
            }
        }
        for stop in &mut self.stop[..self.delassus.joint_count] {
            let change = stop.impulse - stop.before;
            stop.impulse += beta * stop.direction;
            stop.direction = beta * stop.direction + change;
        }
        for k in 0..self.delassus.rows() {
            let change = self.velocity[k] - self.velocity_before[k];
            self.velocity[k] += beta * self.velocity_direction[k];
            self.velocity_direction[k] = beta * self.velocity_direction[k] + change;
        }
        let change = self.lateral_velocity - self.lateral_before;
        self.lateral_velocity += beta * self.lateral_direction;
        self.lateral_direction = beta * self.lateral_direction + change;
        squared
    }

    /// Relaxes all contacts of one sphere probe.
    #[inline(always)]
    fn relax_sphere(&mut self, probe: usize, lateral: f64, residual: &mut f64) {
        let base = 3 * probe;
        let block = [0, 1, 2].map(|i| {
            let column = self.delassus.column(base + i);
            [column[base], column[base + 1], column[base + 2]]
        });
        let v = &self.velocity;
        let mut local = [v[base], v[base + 1], v[base + 2], self.lateral_velocity];
        let mut total = [0.0; 4];
        let (first, end) = (self.first_row[probe], self.first_row[probe + 1]);
        for row in &mut self.row[first..end] {
            let before = row.impulse;
            row.relax(&local, residual);
            let change = [0, 1, 2].map(|j| row.impulse[j] - before[j]);
            if change != [0.0; 3] {
                let step = row.combined(&change);
                for i in 0..3 {
                    total[i] += step[i];
                    for j in 0..3 {
                        local[j] += block[i][j] * step[i];
                    }
                }
                total[3] += step[3];
                local[3] += lateral * step[3];
            }
        }
        if total != [0.0; 4] {
            let [x, y, z] = [0, 1, 2].map(|i| self.delassus.column(base + i));
            for (v, ((x, y), z)) in self.velocity.iter_mut().zip(x.iter().zip(y).zip(z)) {
                *v = *v + total[0] * x + total[1] * y + total[2] * z;
            }
            self.lateral_velocity += lateral * total[3];
        }
    }

    #[inline(always)]
    fn relax_stop(&mut self, k: usize, residual: &mut f64) {
        let row = 3 * self.delassus.sphere_count + k;
        let stop = &mut self.stop[k];
        let change = stop.relax(self.velocity[row], residual);
        if change != 0.0 {
            add_scaled(&mut self.velocity, change, self.delassus.column(row));
        }
    }

    /// Link and joint impulses of the solution; the out-of-plane one is `lateral_impulse`.
    pub fn impulses(&self, force: &mut [Spatial; MAX_JOINTS + 1], joint: &mut [f64; MAX_JOINTS]) {
        self.delassus.scatter(&self.impulse, force, joint);
    }

    /// Result of the `k`-th row, and the contact point, base axes.
    pub fn result(
        &self,
        layout: &Layout,
        k: usize,
        dt: f64,
        rotation: &UnitQuaternion<f64>,
        lateral_m: f64,
    ) -> (ContactResult, Vector3<f64>) {
        let row = &self.row[k];
        let direction = |d: &[f64; 4]| Vector3::new(d[1], d[3], d[2]);
        let normal = direction(&row.normal);
        let friction =
            direction(&row.tangent[0]) * row.impulse[1] + direction(&row.tangent[1]) * row.impulse[2];
        let centre = self.delassus.centre(row.probe);
        let point =
            Vector3::new(centre[0], lateral_m, centre[1]) - normal * layout.spheres[row.sphere].radius_m;
        let result = ContactResult {
            contact_index: row.contact,
            sphere_index: row.sphere,
            normal: rotation * normal,
            normal_force_n: row.impulse[0] / dt,
            friction_force_n: rotation * (friction / dt),
        };
        (result, point)
    }

    /// Stop torques of the solution, for the next warm start; returns how many stops carry torque.
    pub fn stop_torques(&self, dt: f64, torque: &mut [f64; MAX_JOINTS]) -> usize {
        let mut count = 0;
        torque.fill(0.0);
        for k in 0..self.delassus.joint_count {
            torque[self.delassus.joint[k]] = self.stop[k].sign * self.stop[k].impulse / dt;
            count += usize::from(self.stop[k].impulse > 0.0);
        }
        count
    }
}

/// velocity += scale column.
#[inline(always)]
fn add_scaled(velocity: &mut [f64; MAX_ROWS], scale: f64, column: &[f64]) {
    for (v, c) in velocity.iter_mut().zip(column) {
        *v += scale * c;
    }
}

/// The result of the last tick that this contact continues, each used once.
pub(super) fn previous<'a>(
    results: &'a [ContactResult],
    used: &mut [bool],
    sphere: usize,
    normal: &Vector3<f64>,
) -> Option<&'a ContactResult> {
    let start = results.partition_point(|r| r.sphere_index < sphere);
    let mut best = None;
    let mut best_cosine = SAME_NORMAL_COSINE;
    for (k, result) in results.iter().enumerate().skip(start) {
        if result.sphere_index != sphere {
            break;
        }
        let cosine = result.normal.dot(normal);
        if !used[k] && cosine > best_cosine {
            best = Some(k);
            best_cosine = cosine;
        }
    }
    best.map(|k| {
        used[k] = true;
        &results[k]
    })
}
