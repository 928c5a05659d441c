//! Data shared by all rungs: parameters, state, and derived quantities.

use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};

use super::MAX_TENDONS;
use super::contact::{BaseDrive, ContactSolver, ContactStep, Operator};
use super::error::{ManipulatorError, check};
use super::geometry::{Planar, SphereKind, SphereLayout, spheres};
use super::loads::Frame;
use super::model::Rung;
use super::parameters::ManipulatorParameters;
use super::state::{BaseMotion, ManipulatorState, ProxySphere, StepInput, StepReport, Wrench};
use super::tendon::{Channels, TendonMemory};
use super::validation::{validate, validate_base};

/// Minimum distance, m, to every contact candidate at the current velocity for a Rosenbrock step.
const CLEARANCE_M: f64 = 50.0e-6;

/// Sizes of a tool's state.
#[derive(Debug, Clone, Copy)]
pub(super) struct StateSizes {
    /// Number of coordinates, including those of the mount.
    pub freedoms: usize,
    /// Number of joint stops whose torque is stored between steps.
    pub stops: usize,
    /// Maximum contacts per step.
    pub contacts: usize,
}

/// Parameters, state and derived quantities, the same for every rung.
#[derive(Debug, Clone)]
pub struct Common {
    pub(super) parameters: ManipulatorParameters,
    pub(super) sphere_layout: Vec<SphereLayout>,
    /// Damping of the mount along base x, y and z, N s/m.
    pub(super) mount_damping: [f64; 3],
    pub(super) first_frequency_rad_per_s: f64,
    /// Whether the burr turns; a stationary burr has the tube's friction.
    pub(super) burr_turns: bool,
    /// SIMD support of this CPU.
    pub(super) arch: pulp::Arch,
    room: StateSizes,
    pub(super) state: ManipulatorState,
    /// Proxy spheres, derived from `state`.
    pub(super) spheres: Vec<ProxySphere>,
    /// Bending angles (rad) and rates (rad/s) of the flexures, base to tip, derived from `state`.
    pub(super) bend: [Vec<f64>; 2],
}

impl Common {
    /// Checks the inputs that every rung is built from.
    ///
    /// # Errors
    /// A parameter or the base motion is out of range; the error names it.
    pub(super) fn check(
        parameters: &ManipulatorParameters,
        base: &BaseMotion,
    ) -> Result<(), ManipulatorError> {
        parameters.validate()?;
        validate_base(base)
    }

    /// Creates a tool with all coordinates at 0, at rest on `base`, with slack tendons.
    pub(super) fn new(
        rung: Rung,
        parameters: ManipulatorParameters,
        base: &BaseMotion,
        total_mass_kg: f64,
        first_frequency_rad_per_s: f64,
        room: StateSizes,
    ) -> Self {
        let joints = parameters.joint_positions_m.len();
        let sphere_layout = spheres(&parameters);
        let blank = |s: &SphereLayout| ProxySphere {
            centre_m: Vector3::zeros(),
            velocity_m_per_s: Vector3::zeros(),
            radius_m: s.radius_m,
            kind: s.kind,
        };
        let ratio = parameters.mount_damping_ratio;
        Self {
            mount_damping: parameters
                .mount_stiffness_n_per_m
                .map(|k| 2.0 * ratio * libm::sqrt(k * total_mass_kg)),
            spheres: sphere_layout.iter().map(blank).collect(),
            sphere_layout,
            first_frequency_rad_per_s,
            burr_turns: true,
            arch: pulp::Arch::new(),
            room,
            state: ManipulatorState {
                rung,
                position: vec![0.0; room.freedoms],
                velocity: vec![0.0; room.freedoms],
                base: *base,
                tendon: [TendonMemory::default(); MAX_TENDONS],
                stop_torque_nm: vec![0.0; room.stops],
                results: Vec::with_capacity(room.contacts),
                report: StepReport::none(),
                energy_ceiling_j: f64::INFINITY,
            },
            bend: [vec![0.0; joints], vec![0.0; joints]],
            parameters,
        }
    }

    /// Returns a copy of the state, with room for the contacts of any step.
    pub(super) fn snapshot(&self) -> ManipulatorState {
        let mut state = self.state.clone();
        state.results.reserve_exact(self.room.contacts - state.results.len());
        state
    }

