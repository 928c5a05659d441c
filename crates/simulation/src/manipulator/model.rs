//! The ladder of manipulator models behind one trait.

use nalgebra::Isometry3;
use serde::{Deserialize, Serialize};

use super::constant_curvature::{ConstantCurvature, ConstantCurvatureState};
use super::error::ManipulatorError;
use super::moment_modes::{FEW_MODES, MomentModes, MomentModesState};
use super::parameters::ManipulatorParameters;
use super::spatial::{SpatialChain, SpatialState};
use super::state::{BaseMotion, ContactResult, ManipulatorState, ProxySphere, StepInput, StepReport, Wrench};
use super::{MAX_JOINTS, MAX_TENDONS, Manipulator};

/// The rungs of the ladder, from cheapest to most detailed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Rung {
    /// One arc of constant curvature.
    ConstantCurvature,
    /// A chain that bends in one plane, in a few modes of its bending moment.
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

    /// Name in scenes and tables.
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

/// Common interface of all rungs. [`Manipulator`] documents each function and its errors.
pub trait ManipulatorModel {
    /// The complete dynamic state.
    type State: Clone + PartialEq + core::fmt::Debug;

    /// Advances by `dt_s`.
    ///
    /// # Errors
    /// The input is not finite or out of range. A refused step changes nothing.
    fn step(&mut self, dt_s: f64, input: &StepInput) -> Result<StepReport, ManipulatorError>;
    /// A copy of the complete dynamic state.
    fn snapshot(&self) -> Self::State;
    /// Continues bit for bit from a snapshot of a tool with the same parameters.
    fn restore(&mut self, state: &Self::State);
    /// Teleports the base.
    ///
    /// # Errors
    /// The base motion is not finite, not a rotation, or out of range.
    fn place_base(&mut self, base: &BaseMotion) -> Result<(), ManipulatorError>;
    /// The parameters the tool was built from.
    fn parameters(&self) -> &ManipulatorParameters;
    /// Base motion at the end of the last step.
    fn base(&self) -> &BaseMotion;
    /// Number of flexures.
    fn joint_count(&self) -> usize;
    /// Bending angles, base to tip, rad.
    fn joint_positions_rad(&self) -> &[f64];
    /// Bend of a flexure without load, with what is out of an outer tube now, rad.
    fn rest_rad(&self, joint: usize) -> f64;
    /// Bending rates, base to tip, rad/s.
    fn joint_velocities_rad_per_s(&self) -> &[f64];
    /// Proxy spheres in the current configuration: shaft, segments, burr.
    fn proxy_spheres(&self) -> &[ProxySphere];
    /// Contacts of the last step, ordered by sphere.
    fn contact_results(&self) -> &[ContactResult];
    /// Summary of the last step.
    fn last_report(&self) -> &StepReport;
    /// Pose of link `link` (0 is the shaft), z along the link.
    fn t_world_link(&self, link: usize) -> Isometry3<f64>;
    /// Pose of the tip frame: origin at the burr centre.
    fn t_world_tip(&self) -> Isometry3<f64>;
    /// Kinetic energy relative to the base plus elastic energy, J.
    fn energy_j(&self) -> f64;
    /// First bending mode of the tool on a rigid mount while it is straight, Hz.
    fn first_natural_frequency_hz(&self) -> f64;

    /// Sum of the bending angles, rad.
    fn bend_rad(&self) -> f64 {
        self.joint_positions_rad().iter().sum()
    }

    /// Number of tendons.
    fn tendon_count(&self) -> usize {
        self.parameters().tendon_count()
    }

    /// Tension of each tendon at its proximal end after the last step, N.
    fn tendon_tensions_n(&self) -> [f64; MAX_TENDONS] {
        self.last_report().tendon_tension_n
    }

    /// Pulled length of each tendon after the last step, including its stretch, m.
    fn tendon_displacements_m(&self) -> [f64; MAX_TENDONS] {
        self.last_report().tendon_displacement_m
    }

    /// Wrench of the tool on the flange in the last step.
    fn flange_wrench(&self) -> Wrench {
        self.last_report().flange_wrench
    }
}

macro_rules! inherent {
    ($($name:ident($($argument:ident: $type:ty),*) -> $out:ty;)*) => {
        $(fn $name(&self, $($argument: $type),*) -> $out { Self::$name(self, $($argument),*) })*
    };
}

