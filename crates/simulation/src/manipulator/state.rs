//! Input and output of a step, and the state between steps.

use nalgebra::{Isometry3, Vector3};
use serde::{Deserialize, Serialize};

use crate::contact_plane::ContactPlane;

use super::MAX_TENDONS;
use super::geometry::SphereKind;
use super::model::Rung;
use super::parameters::Integrator;
use super::tendon::TendonMemory;

/// Prescribed motion of the flange.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct BaseMotion {
    /// Pose of the base frame.
    pub t_world_base: Isometry3<f64>,
    /// Velocity of the base origin, world axes, m/s.
    pub linear_velocity_m_per_s: Vector3<f64>,
    /// Angular velocity, world axes, rad/s.
    pub angular_velocity_rad_per_s: Vector3<f64>,
}

impl BaseMotion {
    /// Returns a base at rest.
    pub fn at_rest(t_world_base: Isometry3<f64>) -> Self {
        Self {
            t_world_base,
            linear_velocity_m_per_s: Vector3::zeros(),
            angular_velocity_rad_per_s: Vector3::zeros(),
        }
    }
}

/// Command to the tendon actuators.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum TendonCommand {
    /// Tension of the first two tendons at the proximal end, N; the others are slack. Negative values count
    /// as 0.
    Force([f64; 2]),
    /// Pulled length of the first two tendons at the base, relative to the just-taut straight tool, m; the
    /// others are not pulled. The tension follows from the tendon's stiffness; a slack tendon does not push.
    Displacement([f64; 2]),
    /// Tension of each tendon, N (`servo_jf`).
    EachForce([f64; MAX_TENDONS]),
    /// Pulled length of each tendon, m (`servo_jp`).
    EachDisplacement([f64; MAX_TENDONS]),
}

impl TendonCommand {
    /// Returns the tension or pulled length of each tendon.
    pub(super) fn values(&self) -> [f64; MAX_TENDONS] {
        match *self {
            TendonCommand::Force([a, b]) | TendonCommand::Displacement([a, b]) => [a, b, 0.0, 0.0],
            TendonCommand::EachForce(each) | TendonCommand::EachDisplacement(each) => each,
        }
    }

    /// Returns true if the pulled length is commanded, so that the tension depends on the shape.
    pub(super) fn is_displacement(&self) -> bool {
        matches!(self, TendonCommand::Displacement(_) | TendonCommand::EachDisplacement(_))
    }
}

/// Force and torque, world axes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Wrench {
    /// Force, N.
    pub force_n: Vector3<f64>,
    /// Torque, N m, about a point that depends on the use.
    pub torque_nm: Vector3<f64>,
}

impl Wrench {
    /// Returns a zero wrench.
    pub fn zero() -> Self {
        Self { force_n: Vector3::zeros(), torque_nm: Vector3::zeros() }
    }
}

/// All inputs of one step.
#[derive(Debug, Clone, Copy)]
pub struct StepInput<'a> {
    /// Base motion at the end of the step. Contact uses the mean velocity between the last pose and this one;
    /// inertia uses the change of the stated velocities.
    pub base: BaseMotion,
    /// Tendon command, constant during the step.
    pub tendon: TendonCommand,
    /// External load on the burr centre (dead load), constant during the step.
    pub tip_wrench: Wrench,
    /// Contact candidates in the configuration before the step; those beyond [`super::MAX_CONTACTS`] are
    /// rejected.
    pub contacts: &'a [ContactPlane],
}

/// A sphere that approximates the tool's surface in contact queries.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProxySphere {
    /// Centre, world, m.
    pub centre_m: Vector3<f64>,
    /// Velocity, world, m/s.
    pub velocity_m_per_s: Vector3<f64>,
    /// Radius, m.
    pub radius_m: f64,
    /// The part of the tool that the sphere represents.
    pub kind: SphereKind,
}

/// Result of one contact in the last step.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ContactResult {
    /// Index into [`StepInput::contacts`].
    pub contact_index: usize,
    /// Index of the contact's sphere.
    pub sphere_index: usize,
    /// World-frame normal, from the obstacle to the sphere.
    pub normal: Vector3<f64>,
    /// Mean normal force on the tool over the step, N, never negative. Multiply by dt for the impulse.
    pub normal_force_n: f64,
    /// Mean friction force on the tool over the step, world axes, N.
    pub friction_force_n: Vector3<f64>,
}

