//! The spatial rungs: a chain of flexures with one, three or six degrees of freedom each, in reduced coordinates.
//!
//! [`SpatialChain<3>`] bends in two planes and twists. [`SpatialChain<6>`] also stretches and shears.
//! [`SpatialChain<1>`] is the planar chain again, with up to 64 links. Frames, tendons, contact laws, mount and integrators are those of
//! the planar rung (see [`crate::manipulator`]). Each coordinate of a flexure has its own spring `k (q - q_0)`, so the forces derive from one
//! potential at any angle.
//!
//! All stiffnesses are the bending stiffness of a flexure times the ratios of [`crate::manipulator::StiffnessRatios`], the same in both.

mod algebra;
mod articulated;
mod coupling;
mod energy;
mod layout;
mod loads;
mod state;
mod step;
mod tendon;

use nalgebra::{Isometry3, Rotation3, Translation3, UnitQuaternion, Vector3};

use super::contact::ContactSolver;
use super::error::ManipulatorError;
use super::parameters::ManipulatorParameters;
use super::pressed::PressedStops;
use super::state::{BaseMotion, ContactResult, ProxySphere, StepReport, Wrench};
use super::{CONTACTS_PER_SPHERE, MAX_LINKS, MAX_SHAFT_SPHERES, frequencies};
use articulated::Articulated;
use coupling::Coupling;
use layout::{Configuration, MOUNT, SpatialLayout};
use loads::Loads;
use step::Work;
use tendon::TendonLoad;

pub use state::SpatialState;

/// Maximum contacts per step, four per sphere; excess contacts are refused and counted.
const MAX_CONTACTS: usize = CONTACTS_PER_SPHERE * (MAX_SHAFT_SPHERES + MAX_LINKS + 1);

/// A continuum manipulator whose flexures have D degrees of freedom: 1, 3 or 6.
#[derive(Debug, Clone)]
pub struct SpatialChain<const D: usize> {
    parameters: ManipulatorParameters,
    layout: SpatialLayout<D>,
    /// Per degree of freedom.
    stiffness: Vec<f64>,
    /// Coordinates without load: the rest angles.
    rest: Vec<f64>,
    damping: Vec<f64>,
    first_frequency_rad_per_s: f64,
    /// Baseline: springs and dampers enter as explicit forces only.
    explicit: bool,
    state: SpatialState,
    /// Derived from `state`.
    configuration: Configuration<D>,
    /// Derived from `state`.
    spheres: Vec<ProxySphere>,
    /// Bending angles and rates, copied from `state`.
    bend: [Vec<f64>; 2],
    /// The fields from here on are workspace.
    trial: Configuration<D>,
    articulated: Articulated,
    tendon: TendonLoad,
    coupling: Coupling,
    loads: Loads,
    contact: ContactSolver<6>,
    pressed: PressedStops,
    work: Work,
}

impl<const D: usize> SpatialChain<D> {
    const SUPPORTED: () = assert!(D == 1 || D == 3 || D == 6, "a flexure has 1, 3 or 6 freedoms");

