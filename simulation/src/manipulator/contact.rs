//! Contacts and joint stops: block Gauss-Seidel on accumulated impulses in probe space, accelerated by conjugate gradients.
//!
//! A normal row requires `v_n + P / (k_c dt^2) >= -gap / dt`: the sphere may close its gap within the step (speculative contact), and at
//! rest the overlap equals force / k_c. Any overlap beyond what the last contact force explains is pushed out at a bounded speed. Coulomb
//! friction is solved exactly per contact: the impulse either stops the sliding or lies on the circle mu P_n and opposes the remaining
//! sliding.

mod sweep;

use nalgebra::{UnitQuaternion, Vector3};

use super::articulated::{Generalised, Spatial};
use super::delassus::Delassus;
use super::geometry::{Configuration, Layout, SphereKind};
use super::parameters::{ContactParameters, ManipulatorParameters};
use super::pressed::PressedStops;
use super::row::{EMPTY_ROW, EMPTY_STOP, Row, Stop, target};
use super::state::{ContactResult, ManipulatorState};
use super::{MAX_CONTACTS, MAX_JOINTS, MAX_ROWS, MAX_SPHERES};
use crate::contact_plane::ContactPlane;

/// A contact inherits the last tick's impulses if it is on the same sphere and the cosine between the two normals exceeds this.
const SAME_NORMAL_COSINE: f64 = 0.9;

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
}

impl ContactStep<'_> {
    /// 1 / (k_c dt^2).
    pub fn compliance(&self) -> f64 {
        1.0 / (self.parameters.stiffness_n_per_m * self.dt * self.dt)
    }
}

impl ContactParameters {
    /// Coulomb coefficient of a sphere.
    pub(super) fn friction_of(&self, kind: SphereKind) -> f64 {
        match kind {
            SphereKind::Burr => self.burr_friction_coefficient,
            _ => self.friction_coefficient,
        }
    }
}

/// How the contact solve ended.
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
    /// SIMD support of this CPU.
    pub arch: pulp::Arch,
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

    /// Takes the usable contacts with their probes, ordered by sphere, then by input order.
    pub fn collect(&mut self, layout: &Layout, configuration: &Configuration, contacts: &[ContactPlane]) {
        self.delassus.clear();
        self.row_count = 0;
        self.max_overlap_m = 0.0;
        let mut counts = [0usize; MAX_SPHERES + 1];
        let mut accepted = 0;
        let usable = |c: &ContactPlane| c.sphere_index < layout.spheres.len() && c.is_usable();
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

    /// Adds a stop row for every flexure that the free motion would bring near its stop, unless the stop is already pressed.
    pub fn collect_stops(
        &mut self,
        p: &ManipulatorParameters,
        dt: f64,
        state: &ManipulatorState,
        pressed: &PressedStops,
        free: &Generalised,
    ) {
        let law = p.stop_law();
        for i in (0..p.joint_positions_m.len()).filter(|i| !pressed.has(*i)) {
            let (q, last) = (state.joint_position_rad[i], state.stop_torque_nm[i]);
            let Some(stop) = law.near(dt, q, free.joint[i], last) else { continue };
            self.stop[self.delassus.joint_count] = stop;
            self.delassus.add_joint(i);
        }
    }

    /// Whether there is anything to solve.
    pub fn is_empty(&self) -> bool {
        self.row_count == 0 && self.delassus.joint_count == 0
    }

    /// Completes the rows once R is known, warm-started with the last tick's impulses. `lateral` is the out-of-plane mobility, 1/kg.
    pub fn prepare(&mut self, step: &ContactStep, layout: &Layout, lateral: f64, state: &ManipulatorState) {
        let drive = step.drive;
        let mut used = [false; MAX_CONTACTS];
        let mut last = LastContacts { results: &state.results[..state.result_count], used: &mut used };
        for k in 0..self.row_count {
            let mut row = self.row[k];
            let plane = &step.planes[row.contact];
            let normal = drive.rotation.inverse_transform_vector(plane.normal.as_ref());
            let sphere = &layout.spheres[row.sphere];
            let tangents = row.orient(&normal, sphere.radius_m);
            let centre = self.delassus.centre(row.probe);
            let lateral_m = state.mount_displacement_m[1];
            let point = Vector3::new(centre[0], lateral_m, centre[1]) - normal * sphere.radius_m;
            let base_velocity = drive.linear + drive.angular.cross(&point);
            row.drive = [normal, tangents[0], tangents[1]].map(|d| d.dot(&base_velocity));
            row.friction = step.parameters.friction_of(sphere.kind);
            row.compliance = step.compliance();
            row.inverse =
                1.0 / (self.mobility(row.probe, lateral, &row.normal, &row.normal) + row.compliance);
            let [t0, t1] = &row.tangent;
            row.tangential = [
                self.mobility(row.probe, lateral, t0, t0),
                self.mobility(row.probe, lateral, t0, t1),
                self.mobility(row.probe, lateral, t1, t1),
            ];
            (row.target, row.impulse) = last.start(step, plane, &tangents);
            self.row[k] = row;
        }
        for k in 0..self.delassus.joint_count {
            let row = 3 * self.delassus.sphere_count + k;
            self.stop[k].inverse = 1.0 / (self.delassus.column(row)[row] + self.stop[k].compliance);
        }
    }

    /// a' R b at one sphere, including the out-of-plane mobility.
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

    /// Link and joint impulses of the solution; `lateral_impulse` is the out-of-plane component.
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

    /// Writes the solution's stop torques for the next warm start; returns how many stops carry torque.
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

/// The last tick's contacts, and which of them a contact of this tick has already inherited.
pub(super) struct LastContacts<'s> {
    /// Ordered by sphere.
    pub results: &'s [ContactResult],
    pub used: &'s mut [bool],
}

impl LastContacts<'_> {
    /// Target velocity and warm-start impulse of a contact (normal, and along the tangents, base axes).
    pub fn start(
        &mut self,
        step: &ContactStep,
        plane: &ContactPlane,
        tangents: &[Vector3<f64>; 2],
    ) -> (f64, [f64; 3]) {
        let (mut last, mut impulse) = (0.0, [0.0; 3]);
        if let Some(old) = self.continued_by(plane) {
            let friction = step.drive.rotation.inverse_transform_vector(&old.friction_force_n);
            last = old.normal_force_n;
            impulse = [last, friction.dot(&tangents[0]), friction.dot(&tangents[1])].map(|f| f * step.dt);
        }
        let parameters = step.parameters;
        let explained = last / parameters.stiffness_n_per_m;
        (target(plane.gap_m, explained, parameters.push_out_speed_m_per_s, step.dt), impulse)
    }

    /// The last tick's result that this contact inherits. Each result is used once.
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
