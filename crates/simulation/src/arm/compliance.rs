//! Elastic joints: a spring and a damper between each gearbox and its link. Optional, for scenes that depend
//! on arm compliance.
//!
//! It needs a six-joint arm with known link masses. The links obey `M(q) (v̇ + q̈) + D v + K d = Jᵀ w`,
//! with joint deflection d and its rate v, commanded acceleration q̈, the tool's wrench w on the tool base,
//! and the mass matrix M of the arm's links. One step is linearly implicit Euler, as in the manipulator:
//! `(M + A + h D + h² K) Δv = h (Jᵀ w - K (d + h v) - D v - M q̈)`, `d += h (v + Δv)`. At rest `d = K⁻¹ Jᵀ
//! w`; to first order, the tool base is then displaced by `J K⁻¹ Jᵀ w`.
//!
//! The manipulator's implicit solve takes the base motion as given and returns w in the same tick; the links
//! see w one tick later. The added mass `A = h² Jᵀ Z J` keeps that exchange stable: a force that lags a
//! displacement by one tick with stiffness Z is stable in this scheme if the mass is at least h² Z / 4. Z is
//! the stiffest possible response of the tool: its mount (stiffness and damping) and a contact, at its base
//! and at its tip. A vanishes with h² and does not affect statics.
//!
//! Neglected: gravity on the links (the commanded angles are those of the loaded arm), and velocity products,
//! about 1e-4 of the acceleration terms at drilling speeds.

use super::geometry::ArmGeometry;
use super::kinematics::{Jacobian, Joints, LinkFrames, UR_JOINTS, stack};
use super::models::Link;
use super::{Arm, ArmError};
use nalgebra::{Isometry3, Matrix6, Vector3, Vector6};
use serde::{Deserialize, Serialize};

/// Springs and dampers of the joints, and the tool they carry.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ComplianceParameters {
    /// The arm's links.
    pub links: [Link; UR_JOINTS],
    /// Stiffness of each joint, N m/rad.
    pub stiffness_nm_per_rad: [f64; UR_JOINTS],
    /// Damping of each joint, N m s/rad.
    pub damping_nms_per_rad: [f64; UR_JOINTS],
    /// Upper bound of the tool's stiffness at its base (mount and contact), N/m.
    pub tool_stiffness_n_per_m: f64,
    /// Damping of the tool's mount, N s/m.
    pub tool_damping_n_s_per_m: f64,
    /// Length of the tool along its +z, m.
    pub tool_length_m: f64,
}

/// Joint deflections and their rates.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ComplianceState {
    /// Deflection, positive in the direction of the joint angle, rad.
    pub deflection_rad: Joints,
    /// Deflection rate, rad/s.
    pub rate_rad_s: Joints,
}

/// Motion of the tool's base, patient frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DeflectedBase {
    /// Pose of the tool's base.
    pub t_world_tool: Isometry3<f64>,
    /// Velocity of the origin, m/s.
    pub linear_velocity_m_s: Vector3<f64>,
    /// Angular velocity, rad/s.
    pub angular_velocity_rad_s: Vector3<f64>,
}

/// The elastic joints of an arm.
#[derive(Clone, Debug)]
pub struct Compliance {
    parameters: ComplianceParameters,
    state: ComplianceState,
}

impl Compliance {
    /// Creates the undeflected joints at rest.
    ///
    /// # Errors
    /// A stiffness is not positive, or a damping or tool parameter is negative.
    pub fn new(parameters: ComplianceParameters) -> Result<Self, ArmError> {
        let check = |name: &'static str, values: &[f64], least: f64| match values
            .iter()
            .find(|x| !(**x >= least && x.is_finite()))
        {
            Some(given) => Err(ArmError::InvalidParameter { name, given: *given }),
            None => Ok(()),
        };
        let p = &parameters;
        check("stiffness_nm_per_rad", &p.stiffness_nm_per_rad, f64::MIN_POSITIVE)?;
        check("damping_nms_per_rad", &p.damping_nms_per_rad, 0.0)?;
        let tool = [p.tool_stiffness_n_per_m, p.tool_damping_n_s_per_m, p.tool_length_m];
        check("compliance of the tool", &tool, 0.0)?;
        Ok(Self { parameters, state: ComplianceState::default() })
    }

    /// Returns the deflections and rates.
    pub fn state(&self) -> &ComplianceState {
        &self.state
    }

    /// Restores a state.
    pub fn restore(&mut self, state: &ComplianceState) {
        self.state = *state;
    }