macro_rules! model {
    ([$($generics:tt)*] $type:ty, $state:ty) => {
        impl<$($generics)*> ManipulatorModel for $type {
            type State = $state;

            fn step(&mut self, dt_s: f64, input: &StepInput) -> Result<StepReport, ManipulatorError> {
                Self::step(self, dt_s, input)
            }

            fn restore(&mut self, state: &$state) {
                Self::restore(self, state);
            }

            fn place_base(&mut self, base: &BaseMotion) -> Result<(), ManipulatorError> {
                Self::place_base(self, base)
            }

            inherent! {
                snapshot() -> $state;
                parameters() -> &ManipulatorParameters;
                base() -> &BaseMotion;
                joint_count() -> usize;
                joint_positions_rad() -> &[f64];
                rest_rad(joint: usize) -> f64;
                joint_velocities_rad_per_s() -> &[f64];
                proxy_spheres() -> &[ProxySphere];
                contact_results() -> &[ContactResult];
                last_report() -> &StepReport;
                t_world_link(link: usize) -> Isometry3<f64>;
                t_world_tip() -> Isometry3<f64>;
                energy_j() -> f64;
                first_natural_frequency_hz() -> f64;
            }
        }
    };
}

model!([] Manipulator, ManipulatorState);
model!([] ConstantCurvature, ConstantCurvatureState);
model!([const N: usize] MomentModes<N>, MomentModesState);
model!([const D: usize] SpatialChain<D>, SpatialState);

/// A manipulator of any rung.
#[derive(Debug, Clone)]
#[expect(
    clippy::large_enum_variant,
    reason = "one a simulation; a box would stand between the tick and its state"
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
    /// The planar rung with more flexures than [`Manipulator`] supports.
    LongPlanar(SpatialChain<1>),
    /// See [`SpatialChain`].
    Spatial(SpatialChain<3>),
    /// See [`SpatialChain`].
    Full(SpatialChain<6>),
}

/// The state of an [`AnyManipulator`].
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub enum AnyManipulatorState {
    /// State of the arc.
    ConstantCurvature(ConstantCurvatureState),
    /// State of the planar chain.
    Planar(Box<ManipulatorState>),
    /// State of a spatial chain, including the long planar one.
    Spatial(SpatialState),
    /// State of the moment modes.
    Modes(MomentModesState),
}