/// Summary of one step.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct StepReport {
    /// The method used for this step.
    pub integrator: Integrator,
    /// Error estimate of a Rosenbrock step, largest joint, rad; 0 if none was attempted.
    pub error_estimate_rad: f64,
    /// Number of contacts that entered the solver.
    pub contact_count: usize,
    /// Number of contacts that carried force.
    pub active_contact_count: usize,
    /// Number of rejected contacts: unknown sphere, not finite, or over the limit.
    pub refused_contact_count: usize,
    /// Number of flexures pressing on their stop.
    pub stopped_joint_count: usize,
    /// Number of Newton iterations of the contact solver.
    pub contact_iterations: usize,
    /// Largest speed by which a contact (m/s) or a joint stop (rad/s) violates its law afterwards. Above
    /// [`super::ContactParameters::tolerance_m_per_s`] if the solver stopped at its iteration limit.
    pub contact_residual_m_per_s: f64,
    /// Deepest overlap among the contacts that entered, m.
    pub max_overlap_m: f64,
    /// Total normal force on the burr, world axes, N.
    pub burr_normal_force_n: Vector3<f64>,
    /// Wrench of the tool on the flange; torque about the base origin.
    pub flange_wrench: Wrench,
    /// Tension of each tendon at the proximal end, at the end of the step, N.
    pub tendon_tension_n: [f64; MAX_TENDONS],
    /// Pulled length of each tendon at the end of the step, including its stretch, m.
    pub tendon_displacement_m: [f64; MAX_TENDONS],
}

impl StepReport {
    /// Returns the report before the first step.
    pub(super) fn none() -> Self {
        Self {
            integrator: Integrator::LinearlyImplicitEuler,
            error_estimate_rad: 0.0,
            contact_count: 0,
            active_contact_count: 0,
            refused_contact_count: 0,
            stopped_joint_count: 0,
            contact_iterations: 0,
            contact_residual_m_per_s: 0.0,
            max_overlap_m: 0.0,
            burr_normal_force_n: Vector3::zeros(),
            flange_wrench: Wrench::zero(),
            tendon_tension_n: [0.0; MAX_TENDONS],
            tendon_displacement_m: [0.0; MAX_TENDONS],
        }
    }
}

/// The complete dynamic state of a tool: [`super::ManipulatorModel::restore`] continues from it bit for bit.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ManipulatorState {
    pub(super) rung: Rung,
    /// Displacement relative to the base along base x, y and z, m; then the rung's shape coordinates (flexure
    /// angles in rad for [`super::Manipulator`], whose entries past the last flexure stay 0).
    pub position: Vec<f64>,
    /// Velocities of the coordinates.
    pub velocity: Vec<f64>,
    /// Base motion at the end of the last step.
    pub base: BaseMotion,
    pub(super) tendon: [TendonMemory; MAX_TENDONS],
    /// Torque of each joint stop in the last step, positive toward positive angles, N m. Warm-starts the next
    /// step.
    pub(super) stop_torque_nm: Vec<f64>,
    /// Results of the last step, ordered by sphere. Output, and warm start of the next step.
    pub(super) results: Vec<ContactResult>,
    pub(super) report: StepReport,
    /// Energy ceiling in free motion (spatial rungs), J; infinite after a step that was not free.
    pub(super) energy_ceiling_j: f64,
}

impl ManipulatorState {
    /// Returns the sliding state of each tendon's friction, -1 (let out) to 1 (pulled in).
    pub fn sliding(&self) -> [f64; MAX_TENDONS] {
        self.tendon.map(|memory| memory.sliding)
    }

    /// Returns the wrench of the last step on the flange, about the base origin, world axes.
    pub fn flange_wrench(&self) -> &Wrench {
        &self.report.flange_wrench
    }

    /// Sets the sliding states and the wrench on the flange. The energy ceiling, which bounds free motion
    /// from the state that was left, no longer applies.
    pub fn displace(&mut self, sliding: &[f64; MAX_TENDONS], flange_wrench: &Wrench) {
        for (memory, sliding) in self.tendon.iter_mut().zip(sliding) {
            memory.sliding = *sliding;
        }
        self.report.flange_wrench = *flange_wrench;
        self.energy_ceiling_j = f64::INFINITY;
    }

    /// Copies a state of the same tool without allocating.
    pub(super) fn copy_from(&mut self, other: &Self) {
        let Self {
            rung,
            position,
            velocity,
            base,
            tendon,
            stop_torque_nm,
            results,
            report,
            energy_ceiling_j,
        } = self;
        position.clone_from(&other.position);
        velocity.clone_from(&other.velocity);
        stop_torque_nm.clone_from(&other.stop_torque_nm);
        results.clone_from(&other.results);
        (*rung, *base, *tendon, *report) = (other.rung, other.base, other.tendon, other.report);
        *energy_ceiling_j = other.energy_ceiling_j;
    }
}