    /// Advances by one tick of the arm, after [`Arm::step`], under the tool's force (N) and torque (N m) on
    /// its base, about the base origin, patient axes.
    ///
    /// # Errors
    /// The mass matrix cannot be factored because the state is not finite.
    pub fn step(
        &mut self,
        arm: &Arm,
        force_n: &Vector3<f64>,
        torque_nm: &Vector3<f64>,
    ) -> Result<(), ArmError> {
        let h = arm.parameters().dt_s;
        let frames = self.frames(arm);
        let mass = mass_matrix(&arm.parameters().geometry, &self.parameters.links, &self.joints(arm));
        let turn = arm.parameters().t_world_arm_base.rotation.inverse();
        let wrench = stack(&(turn * force_n), &(turn * torque_nm));
        let jacobian = of_six(&frames.jacobian());
        let (d, v) = (six(&self.state.deflection_rad), six(&self.state.rate_rad_s));
        let stiffness = Vector6::from(self.parameters.stiffness_nm_per_rad);
        let damping = Vector6::from(self.parameters.damping_nms_per_rad);
        let springs = stiffness.component_mul(&(d + v * h)) + damping.component_mul(&v);
        let commanded = mass * six(&arm.state().qdd_rad_s2);
        let rhs = (jacobian.transpose() * wrench - springs - commanded) * h;
        let mut operator = mass + self.added_mass(&frames, &jacobian, h);
        for i in 0..6 {
            operator[(i, i)] += h * damping[i] + h * h * stiffness[i];
        }
        let factored = operator.cholesky().ok_or(ArmError::ComplianceFailed)?;
        let v = v + factored.solve(&rhs);
        self.state.rate_rad_s = v.push(0.0).into();
        self.state.deflection_rad = (d + v * h).push(0.0).into();
        Ok(())
    }

    /// Returns the motion of the tool's base, including the current deflection.
    pub fn base(&self, arm: &Arm) -> DeflectedBase {
        let frames = self.frames(arm);
        let base = &arm.parameters().t_world_arm_base;
        let rates = six(&arm.state().qd_rad_s) + six(&self.state.rate_rad_s);
        let velocity = of_six(&frames.jacobian()) * rates;
        DeflectedBase {
            t_world_tool: base * frames.t_base_tool(),
            linear_velocity_m_s: base.rotation * velocity.fixed_rows::<3>(0).into_owned(),
            angular_velocity_rad_s: base.rotation * velocity.fixed_rows::<3>(3).into_owned(),
        }
    }

    /// Returns the link angles: commanded angles plus deflection.
    fn joints(&self, arm: &Arm) -> Joints {
        std::array::from_fn(|i| arm.state().q_rad[i] + self.state.deflection_rad[i])
    }

    fn frames(&self, arm: &Arm) -> LinkFrames {
        arm.parameters().geometry.frames(&self.joints(arm))
    }

    /// Returns the added mass h² Jᵀ Z J for the tool's stiffest response at its base and at its tip.
    fn added_mass(&self, frames: &LinkFrames, jacobian: &Matrix6<f64>, h: f64) -> Matrix6<f64> {
        let p = &self.parameters;
        let mass_kg = h * h * p.tool_stiffness_n_per_m + h * p.tool_damping_n_s_per_m;
        let along = frames.rotation[LinkFrames::TOOL].column(2) * p.tool_length_m;
        let linear = jacobian.fixed_rows::<3>(0);
        let at_tip = linear - along.cross_matrix() * jacobian.fixed_rows::<3>(3);
        (linear.transpose() * linear + at_tip.transpose() * at_tip) * mass_kg
    }
}

/// Returns the first six joints as a vector.
fn six(joints: &Joints) -> Vector6<f64> {
    Vector6::from_column_slice(&joints[..UR_JOINTS])
}

fn of_six(jacobian: &Jacobian) -> Matrix6<f64> {
    jacobian.fixed_columns::<UR_JOINTS>(0).into_owned()
}

/// Returns the mass matrix of an arm's links, kg m²: the sum of `m Jvᵀ Jv + Jωᵀ I Jω`. Excludes the tool.
pub fn mass_matrix(geometry: &ArmGeometry, links: &[Link; UR_JOINTS], q_rad: &Joints) -> Matrix6<f64> {
    let frames = geometry.with_tool(None).frames(q_rad);
    let mut mass = Matrix6::zeros();
    for (index, link) in links.iter().enumerate() {
        let rotation = frames.rotation[index + 1];
        let centre = frames.origin_m[index + 1] + rotation * Vector3::from(link.centre_m);
        let mut linear = nalgebra::Matrix3x6::zeros();
        let mut angular = nalgebra::Matrix3x6::zeros();
        for joint in 0..=index {
            let axis: Vector3<f64> = frames.rotation[joint].column(2).into_owned();
            linear.set_column(joint, &axis.cross(&(centre - frames.origin_m[joint])));
            angular.set_column(joint, &axis);
        }
        let inertia = rotation * link.inertia() * rotation.transpose();
        mass += linear.transpose() * linear * link.mass_kg + angular.transpose() * inertia * angular;
    }
    mass
}