    /// Returns true if a deserialised state belongs to this rung and size.
    pub(super) fn fits(&self, state: &ManipulatorState) -> bool {
        let StateSizes { freedoms, stops, contacts } = self.room;
        let sizes = [state.position.len(), state.velocity.len(), state.stop_torque_nm.len()];
        state.rung == self.state.rung
            && sizes == [freedoms, freedoms, stops]
            && state.results.len() <= contacts
    }

    /// Returns the damping of the flexures over their stiffness, s.
    pub(super) fn damping_s(&self) -> f64 {
        2.0 * self.parameters.damping_ratio / self.first_frequency_rad_per_s
    }

    /// Returns the elastic energy of the joint stops, J. A rung with a single stop has those of all flexures
    /// in series.
    pub(super) fn stop_energy_j(&self) -> f64 {
        let (law, torques_nm) = (self.parameters.stop_law(), &self.state.stop_torque_nm);
        let in_series = if torques_nm.len() == 1 { self.bend[0].len() as f64 } else { 1.0 };
        let loaded = torques_nm.iter().filter(|torque_nm| **torque_nm != 0.0);
        loaded.map(|torque_nm| law.energy_j(*torque_nm)).sum::<f64>() * in_series
    }

    /// Returns the power that the damping of the mount takes, W.
    pub(super) fn mount_damping_w(&self) -> f64 {
        self.mount_damping.iter().zip(&self.state.velocity).map(|(damping, v)| damping * v * v).sum()
    }

    /// Straightens the tool and stops it. The rung must then follow the state and call [`Self::set_take_up`].
    pub(super) fn straighten(&mut self) {
        self.state.position.fill(0.0);
        self.state.velocity.fill(0.0);
    }

    /// Sets the take-up of each tendon without changing its sliding state.
    pub(super) fn set_take_up(&mut self, channels: &Channels, take_up_m: impl Fn(usize) -> f64) {
        for t in 0..channels.count {
            self.state.tendon[t].take_up_m = take_up_m(t);
        }
    }

    /// Checks the input of a step. Returns the mean base velocity over the step, and the base acceleration
    /// from the stated velocities.
    ///
    /// # Errors
    /// The input is not finite or out of range.
    pub(super) fn begin(&self, dt: f64, input: &StepInput) -> Result<(BaseDrive, Frame), ManipulatorError> {
        validate(dt, input)?;
        let (old, new) = (&self.state.base, &input.base);
        let rotation = old.t_world_base.rotation;
        let to_base = |v: Vector3<f64>| rotation.inverse_transform_vector(&v);
        let moved = (new.t_world_base.translation.vector - old.t_world_base.translation.vector) / dt;
        let turned = (new.t_world_base.rotation * rotation.inverse()).scaled_axis() / dt;
        let allowed = "a pose within one step of the last at no more than 100 m/s and 1000 rad/s";
        check("base.t_world_base speed", libm::sqrt(moved.norm_squared()), allowed, |v| v <= 100.0)?;
        check("base.t_world_base turn", libm::sqrt(turned.norm_squared()), allowed, |v| v <= 1000.0)?;
        let acceleration = (new.linear_velocity_m_per_s - old.linear_velocity_m_per_s) / dt;
        let turn = (new.angular_velocity_rad_per_s - old.angular_velocity_rad_per_s) / dt;
        let drive = BaseDrive { rotation, linear: to_base(moved), angular: to_base(turned) };
        let frame = Frame {
            gravity: to_base(self.parameters.gravity_m_per_s2 - acceleration),
            angular_velocity: to_base(new.angular_velocity_rad_per_s),
            angular_acceleration: to_base(turn),
            tip_wrench: Wrench {
                force_n: to_base(input.tip_wrench.force_n),
                torque_nm: to_base(input.tip_wrench.torque_nm),
            },
        };
        Ok((drive, frame))
    }

    /// Returns true if no sphere reaches its plane within the step at its current velocity. An unusable
    /// contact counts as near, so that the Euler step rejects and counts it.
    pub(super) fn contacts_far(&self, dt: f64, input: &StepInput) -> bool {
        input.contacts.iter().all(|c| {
            let far =
                |s: &ProxySphere| c.end_gap_m(dt) + dt * s.velocity_m_per_s.dot(&c.normal) > CLEARANCE_M;
            c.gap_m > CLEARANCE_M && self.spheres.get(c.sphere_index).is_some_and(far)
        })
    }