/// Borrowed [`AnyManipulatorState`], so that serialising needs no copy. The variants are the same.
#[derive(Debug, Clone, Copy, Serialize)]
pub(crate) enum AnyManipulatorStateRef<'a> {
    ConstantCurvature(&'a ConstantCurvatureState),
    Planar(&'a ManipulatorState),
    Spatial(&'a SpatialState),
    Modes(&'a MomentModesState),
}

impl AnyManipulator {
    /// A tool in its rest shape, at rest on `base`, with slack tendons.
    ///
    /// # Errors
    /// A parameter is out of range, or the rung cannot represent the tool; the error names it.
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
            Rung::Planar if parameters.joint_positions_m.len() > MAX_JOINTS => {
                Self::LongPlanar(SpatialChain::new(parameters, base)?)
            }
            Rung::Planar => Self::Planar(Manipulator::new(parameters, base)?),
            Rung::Spatial => Self::Spatial(SpatialChain::new(parameters, base)?),
            Rung::Full => Self::Full(SpatialChain::new(parameters, base)?),
        })
    }

    /// Makes the tool straight, and at rest: a pre-curved tool that a hole or a guide holds.
    pub fn straighten(&mut self) {
        match self {
            Self::ConstantCurvature(tool) => tool.straighten(),
            Self::FewModes(tool) => tool.straighten(),
            Self::MoreModes(tool) => tool.straighten(),
            Self::Planar(tool) => tool.straighten(),
            Self::LongPlanar(tool) => tool.straighten(),
            Self::Spatial(tool) => tool.straighten(),
            Self::Full(tool) => tool.straighten(),
        }
    }

    /// Says how far a tool with an outer tube is out of it, m; 0 at first.
    pub fn set_deployed(&mut self, deployed_m: f64) {
        match self {
            // They take no such tool.
            Self::ConstantCurvature(_) | Self::FewModes(_) | Self::MoreModes(_) => {}
            Self::Planar(tool) => tool.set_deployed(deployed_m),
            Self::LongPlanar(tool) => tool.set_deployed(deployed_m),
            Self::Spatial(tool) => tool.set_deployed(deployed_m),
            Self::Full(tool) => tool.set_deployed(deployed_m),
        }
    }

    /// Says whether the burr turns in the next steps; one that stands still rubs like the tube. It turns at first.
    pub fn set_burr_turns(&mut self, turns: bool) {
        match self {
            Self::ConstantCurvature(tool) => tool.set_burr_turns(turns),
            Self::FewModes(tool) => tool.set_burr_turns(turns),
            Self::MoreModes(tool) => tool.set_burr_turns(turns),
            Self::Planar(tool) => tool.set_burr_turns(turns),
            Self::LongPlanar(tool) => tool.set_burr_turns(turns),
            Self::Spatial(tool) => tool.set_burr_turns(turns),
            Self::Full(tool) => tool.set_burr_turns(turns),
        }
    }

    /// Disables SIMD where it is used: slower, same bits.
    pub fn use_plain_instructions(&mut self) {
        match self {
            Self::ConstantCurvature(tool) => tool.use_plain_instructions(),
            Self::FewModes(tool) => tool.use_plain_instructions(),
            Self::MoreModes(tool) => tool.use_plain_instructions(),
            Self::Planar(tool) => tool.use_plain_instructions(),
            Self::LongPlanar(tool) => tool.use_plain_instructions(),
            Self::Spatial(tool) => tool.use_plain_instructions(),
            Self::Full(tool) => tool.use_plain_instructions(),
        }
    }

    /// Copies the complete dynamic state into one of the same model, without allocating.
    pub(crate) fn save(&self, into: &mut AnyManipulatorState) {
        match (self, into) {
            (Self::ConstantCurvature(tool), AnyManipulatorState::ConstantCurvature(state)) => {
                state.copy_from(tool.state());
            }
            (Self::FewModes(tool), AnyManipulatorState::Modes(state)) => state.copy_from(tool.state()),
            (Self::MoreModes(tool), AnyManipulatorState::Modes(state)) => state.copy_from(tool.state()),
            (Self::Planar(tool), AnyManipulatorState::Planar(state)) => state.copy_from(tool.state()),
            (Self::LongPlanar(tool), AnyManipulatorState::Spatial(state)) => state.copy_from(tool.state()),
            (Self::Spatial(tool), AnyManipulatorState::Spatial(state)) => state.copy_from(tool.state()),
            (Self::Full(tool), AnyManipulatorState::Spatial(state)) => state.copy_from(tool.state()),
            (_, into) => *into = self.snapshot(),
        }
    }

    /// The complete dynamic state.
    pub(crate) fn state(&self) -> AnyManipulatorStateRef<'_> {
        match self {
            Self::ConstantCurvature(tool) => AnyManipulatorStateRef::ConstantCurvature(tool.state()),
            Self::FewModes(tool) => AnyManipulatorStateRef::Modes(tool.state()),
            Self::MoreModes(tool) => AnyManipulatorStateRef::Modes(tool.state()),
            Self::Planar(tool) => AnyManipulatorStateRef::Planar(tool.state()),
            Self::LongPlanar(tool) => AnyManipulatorStateRef::Spatial(tool.state()),
            Self::Spatial(tool) => AnyManipulatorStateRef::Spatial(tool.state()),
            Self::Full(tool) => AnyManipulatorStateRef::Spatial(tool.state()),
        }
    }

    /// True if a deserialised state belongs to this rung and size.
    pub(crate) fn fits(&self, state: &AnyManipulatorState) -> bool {
        match (self, state) {
            (Self::ConstantCurvature(_), AnyManipulatorState::ConstantCurvature(_))
            | (Self::FewModes(_) | Self::MoreModes(_), AnyManipulatorState::Modes(_))
            | (Self::Planar(_), AnyManipulatorState::Planar(_)) => true,
            (Self::LongPlanar(tool), AnyManipulatorState::Spatial(state)) => tool.fits(state),
            (Self::Spatial(tool), AnyManipulatorState::Spatial(state)) => tool.fits(state),
            (Self::Full(tool), AnyManipulatorState::Spatial(state)) => tool.fits(state),
            _ => false,
        }
    }

    /// The rung in use.
    pub fn rung(&self) -> Rung {
        match self {
            Self::ConstantCurvature(_) => Rung::ConstantCurvature,
            Self::FewModes(_) | Self::MoreModes(_) => Rung::Modal,
            Self::Planar(_) | Self::LongPlanar(_) => Rung::Planar,
            Self::Spatial(_) => Rung::Spatial,
            Self::Full(_) => Rung::Full,
        }
    }

    /// False while a flexure of a tool in moment modes is beyond its stop ([`MomentModes::is_valid`]); the other models hold there.
    pub fn is_valid(&self) -> bool {
        match self {
            Self::FewModes(tool) => tool.is_valid(),
            Self::MoreModes(tool) => tool.is_valid(),
            _ => true,
        }
    }
}

