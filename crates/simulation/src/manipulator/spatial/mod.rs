//! The spatial rungs: a chain of flexures with one, three or six degrees of freedom each, in reduced
//! coordinates.
//!
//! [`SpatialChain<3>`] bends in two planes and twists. [`SpatialChain<6>`] also stretches and shears.
//! [`SpatialChain<1>`] is the planar chain again, with up to 64 links, for comparison. Frames, tendons,
//! contact laws, mount and integrators are those of the planar rung (see [`crate::manipulator`]). Each
//! coordinate of a flexure has its own spring `k (q - q_0)`, so the forces derive from one potential at any
//! angle.
//!
//! All stiffnesses are the bending stiffness of a flexure times the ratios of
//! [`crate::manipulator::StiffnessRatios`], the same in both.

pub(super) mod algebra;
mod articulated;
mod energy;
mod layout;
mod loads;
mod step;
mod tendon;

use nalgebra::{Isometry3, Rotation3, Translation3, UnitQuaternion, Vector3};

use super::common::{Common, StateSizes};
use super::contact::ContactSolver;
use super::coupling::Coupling;
use super::error::ManipulatorError;
use super::model::{ManipulatorModel, Rung, own_parts};
use super::parameters::ManipulatorParameters;
use super::pressed::PressedStops;
use super::state::{BaseMotion, ManipulatorState, StepInput, StepReport};
use super::tendon::friction_w;
use super::tip_jacobian::{LinkMotion, Pulls, stiffness, supports};
use super::{CONTACTS_PER_SPHERE, MAX_LINKS, MAX_SHAFT_SPHERES, MAX_TENDONS};
use articulated::Articulated;
use layout::{Configuration, MOUNT, SpatialLayout};
use loads::Loads;
use step::Work;
use tendon::TendonLoad;

/// Maximum contacts per step; excess contacts are rejected and counted.
const MAX_CONTACTS: usize = CONTACTS_PER_SPHERE * (MAX_SHAFT_SPHERES + MAX_LINKS + 1);

/// A continuum manipulator whose flexures have D degrees of freedom: 1, 3 or 6.
#[derive(Debug, Clone)]
pub struct SpatialChain<const D: usize> {
    common: Common,
    layout: SpatialLayout<D>,
    /// Stiffness per degree of freedom.
    stiffness: Vec<f64>,
    /// Unloaded coordinates: the rest angles.
    rest: Vec<f64>,
    damping: Vec<f64>,
    /// Whether springs and dampers enter as explicit forces only (baseline).
    explicit: bool,
    /// Configuration, derived from the state.
    configuration: Configuration<D>,
    /// This and the following fields are workspace.
    trial: Configuration<D>,
    articulated: Articulated,
    tendon: TendonLoad,
    coupling: Coupling<Vec<f64>>,
    loads: Loads,
    contact: ContactSolver<6>,
    pressed: PressedStops,
    work: Work,
}

impl<const D: usize> SpatialChain<D> {
    const RUNG: Rung = {
        assert!(D == 1 || D == 3 || D == 6, "a flexure has 1, 3 or 6 freedoms");
        [Rung::Planar, Rung::Spatial, Rung::Full][D / 3]
    };

    /// Creates a tool in its rest shape, at rest on `base`, with slack tendons.
    ///
    /// # Errors
    /// A parameter is out of range; the error names it.
    pub fn new(parameters: ManipulatorParameters, base: &BaseMotion) -> Result<Self, ManipulatorError> {
        Common::check(&parameters, base)?;
        let layout = SpatialLayout::new(&parameters);
        let (freedoms, links) = (layout.freedoms(), layout.joints + 1);
        let stiffness = stiffnesses::<D>(&parameters);
        let mut rest = vec![0.0; freedoms];
        for (joint, angle) in parameters.joint_rest_rad.iter().enumerate() {
            rest[layout.bend(joint)] = *angle;
        }
        let (tendon, first) =
            (TendonLoad::new(freedoms, &parameters), parameters.first_frequency_rad_per_s());
        let room = StateSizes { freedoms, stops: freedoms, contacts: MAX_CONTACTS };
        let common = Common::new(Self::RUNG, parameters, base, layout.total_mass_kg, first, room);
        let damper = |(k, stiffness): (usize, &f64)| {
            common.mount_damping.get(k).copied().unwrap_or_else(|| common.damping_s() * stiffness)
        };
        let mut chain = Self {
            damping: stiffness.iter().enumerate().map(damper).collect(),
            common,
            stiffness,
            rest,
            explicit: false,
            configuration: Configuration::new(&layout),
            trial: Configuration::new(&layout),
            articulated: Articulated::new(freedoms),
            tendon,
            coupling: Coupling::new(vec![0.0; freedoms]),
            loads: Loads::new(links),
            contact: ContactSolver::new(layout.first_freedoms(), MAX_CONTACTS),
            pressed: PressedStops::new(freedoms),
            work: Work::new(freedoms, links),
            layout,
        };
        chain.set_deployed(0.0);
        chain.common.state.position.copy_from_slice(&chain.rest);
        chain.follow_state();
        Ok(chain)
    }

    /// Switches to semi-implicit Euler as a baseline: springs and dampers enter as forces, not through the
    /// operator. Stable only for steps below 2 / omega of the highest mode.
    pub fn with_explicit_springs(mut self) -> Self {
        self.explicit = true;
        self.common.parameters.integrator = super::Integrator::LinearlyImplicitEuler;
        self
    }

    /// Returns all generalised coordinates: three of the mount (m), then those of the flexures (displacements
    /// in m; bending, lateral bending and torsion in rad).
    pub fn freedoms(&self) -> &[f64] {
        &self.common.state.position
    }
}