    /// Returns true if every sphere clears its plane at its position from `place`, base axes.
    pub(super) fn contacts_clear(
        &self,
        dt: f64,
        input: &StepInput,
        place: impl Fn(&SphereLayout) -> Vector3<f64>,
    ) -> bool {
        input.contacts.iter().all(|c| {
            let local = Point3::from(place(&self.sphere_layout[c.sphere_index]));
            let moved = (input.base.t_world_base * local).coords - self.spheres[c.sphere_index].centre_m;
            c.end_gap_m(dt) + moved.dot(&c.normal) > 0.0
        })
    }

    /// Returns the quantities shared by all contacts of a step.
    pub(super) fn contact_step<'s>(
        &'s self,
        dt: f64,
        drive: &'s BaseDrive,
        input: &StepInput<'s>,
    ) -> ContactStep<'s> {
        ContactStep {
            dt,
            drive,
            planes: input.contacts,
            parameters: &self.parameters.contact,
            spheres: &self.sphere_layout,
            results: &self.state.results,
            burr_turns: self.burr_turns,
            arch: self.arch,
        }
    }

    /// Stores the contact impulses for the next step, and adds their moments about the base origin to
    /// `moment`.
    pub(super) fn store_contacts<const N: usize, O: Operator<N>>(
        &mut self,
        solver: &ContactSolver<N, O>,
        dt: f64,
        drive: &BaseDrive,
        moment: &mut Vector3<f64>,
        report: &mut StepReport,
    ) {
        self.state.results.clear();
        for (k, contact) in solver.contact.iter().enumerate() {
            let result = solver.result(k, dt, &drive.rotation);
            let normal_force = result.normal * result.normal_force_n;
            let force = drive.rotation.inverse_transform_vector(&(normal_force + result.friction_force_n));
            *moment += contact.point.cross(&force);
            report.active_contact_count += usize::from(result.normal_force_n > 0.0);
            if self.sphere_layout[result.sphere_index].kind == SphereKind::Burr {
                report.burr_normal_force_n += normal_force;
            }
            self.state.results.push(result);
        }
    }

    /// Sets the flange reaction, whose force is that of the mount, and the base of the new state. `moment` is
    /// that of all loads about the base origin, minus the change of angular momentum per time.
    pub(super) fn react(&mut self, input: &StepInput, moment: &Vector3<f64>, report: &mut StepReport) {
        let ManipulatorState { position, velocity, .. } = &self.state;
        let mount = |k: usize| {
            self.parameters.mount_stiffness_n_per_m[k] * position[k] + self.mount_damping[k] * velocity[k]
        };
        let force = Vector3::new(mount(0), mount(1), mount(2));
        let rotation = input.base.t_world_base.rotation;
        report.flange_wrench = Wrench { force_n: rotation * force, torque_nm: rotation * moment };
        self.state.base = input.base;
    }

    /// Advances the tendons' sliding states to the new shape, and stores the report.
    pub(super) fn end(
        &mut self,
        input: &StepInput,
        channels: &Channels,
        take_up_m: impl Fn(usize) -> f64,
        report: &mut StepReport,
    ) {
        for t in 0..channels.count {
            (report.tendon_tension_n[t], report.tendon_displacement_m[t]) =
                self.state.tendon[t].advance(take_up_m(t), &channels.cable[t], &input.tendon, t);
        }
        self.state.report = *report;
    }

    /// Copies the bending angles and rates of the flexures from the coordinates given by `index`.
    pub(super) fn copy_bend(&mut self, index: impl Fn(usize) -> usize) {
        for joint in 0..self.bend[0].len() {
            self.bend[0][joint] = self.state.position[index(joint)];
            self.bend[1][joint] = self.state.velocity[index(joint)];
        }
    }

    /// Returns the pose of a point in the bending plane of the tool, turned by `angle` rad.
    pub(super) fn t_world_in_plane(&self, [x, z]: Planar, angle: f64) -> Isometry3<f64> {
        let translation = Translation3::new(x, self.state.position[1], z);
        let rotation = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), angle);
        self.state.base.t_world_base * Isometry3::from_parts(translation, rotation)
    }
}