macro_rules! each {
    ($self:expr, $tool:ident => $what:expr) => {
        match $self {
            AnyManipulator::ConstantCurvature($tool) => $what,
            AnyManipulator::FewModes($tool) => $what,
            AnyManipulator::MoreModes($tool) => $what,
            AnyManipulator::Planar($tool) => $what,
            AnyManipulator::LongPlanar($tool) => $what,
            AnyManipulator::Spatial($tool) => $what,
            AnyManipulator::Full($tool) => $what,
        }
    };
}

macro_rules! forward {
    ($($name:ident($($argument:ident: $type:ty),*) -> $out:ty;)*) => {
        $(fn $name(&self, $($argument: $type),*) -> $out { each!(self, tool => tool.$name($($argument),*)) })*
    };
}

impl ManipulatorModel for AnyManipulator {
    type State = AnyManipulatorState;

    fn step(&mut self, dt_s: f64, input: &StepInput) -> Result<StepReport, ManipulatorError> {
        each!(self, tool => tool.step(dt_s, input))
    }

    fn snapshot(&self) -> AnyManipulatorState {
        match self {
            Self::ConstantCurvature(tool) => AnyManipulatorState::ConstantCurvature(tool.snapshot()),
            Self::FewModes(tool) => AnyManipulatorState::Modes(tool.snapshot()),
            Self::MoreModes(tool) => AnyManipulatorState::Modes(tool.snapshot()),
            Self::Planar(tool) => AnyManipulatorState::Planar(Box::new(tool.snapshot())),
            Self::LongPlanar(tool) => AnyManipulatorState::Spatial(tool.snapshot()),
            Self::Spatial(tool) => AnyManipulatorState::Spatial(tool.snapshot()),
            Self::Full(tool) => AnyManipulatorState::Spatial(tool.snapshot()),
        }
    }

    /// Ignores a snapshot of another rung: it does not come from a tool with the same parameters.
    fn restore(&mut self, state: &AnyManipulatorState) {
        match (self, state) {
            (Self::ConstantCurvature(tool), AnyManipulatorState::ConstantCurvature(state)) => {
                tool.restore(state);
            }
            (Self::FewModes(tool), AnyManipulatorState::Modes(state)) => tool.restore(state),
            (Self::MoreModes(tool), AnyManipulatorState::Modes(state)) => tool.restore(state),
            (Self::Planar(tool), AnyManipulatorState::Planar(state)) => tool.restore(state),
            (Self::LongPlanar(tool), AnyManipulatorState::Spatial(state)) => tool.restore(state),
            (Self::Spatial(tool), AnyManipulatorState::Spatial(state)) => tool.restore(state),
            (Self::Full(tool), AnyManipulatorState::Spatial(state)) => tool.restore(state),
            _ => (),
        }
    }

    fn place_base(&mut self, base: &BaseMotion) -> Result<(), ManipulatorError> {
        each!(self, tool => tool.place_base(base))
    }

    forward! {
        parameters() -> &ManipulatorParameters;
        base() -> &BaseMotion;
        joint_count() -> usize;
        joint_positions_rad() -> &[f64];
        rest_rad(joint: usize) -> f64;
        joint_velocities_rad_per_s() -> &[f64];
        proxy_spheres() -> &[ProxySphere];
        contact_results() -> &[ContactResult];
        last_report() -> &StepReport;
        t_world_link(link: usize) -> Isometry3<f64>;
        t_world_tip() -> Isometry3<f64>;
        energy_j() -> f64;
        first_natural_frequency_hz() -> f64;
    }
}