    /// A tool in its rest shape, at rest on `base`, with slack tendons.
    ///
    /// # Errors
    /// A parameter is out of range; the error names it.
    pub fn new(parameters: ManipulatorParameters, base: &BaseMotion) -> Result<Self, ManipulatorError> {
        let () = Self::SUPPORTED;
        parameters.validate()?;
        super::validation::validate_base(base)?;
        let layout = SpatialLayout::new(&parameters);
        let (freedoms, links) = (layout.freedoms(), layout.joints + 1);
        let bending = &parameters.joint_stiffness_nm_per_rad;
        let first = frequencies::first_frequency_rad_per_s(
            layout.first_joint_m,
            &layout.length_m,
            &layout.body,
            bending,
        );
        let stiffness = stiffnesses::<D>(&parameters);
        let mut rest = vec![0.0; freedoms];
        for (joint, angle) in parameters.joint_rest_rad.iter().enumerate() {
            rest[layout.bend(joint)] = *angle;
        }
        let mut state = SpatialState::new(base, freedoms, MAX_CONTACTS);
        state.position.copy_from_slice(&rest);
        let damping = (0..freedoms)
            .map(|k| match parameters.mount_stiffness_n_per_m.get(k) {
                Some(mount) => {
                    2.0 * parameters.mount_damping_ratio * libm::sqrt(mount * layout.total_mass_kg)
                }
                None => 2.0 * parameters.damping_ratio / first * stiffness[k],
            })
            .collect();
        let blank = |s: &super::geometry::SphereLayout| ProxySphere {
            centre_m: Vector3::zeros(),
            velocity_m_per_s: Vector3::zeros(),
            radius_m: s.radius_m,
            kind: s.kind,
        };
        let mut chain = Self {
            spheres: layout.spheres.iter().map(blank).collect(),
            stiffness,
            rest,
            damping,
            first_frequency_rad_per_s: first,
            explicit: false,
            state,
            configuration: Configuration::new(&layout),
            bend: [vec![0.0; layout.joints], vec![0.0; layout.joints]],
            trial: Configuration::new(&layout),
            articulated: Articulated::new(freedoms),
            tendon: TendonLoad::new(freedoms, &parameters),
            coupling: Coupling::new(freedoms),
            loads: Loads::new(links),
            contact: ContactSolver::new(layout.first_freedoms(), MAX_CONTACTS),
            pressed: PressedStops::new(freedoms),
            work: Work::new(freedoms, links),
            layout,
            parameters,
        };
        chain.set_deployed(0.0);
        chain.state.position.copy_from_slice(&chain.rest);
        chain.update_configuration();
        Ok(chain)
    }

    /// Says how far a tool with an outer tube is out of it, m.
    pub fn set_deployed(&mut self, deployed_m: f64) {
        if self.parameters.outer_tube.is_none() {
            return;
        }
        let damping_s = 2.0 * self.parameters.damping_ratio / self.first_frequency_rad_per_s;
        for joint in 0..self.layout.joints {
            let spring = self.parameters.bending_spring(joint, deployed_m);
            let bend = self.layout.bend(joint);
            (self.stiffness[bend], self.rest[bend]) = (spring.bend_nm_per_rad, spring.rest_rad);
            self.damping[bend] = damping_s * spring.bend_nm_per_rad;
            if D > 1 {
                self.stiffness[bend + 1] = spring.lateral_nm_per_rad;
                self.damping[bend + 1] = damping_s * spring.lateral_nm_per_rad;
            }
        }
        self.parameters.cover_spheres(&mut self.layout.spheres, &mut self.spheres, deployed_m);
    }

    /// Makes the tool straight, and at rest: a pre-curved tool that a hole or a guide holds.
    pub fn straighten(&mut self) {
        self.state.position.fill(0.0);
        self.state.velocity.fill(0.0);
        self.update_configuration();
        for t in 0..self.tendon.channels.count {
            self.state.tendon[t].take_up_m = self.tendon.take_up(&self.layout, &self.state.position, t);
        }
    }

    /// Baseline: semi-implicit Euler; springs and dampers enter as forces, not through the operator.
    pub(crate) fn with_explicit_springs(mut self) -> Self {
        self.explicit = true;
        self.parameters.integrator = super::Integrator::LinearlyImplicitEuler;
        self
    }