impl<const D: usize> ManipulatorModel for SpatialChain<D> {
    own_parts!();

    fn follow_state(&mut self) {
        self.common.copy_bend(|joint| self.layout.bend(joint));
        let state = &self.common.state;
        self.configuration.update(&self.layout, &state.position);
        let pose = &state.base.t_world_base;
        let rotation = pose.rotation.to_rotation_matrix();
        let (mut link, mut motion, mut k) = (0, algebra::ZERO, 0);
        let mut carry = |end: usize, motion: &mut algebra::Spatial| {
            while k < end {
                algebra::add_scaled(motion, state.velocity[k], &self.configuration.axis[k]);
                k += 1;
            }
        };
        carry(MOUNT, &mut motion);
        for (sphere, fixed) in self.common.spheres.iter_mut().zip(&self.common.sphere_layout) {
            while link < fixed.link {
                link += 1;
                carry(self.layout.freedoms_of(link).end, &mut motion);
            }
            let point = self.configuration.point(link, fixed.along_m);
            let centre = rotation * point;
            sphere.centre_m = pose.translation.vector + centre;
            sphere.velocity_m_per_s = state.base.linear_velocity_m_per_s
                + state.base.angular_velocity_rad_per_s.cross(&centre)
                + rotation * algebra::velocity_at(&point, &motion);
        }
    }

    fn update_take_up(&mut self) {
        let Self { common, tendon, layout, .. } = self;
        let position = common.state.position.clone();
        common.set_take_up(&tendon.channels, |t| tendon.take_up(layout, &position, t));
    }

    fn set_deployed(&mut self, deployed_m: f64) {
        if self.common.parameters.outer_tube.is_none() {
            return;
        }
        let damping_s = self.common.damping_s();
        for joint in 0..self.layout.joints {
            let spring = self.common.parameters.bending_spring(joint, deployed_m);
            let bend = self.layout.bend(joint);
            (self.stiffness[bend], self.rest[bend]) = (spring.bend_nm_per_rad, spring.rest_rad);
            self.damping[bend] = damping_s * spring.bend_nm_per_rad;
            if D > 1 {
                self.stiffness[bend + 1] = spring.lateral_nm_per_rad;
                self.damping[bend + 1] = damping_s * spring.lateral_nm_per_rad;
            }
        }
        self.common.cover_spheres(deployed_m);
    }

    fn rest_rad(&self, joint: usize) -> f64 {
        self.rest[self.layout.bend(joint)]
    }

    fn t_world_point(&self, link: usize, along_m: f64) -> Isometry3<f64> {
        let translation = Translation3::from(self.configuration.point(link, along_m));
        let rotation = Rotation3::from_matrix_unchecked(self.configuration.rotation[link]);
        let rotation = UnitQuaternion::from_rotation_matrix(&rotation);
        self.common.state.base.t_world_base * Isometry3::from_parts(translation, rotation)
    }

    fn energy_j(&self) -> f64 {
        self.energy_of(&self.configuration, &self.common.state.position, &self.common.state.velocity)
    }

    fn damping_w(&self) -> f64 {
        self.damping
            .iter()
            .zip(&self.common.state.velocity)
            .map(|(damping, rate)| damping * rate * rate)
            .sum()
    }

    fn tendon_friction_w(&self) -> f64 {
        friction_w(&self.tendon_tensions_n(), &self.tendon.lost, &self.common.state.velocity)
    }

    fn tip_motion(&self) -> LinkMotion {
        let Self { common, layout, configuration, tendon, .. } = self;
        let ManipulatorState { position, stop_torque_nm, .. } = &common.state;
        let (law, mut pulls) = (common.parameters.stop_law(), Pulls::of(&tendon.channels, &common.state));
        let (mut motion, mut supports) = (LinkMotion::of_base(), supports(common).peekable());
        for k in 0..MOUNT {
            motion.cross(&configuration.axis[k], self.stiffness[k], &[0.0; MAX_TENDONS]);
        }
        for link in 0..=layout.joints {
            if link > 0 {
                let (added, pull) = tendon.on_flexure(layout, link - 1, position, &mut pulls);
                for (k, (added, pull)) in layout.freedoms_of(link).zip(added.iter().zip(&pull)) {
                    let k_total = stiffness(self.stiffness[k], *added, law.stiffness_at(stop_torque_nm[k]));
                    motion.cross(&configuration.axis[k], k_total, pull);
                }
            }
            while let Some(support) = supports.next_if(|support| support.link == link) {
                motion.support(&support.force, common.parameters.contact.stiffness_n_per_m);
            }
        }
        motion
    }

    fn mass_moment_kg_m(&self) -> Vector3<f64> {
        self.layout.body.iter().enumerate().fold(Vector3::zeros(), |sum, (link, body)| {
            sum + self.configuration.point(link, body.centre_m) * body.mass_kg
        })
    }
}

/// Returns the stiffness per degree of freedom, N/m and N m/rad.
fn stiffnesses<const D: usize>(p: &ManipulatorParameters) -> Vec<f64> {
    let mut stiffness = p.mount_stiffness_n_per_m.to_vec();
    for (joint, &k) in p.joint_stiffness_nm_per_rad.iter().enumerate() {
        let ratios = p.stiffness_ratios(joint);
        if D == 6 {
            let shear = [ratios.shear_toward_per_m2, ratios.shear_across_per_m2];
            stiffness.extend(shear.map(|ratio| ratio * k));
            stiffness.push(ratios.axial_per_m2 * k);
        }
        stiffness.push(k);
        if D > 1 {
            stiffness.extend([ratios.lateral * k, ratios.torsion * k]);
        }
    }
    stiffness
}
