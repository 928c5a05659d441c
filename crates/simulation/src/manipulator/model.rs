//! The ladder of manipulator models, behind one trait.

use nalgebra::{Isometry3, Vector3};
use serde::{Deserialize, Serialize};

use super::common::Common;
use super::constant_curvature::ConstantCurvature;
use super::error::ManipulatorError;
use super::moment_modes::{FEW_MODES, MomentModes};
use super::parameters::ManipulatorParameters;
use super::spatial::SpatialChain;
use super::state::{BaseMotion, ContactResult, ManipulatorState, ProxySphere, StepInput, StepReport, Wrench};
use super::tip_jacobian::{LinkMotion, TipJacobian};
use super::validation::validate_base;
use super::{MAX_TENDONS, Manipulator};

/// The manipulator models, from cheapest to most detailed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub enum Rung {
    /// One arc of constant curvature.
    ConstantCurvature,
    /// A chain that bends in one plane, described by a few modes of its bending moment.
    Modal,
    /// A chain that bends in one plane.
    Planar,
    /// A chain that bends in two planes and twists.
    Spatial,
    /// A chain with six degrees of freedom per flexure.
    Full,
}

impl Rung {
    /// All rungs, in order.
    pub const ALL: [Rung; 5] =
        [Rung::ConstantCurvature, Rung::Modal, Rung::Planar, Rung::Spatial, Rung::Full];

    /// Returns the name in scenes and tables.
    pub fn name(self) -> &'static str {
        match self {
            Rung::ConstantCurvature => "constant_curvature",
            Rung::Modal => "modal",
            Rung::Planar => "planar",
            Rung::Spatial => "spatial",
            Rung::Full => "full",
        }
    }
}

/// A manipulator of any rung.
pub trait ManipulatorModel {
    /// Returns the parameters, state and derived data common to all rungs.
    fn common(&self) -> &Common;
    /// Mutable [`Self::common`]; call [`Self::follow_state`] after changing the state.
    fn common_mut(&mut self) -> &mut Common;
    /// Updates the data derived from the state.
    fn follow_state(&mut self);
    /// Advances by `dt_s` (1e-7 to 0.1 s). Unusable contacts are skipped and counted in the report.
    ///
    /// # Errors
    /// The input is not finite or out of range. A rejected step changes nothing.
    fn step(&mut self, dt_s: f64, input: &StepInput) -> Result<StepReport, ManipulatorError>;
    /// Sets the take-up of the tendons to that of the present shape, without a change of friction.
    fn update_take_up(&mut self);
    /// Straightens the tool and puts it at rest, like a pre-curved tool held in a hole or guide.
    fn straighten(&mut self) {
        self.common_mut().straighten();
        self.follow_state();
        self.update_take_up();
    }
    /// Returns the unloaded bend of a flexure at the present deployment from an outer tube, rad.
    fn rest_rad(&self, joint: usize) -> f64;
    /// Returns the pose of the point at `along_m` on the axis of `link` (0 is the shaft at the base origin,
    /// i + 1 is at flexure i), z along the link.
    fn t_world_point(&self, link: usize, along_m: f64) -> Isometry3<f64>;
    /// Returns the kinetic energy relative to the base plus elastic energy of flexures and mount, J.
    fn energy_j(&self) -> f64;
    /// Returns the elastic energy of the joint stops, J.
    fn stop_energy_j(&self) -> f64 {
        self.common().stop_energy_j()
    }
    /// Returns the power that the damping of flexures and mount takes, W.
    fn damping_w(&self) -> f64;
    /// Returns the power that the friction of tendons in their channels takes, W.
    fn tendon_friction_w(&self) -> f64;
    /// Returns the motion of the last link.
    #[doc(hidden)]
    fn tip_motion(&self) -> LinkMotion;
    /// Returns the sum of mass times position relative to the base origin, base axes, kg m.
    fn mass_moment_kg_m(&self) -> Vector3<f64>;

    /// Sets the deployment of a tool from its outer tube, m (initially 0), which determines its springs and
    /// the radius of the covered part. The caller moves the base, which slides with it. Ignored by rungs that
    /// do not support outer tubes.
    fn set_deployed(&mut self, _deployed_m: f64) {}

    /// Returns false while a flexure of a tool in moment modes is beyond its stop ([`MomentModes`]); the
    /// other models remain valid there.
    fn is_valid(&self) -> bool {
        true
    }

    /// Sets whether the burr spins (initially true). A stationary burr has the tube's friction.
    fn set_burr_turns(&mut self, turns: bool) {
        self.common_mut().burr_turns = turns;
    }