    /// Links and spheres for the present state.
    fn update_configuration(&mut self) {
        let state = &self.state;
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
        for (sphere, fixed) in self.spheres.iter_mut().zip(&self.layout.spheres) {
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
        for joint in 0..self.layout.joints {
            self.bend[0][joint] = state.position[self.layout.bend(joint)];
            self.bend[1][joint] = state.velocity[self.layout.bend(joint)];
        }
    }

    /// Number of flexures.
    pub fn joint_count(&self) -> usize {
        self.layout.joints
    }

    /// The parameters the tool was built from.
    pub fn parameters(&self) -> &ManipulatorParameters {
        &self.parameters
    }

    /// First bending mode of the tool on a rigid mount while it is straight, Hz.
    pub fn first_natural_frequency_hz(&self) -> f64 {
        self.first_frequency_rad_per_s / (2.0 * core::f64::consts::PI)
    }

    /// Proxy spheres in the current configuration: shaft, segments, burr.
    pub fn proxy_spheres(&self) -> &[ProxySphere] {
        &self.spheres
    }

    /// Bending angles, base to tip, rad.
    pub fn joint_positions_rad(&self) -> &[f64] {
        &self.bend[0]
    }

    /// Bend of a flexure without load, with what is out of an outer tube now, rad.
    pub fn rest_rad(&self, joint: usize) -> f64 {
        self.rest[self.layout.bend(joint)]
    }

    /// Bending rates, base to tip, rad/s.
    pub fn joint_velocities_rad_per_s(&self) -> &[f64] {
        &self.bend[1]
    }

    /// All generalised coordinates: three of the mount (m), then those of the flexures (displacements in m; bending, lateral bending and
    /// torsion in rad).
    pub fn freedoms(&self) -> &[f64] {
        &self.state.position
    }

    /// Pose of link `link` (0 is the shaft), z along the link. An index past the last link returns the last link.
    pub fn t_world_link(&self, link: usize) -> Isometry3<f64> {
        self.t_world_point(link.min(self.layout.joints), 0.0)
    }

    /// Pose of the tip frame: origin at the burr centre, z along the last link.
    pub fn t_world_tip(&self) -> Isometry3<f64> {
        let n = self.layout.joints;
        self.t_world_point(n, self.layout.length_m[n - 1])
    }

    fn t_world_point(&self, link: usize, along_m: f64) -> Isometry3<f64> {
        let translation = Translation3::from(self.configuration.point(link, along_m));
        let rotation = Rotation3::from_matrix_unchecked(self.configuration.rotation[link]);
        let rotation = UnitQuaternion::from_rotation_matrix(&rotation);
        self.state.base.t_world_base * Isometry3::from_parts(translation, rotation)
    }

    /// Base motion at the end of the last step.
    pub fn base(&self) -> &BaseMotion {
        &self.state.base
    }

    /// Teleports the base and keeps shape and relative motion. For scene set-up, not for motion.
    ///
    /// # Errors
    /// The base motion is not finite, not a rotation, or out of range.
    pub fn place_base(&mut self, base: &BaseMotion) -> Result<(), ManipulatorError> {
        super::validation::validate_base(base)?;
        self.state.base = *base;
        self.update_configuration();
        Ok(())
    }

    /// Wrench of the tool on the flange in the last step.
    pub fn flange_wrench(&self) -> Wrench {
        self.state.report.flange_wrench
    }

    /// Solves contacts without vector instructions: slower, same bits.
    pub(super) fn use_plain_instructions(&mut self) {
        self.contact.arch = pulp::Arch::Scalar;
    }

    /// Says whether the burr turns in the next steps; one that stands still rubs like the tube. It turns at first.
    pub fn set_burr_turns(&mut self, turns: bool) {
        self.contact.burr_turns = turns;
    }

    /// Contacts of the last step, ordered by sphere.
    pub fn contact_results(&self) -> &[ContactResult] {
        &self.state.results[..self.state.result_count]
    }

    /// Summary of the last step.
    pub fn last_report(&self) -> &StepReport {
        &self.state.report
    }

    /// Kinetic energy relative to the base plus elastic energy of flexures and mount, J.
    pub fn energy_j(&self) -> f64 {
        self.energy_of(&self.configuration, &self.state.position, &self.state.velocity)
    }

    /// A copy of the complete dynamic state.
    pub fn snapshot(&self) -> SpatialState {
        self.state.clone()
    }

    /// The complete dynamic state.
    pub(crate) fn state(&self) -> &SpatialState {
        &self.state
    }

    /// True if a deserialised state has as many degrees of freedom as this chain.
    pub(crate) fn fits(&self, state: &SpatialState) -> bool {
        let freedoms = self.state.position.len();
        [&state.position, &state.velocity, &state.stop_torque].iter().all(|list| list.len() == freedoms)
    }

    /// Continues bit for bit from a snapshot of a tool with the same parameters.
    pub fn restore(&mut self, state: &SpatialState) {
        self.state.clone_from(state);
        self.update_configuration();
    }
}

/// Stiffness per degree of freedom, N/m and N m/rad.
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