    /// Sets the speed by which contacts may violate their law when their solver stops, m/s; returns the
    /// previous one.
    fn set_contact_tolerance(&mut self, m_per_s: f64) -> f64 {
        core::mem::replace(&mut self.common_mut().parameters.contact.tolerance_m_per_s, m_per_s)
    }

    /// Disables SIMD: slower, with the same bits.
    fn use_plain_instructions(&mut self) {
        self.common_mut().arch = pulp::Arch::Scalar;
    }

    /// Returns the complete dynamic state.
    fn state(&self) -> &ManipulatorState {
        &self.common().state
    }

    /// Returns a copy of the complete dynamic state, with room for the contacts of any step.
    fn snapshot(&self) -> ManipulatorState {
        self.common().snapshot()
    }

    /// Copies the complete dynamic state into a snapshot of the same tool, without allocating.
    fn save(&self, into: &mut ManipulatorState) {
        into.copy_from(self.state());
    }

    /// Returns true if a deserialised state belongs to this rung and size.
    fn fits(&self, state: &ManipulatorState) -> bool {
        self.common().fits(state)
    }

    /// Restores a snapshot of a tool of the same rung and parameters; continues bit for bit.
    fn restore(&mut self, state: &ManipulatorState) {
        self.common_mut().state.copy_from(state);
        self.follow_state();
    }

    /// Teleports the base, keeping shape and relative motion. For scene set-up, not for motion.
    ///
    /// # Errors
    /// The base motion is not finite, not a rotation, or out of range.
    fn place_base(&mut self, base: &BaseMotion) -> Result<(), ManipulatorError> {
        validate_base(base)?;
        self.common_mut().state.base = *base;
        self.follow_state();
        Ok(())
    }

    /// Returns the rung.
    fn rung(&self) -> Rung {
        self.state().rung
    }

    /// Returns the tool's parameters.
    fn parameters(&self) -> &ManipulatorParameters {
        &self.common().parameters
    }

    /// Returns the base motion at the end of the last step.
    fn base(&self) -> &BaseMotion {
        &self.state().base
    }

    /// Returns the number of flexures.
    fn joint_count(&self) -> usize {
        self.joint_positions_rad().len()
    }

    /// Returns the bending angles, base to tip, rad.
    fn joint_positions_rad(&self) -> &[f64] {
        &self.common().bend[0]
    }

    /// Returns the bending rates, base to tip, rad/s.
    fn joint_velocities_rad_per_s(&self) -> &[f64] {
        &self.common().bend[1]
    }

    /// Returns the pose of a link, z along it. An index past the last link returns the last link.
    fn t_world_link(&self, link: usize) -> Isometry3<f64> {
        self.t_world_point(link.min(self.joint_count()), 0.0)
    }

    /// Returns the pose of the tip frame: origin at the burr centre, z along the last link.
    fn t_world_tip(&self) -> Isometry3<f64> {
        self.t_world_point(self.joint_count(), self.parameters().tip_offset_m)
    }

    /// Returns the sum of the bending angles, rad.
    fn bend_rad(&self) -> f64 {
        self.joint_positions_rad().iter().sum()
    }

    /// Returns the proxy spheres in the current configuration: shaft, segments, burr.
    fn proxy_spheres(&self) -> &[ProxySphere] {
        &self.common().spheres
    }

    /// Returns the contacts of the last step, ordered by sphere.
    fn contact_results(&self) -> &[ContactResult] {
        &self.state().results
    }

    /// Returns the summary of the last step.
    fn last_report(&self) -> &StepReport {
        &self.state().report
    }

    /// Returns the frequency of the first bending mode of the straight tool on a rigid mount, Hz.
    fn first_natural_frequency_hz(&self) -> f64 {
        self.common().first_frequency_rad_per_s / (2.0 * core::f64::consts::PI)
    }

    /// Returns the derivatives of the pose of the tip, the front of the burr, at rest near the present state:
    /// see [`TipJacobian`].
    fn tip_jacobian(&self) -> TipJacobian {
        let front_m = self.parameters().tip_offset_m + self.parameters().cutter.front_radius_m();
        let (base, tip) = (&self.base().t_world_base, self.t_world_point(self.joint_count(), front_m));
        let point = base.inverse_transform_point(&tip.translation.vector.into());
        self.tip_motion().at(&point.coords, base)
    }

    /// Returns the number of tendons.
    fn tendon_count(&self) -> usize {
        self.parameters().tendon_count()
    }

    /// Returns the tension of each tendon at its proximal end after the last step, N.
    fn tendon_tensions_n(&self) -> [f64; MAX_TENDONS] {
        self.last_report().tendon_tension_n
    }

    /// Returns the pulled length of each tendon after the last step, including its stretch, m.
    fn tendon_displacements_m(&self) -> [f64; MAX_TENDONS] {
        self.last_report().tendon_displacement_m
    }

    /// Returns the wrench of the tool on the flange in the last step: world axes, torque about the base
    /// origin.
    fn flange_wrench(&self) -> Wrench {
        self.last_report().flange_wrench
    }
}

/// Implements the methods that access each rung's own fields.
macro_rules! own_parts {
    () => {
        fn common(&self) -> &Common {
            &self.common
        }

        fn common_mut(&mut self) -> &mut Common {
            &mut self.common
        }

        fn step(&mut self, dt_s: f64, input: &StepInput) -> Result<StepReport, ManipulatorError> {
            self.take_step(dt_s, input)
        }
    };
}
pub(super) use own_parts;

/// A manipulator model chosen at run time.
#[derive(Debug, Clone)]
#[expect(
    clippy::large_enum_variant,
    reason = "one per simulation; boxing would add an indirection to every tick"
)]
pub enum AnyManipulator {
    /// See [`ConstantCurvature`].
    ConstantCurvature(ConstantCurvature),
    /// See [`MomentModes`]: up to five modes.
    FewModes(MomentModes<8>),
    /// See [`MomentModes`]: up to eight modes.
    MoreModes(MomentModes<16>),
    /// See [`Manipulator`].
    Planar(Manipulator),
    /// See [`SpatialChain`].
    Spatial(SpatialChain<3>),
    /// See [`SpatialChain`].
    Full(SpatialChain<6>),
}

impl AnyManipulator {
    /// Creates a tool in its rest shape, at rest on `base`, with slack tendons.
    ///
    /// # Errors
    /// A parameter is out of range, or the rung cannot represent the tool; the error names the parameter.
    pub fn new(
        rung: Rung,
        parameters: ManipulatorParameters,
        base: &BaseMotion,
    ) -> Result<Self, ManipulatorError> {
        Ok(match rung {
            Rung::ConstantCurvature => Self::ConstantCurvature(ConstantCurvature::new(parameters, base)?),
            Rung::Modal if parameters.moment_modes <= FEW_MODES => {
                Self::FewModes(MomentModes::new(parameters, base)?)
            }
            Rung::Modal => Self::MoreModes(MomentModes::new(parameters, base)?),
            Rung::Planar => Self::Planar(Manipulator::new(parameters, base)?),
            Rung::Spatial => Self::Spatial(SpatialChain::new(parameters, base)?),
            Rung::Full => Self::Full(SpatialChain::new(parameters, base)?),
        })
    }

    fn model(&self) -> &dyn ManipulatorModel {
        match self {
            Self::ConstantCurvature(tool) => tool,
            Self::FewModes(tool) => tool,
            Self::MoreModes(tool) => tool,
            Self::Planar(tool) => tool,
            Self::Spatial(tool) => tool,
            Self::Full(tool) => tool,
        }
    }

    fn model_mut(&mut self) -> &mut dyn ManipulatorModel {
        match self {
            Self::ConstantCurvature(tool) => tool,
            Self::FewModes(tool) => tool,
            Self::MoreModes(tool) => tool,
            Self::Planar(tool) => tool,
            Self::Spatial(tool) => tool,
            Self::Full(tool) => tool,
        }
    }
}

impl ManipulatorModel for AnyManipulator {
    fn common(&self) -> &Common {
        self.model().common()
    }

    fn common_mut(&mut self) -> &mut Common {
        self.model_mut().common_mut()
    }

    fn follow_state(&mut self) {
        self.model_mut().follow_state();
    }

    fn step(&mut self, dt_s: f64, input: &StepInput) -> Result<StepReport, ManipulatorError> {
        self.model_mut().step(dt_s, input)
    }

    fn update_take_up(&mut self) {
        self.model_mut().update_take_up();
    }

    fn straighten(&mut self) {
        self.model_mut().straighten();
    }

    fn set_deployed(&mut self, deployed_m: f64) {
        self.model_mut().set_deployed(deployed_m);
    }

    fn is_valid(&self) -> bool {
        self.model().is_valid()
    }

    fn rest_rad(&self, joint: usize) -> f64 {
        self.model().rest_rad(joint)
    }

    fn t_world_point(&self, link: usize, along_m: f64) -> Isometry3<f64> {
        self.model().t_world_point(link, along_m)
    }

    fn energy_j(&self) -> f64 {
        self.model().energy_j()
    }

    fn damping_w(&self) -> f64 {
        self.model().damping_w()
    }

    fn tendon_friction_w(&self) -> f64 {
        self.model().tendon_friction_w()
    }

    fn tip_motion(&self) -> LinkMotion {
        self.model().tip_motion()
    }

    fn mass_moment_kg_m(&self) -> Vector3<f64> {
        self.model().mass_moment_kg_m()
    }
}
