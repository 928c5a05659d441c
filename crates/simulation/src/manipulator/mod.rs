//! The planar rung of the model ladder: a chain of flexures in reduced coordinates, stepped implicitly; tendons, contacts and joint stops
//! are part of the same velocity solve.
//!
//! # Frames
//!
//! World is the patient frame (LPS, metres). The base frame is at the flange: +z is the insertion axis along the straight tool, +x the
//! bending direction toward tendon 0. Every flexure turns about +y, so positive angles bend toward +x. A translational mount (three
//! springs along the base axes) connects the tool to the base and carries axial and out-of-plane loads; the chain itself bends only in
//! the x-z plane. Link 0 is the rigid shaft; link i + 1 is distal to flexure i. The tip frame is that of the last link, with its origin
//! at the burr centre.
//!
//! # Method
//!
//! Hinges sit at the flexure centres, which makes the error against the continuum O(1/n^2). The operator `M + dt D + dt^2 K` is factored
//! in O(n) (`articulated`). Tendons act along their channels (`tendon`). Contact is compliant and solved by Newton's method, each of whose
//! iterations factors the same operator with the pressing contacts on its links (`contact`). Nothing is allocated after
//! [`Manipulator::new`].

#![expect(
    clippy::needless_range_loop,
    reason = "loops over joints and vector components index several arrays at once"
)]

mod articulated;
mod constant_curvature;
mod contact;
mod coupling;
mod error;
mod flexure;
mod frequencies;
mod geometry;
mod helix;
mod loads;
mod model;
mod moment_modes;
mod outer_tube;
mod parameters;
mod pressed;
mod pressing;
mod row;
mod spatial;
mod state;
mod step;
mod tendon;
mod validation;

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use scene::MAX_CUTTER_BALLS;

use articulated::Articulated;
use contact::ContactSolver;
use coupling::Coupling;
use geometry::{Configuration, Layout};
use loads::Loads;
use tendon::{Channels, TendonLoad};

pub use constant_curvature::{ConstantCurvature, ConstantCurvatureState};
pub use error::ManipulatorError;
pub use flexure::{Notch, StiffnessRatios, UnitStiffness};
pub use geometry::SphereKind;
pub use model::{AnyManipulator, AnyManipulatorState, ManipulatorModel, Rung};
pub use moment_modes::{MomentModes, MomentModesState};
pub use outer_tube::{BendingSpring, OuterTube};
pub(crate) use parameters::pitch_m;
pub use parameters::{
    ContactParameters, Integrator, ManipulatorParameters, STANDARD_MOMENT_MODES, Section, TendonParameters,
    TendonReach, TendonRoute,
};
use pressed::PressedStops;
pub use spatial::{SpatialChain, SpatialState};
pub use state::{
    BaseMotion, ContactResult, ManipulatorState, ProxySphere, StepInput, StepReport, TendonCommand, Wrench,
};

/// Maximum number of flexures of the planar rung.
pub const MAX_JOINTS: usize = 32;
/// Maximum number of flexures of the spatial rungs.
pub const MAX_LINKS: usize = 64;
/// Maximum number of tendons.
pub const MAX_TENDONS: usize = 4;
/// Maximum number of proxy spheres on the shaft.
pub const MAX_SHAFT_SPHERES: usize = 8;
/// Shaft, one per segment, the burr's.
pub(crate) const MAX_SPHERES: usize = MAX_SHAFT_SPHERES + MAX_JOINTS + MAX_CUTTER_BALLS;
/// Contacts for each sphere that there is room for. Most spheres have none to four; in a hole as narrow as itself one may have more.
pub const CONTACTS_PER_SPHERE: usize = 10;
/// Spheres that contacts are counted for: shaft, one per segment, one burr. The balls of a longer burr share with the whole tool.
const COUNTED_SPHERES: usize = MAX_SHAFT_SPHERES + MAX_JOINTS + 1;
/// Maximum contacts per step; excess contacts are refused and counted.
pub const MAX_CONTACTS: usize = CONTACTS_PER_SPHERE * COUNTED_SPHERES;

/// A continuum manipulator.
#[derive(Debug, Clone)]
pub struct Manipulator {
    parameters: ManipulatorParameters,
    layout: Layout,
    stiffness: [f64; MAX_JOINTS],
    /// Joint angles without load, rad.
    rest: [f64; MAX_JOINTS],
    damping: [f64; MAX_JOINTS],
    mount_damping: [f64; 3],
    first_frequency_rad_per_s: f64,
    state: ManipulatorState,
    /// Derived from `state`.
    configuration: Configuration,
    /// Derived from `state`.
    spheres: Vec<ProxySphere>,
    /// The fields from here on are workspace.
    trial: Configuration,
    articulated: Articulated,
    tendon: TendonLoad,
    coupling: Coupling,
    loads: Loads,
    contact: ContactSolver<4>,
    pressed: PressedStops,
}

impl Manipulator {
    /// A tool in its rest shape, at rest on `base`, with slack tendons.
    pub fn new(parameters: ManipulatorParameters, base: &BaseMotion) -> Result<Self, ManipulatorError> {
        parameters.validate()?;
        let given = parameters.joint_positions_m.len();
        if given > MAX_JOINTS {
            let expected = "1 to 32 entries for the planar rung";
            return Err(ManipulatorError::Length { field: "joint_positions_m", given, expected });
        }
        helix::refuse(&parameters, "0: the rung planar does not twist")?;
        validation::validate_base(base)?;
        let layout = Layout::new(&parameters);
        let n = layout.joints;
        let mut stiffness = [0.0; MAX_JOINTS];
        stiffness[..n].copy_from_slice(&parameters.joint_stiffness_nm_per_rad);
        let (lengths, bodies) = (&layout.length_m[..n], &layout.body[..=n]);
        let first =
            frequencies::first_frequency_rad_per_s(layout.first_joint_m, lengths, bodies, &stiffness[..n]);
        let mut rest = [0.0; MAX_JOINTS];
        rest[..parameters.joint_rest_rad.len()].copy_from_slice(&parameters.joint_rest_rad);
        let damping = stiffness.map(|k| 2.0 * parameters.damping_ratio / first * k);
        let mount_damping = parameters
            .mount_stiffness_n_per_m
            .map(|k| 2.0 * parameters.mount_damping_ratio * libm::sqrt(k * layout.total_mass_kg));
        let blank = |s: &geometry::SphereLayout| ProxySphere {
            centre_m: Vector3::zeros(),
            velocity_m_per_s: Vector3::zeros(),
            radius_m: s.radius_m,
            kind: s.kind,
        };
        let mut manipulator = Self {
            spheres: layout.spheres.iter().map(blank).collect(),
            stiffness,
            rest,
            damping,
            mount_damping,
            first_frequency_rad_per_s: first,
            state: ManipulatorState { joint_position_rad: rest, ..ManipulatorState::new(base) },
            configuration: Configuration::new(),
            trial: Configuration::new(),
            articulated: Articulated::new(n),
            tendon: TendonLoad::new(Channels::of(&parameters)),
            coupling: Coupling::new(),
            loads: Loads::new(),
            contact: ContactSolver::new(pressing::first_freedoms(n), MAX_CONTACTS),
            pressed: PressedStops::new(n),
            layout,
            parameters,
        };
        manipulator.set_deployed(0.0);
        manipulator.state.joint_position_rad = manipulator.rest;
        manipulator.update_configuration();
        Ok(manipulator)
    }

    /// Says how far a tool with an outer tube is out of it, m: its springs, and the radius of what the outer tube covers. 0 at first. Where
    /// the base is, which slides with it, is the caller's to say.
    pub fn set_deployed(&mut self, deployed_m: f64) {
        if self.parameters.outer_tube.is_none() {
            return;
        }
        for joint in 0..self.layout.joints {
            let spring = self.parameters.bending_spring(joint, deployed_m);
            (self.stiffness[joint], self.rest[joint]) = (spring.bend_nm_per_rad, spring.rest_rad);
            self.damping[joint] =
                2.0 * self.parameters.damping_ratio / self.first_frequency_rad_per_s * spring.bend_nm_per_rad;
        }
        self.parameters.cover_spheres(&mut self.layout.spheres, &mut self.spheres, deployed_m);
    }

    /// Makes the tool straight, and at rest: a pre-curved tool that a hole or a guide holds.
    pub fn straighten(&mut self) {
        self.state.joint_position_rad = [0.0; MAX_JOINTS];
        self.state.joint_velocity_rad_per_s = [0.0; MAX_JOINTS];
        self.update_configuration();
        for t in 0..self.tendon.channels.count {
            self.state.tendon[t].take_up_m = self.tendon.take_up(&self.configuration, t);
        }
    }

    /// Disables SIMD: slower, same bits.
    pub fn use_plain_instructions(&mut self) {
        self.contact.arch = pulp::Arch::Scalar;
    }

    /// Says whether the burr turns in the next steps; one that stands still rubs like the tube. It turns at first.
    pub fn set_burr_turns(&mut self, turns: bool) {
        self.contact.burr_turns = turns;
    }

    /// Links and spheres for the present state.
    fn update_configuration(&mut self) {
        let state = &self.state;
        self.configuration.update(&self.layout, &state.joint_position_rad, &state.mount_displacement_m);
        let (pose, y, mount) =
            (&state.base.t_world_base, state.mount_displacement_m[1], &state.mount_velocity_m_per_s);
        let rotation = pose.rotation.to_rotation_matrix();
        // Rate and origin velocity (x, z) of the link that carries the sphere; spheres come in ascending link order.
        let (mut link, mut omega, mut v) = (0, 0.0, [mount[0], mount[2]]);
        for (sphere, fixed) in self.spheres.iter_mut().zip(&self.layout.spheres) {
            while link < fixed.link {
                let length =
                    if link == 0 { self.layout.first_joint_m } else { self.layout.length_m[link - 1] };
                let e = &self.configuration.axis[link];
                v = [v[0] + omega * length * e[1], v[1] - omega * length * e[0]];
                omega += state.joint_velocity_rad_per_s[link];
                link += 1;
            }
            let e = &self.configuration.axis[link];
            let c = self.configuration.point(link, fixed.along_m);
            let arm = omega * fixed.along_m;
            let relative = rotation * Vector3::new(v[0] + arm * e[1], mount[1], v[1] - arm * e[0]);
            let centre = rotation * Vector3::new(c[0], y, c[1]);
            sphere.centre_m = pose.translation.vector + centre;
            sphere.velocity_m_per_s = state.base.linear_velocity_m_per_s
                + state.base.angular_velocity_rad_per_s.cross(&centre)
                + relative;
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

    /// Flexure angles, base to tip, rad.
    pub fn joint_positions_rad(&self) -> &[f64] {
        &self.state.joint_position_rad[..self.layout.joints]
    }

    /// Flexure rates, base to tip, rad/s.
    pub fn joint_velocities_rad_per_s(&self) -> &[f64] {
        &self.state.joint_velocity_rad_per_s[..self.layout.joints]
    }

    /// Bend of a flexure without load, with what is out of an outer tube now, rad.
    pub fn rest_rad(&self, joint: usize) -> f64 {
        self.rest[joint]
    }

    /// Sum of the flexure angles, rad.
    pub fn bend_rad(&self) -> f64 {
        self.joint_positions_rad().iter().sum()
    }

    /// Pose of link `link` (0 is the shaft at the base origin, i + 1 sits at flexure i), z along the link. An index past the last link
    /// returns the last link.
    pub fn t_world_link(&self, link: usize) -> Isometry3<f64> {
        let link = link.min(self.layout.joints);
        self.t_world_point(link, 0.0)
    }

    /// Poses of all links, starting with the shaft.
    pub fn link_poses(&self) -> impl Iterator<Item = Isometry3<f64>> + '_ {
        (0..=self.layout.joints).map(|link| self.t_world_point(link, 0.0))
    }

    /// Pose of the tip frame: origin at the burr centre, z along the last link.
    pub fn t_world_tip(&self) -> Isometry3<f64> {
        let n = self.layout.joints;
        self.t_world_point(n, self.layout.length_m[n - 1])
    }

    fn t_world_point(&self, link: usize, along_m: f64) -> Isometry3<f64> {
        let angle: f64 = self.state.joint_position_rad[..link].iter().sum();
        let point = self.configuration.point(link, along_m);
        let translation = Translation3::new(point[0], self.state.mount_displacement_m[1], point[1]);
        let rotation = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), angle);
        self.state.base.t_world_base * Isometry3::from_parts(translation, rotation)
    }

    /// Base motion at the end of the last step.
    pub fn base(&self) -> &BaseMotion {
        &self.state.base
    }

    /// Teleports the base and keeps shape and relative motion. For scene set-up, not for motion.
    pub fn place_base(&mut self, base: &BaseMotion) -> Result<(), ManipulatorError> {
        validation::validate_base(base)?;
        self.state.base = *base;
        self.update_configuration();
        Ok(())
    }

    /// Tension of each tendon at its proximal end after the last step, N.
    pub fn tendon_tensions_n(&self) -> [f64; MAX_TENDONS] {
        self.state.report.tendon_tension_n
    }

    /// Pulled length of each tendon after the last step, including its stretch, m.
    pub fn tendon_displacements_m(&self) -> [f64; MAX_TENDONS] {
        self.state.report.tendon_displacement_m
    }

    /// Wrench of the tool on the flange in the last step: world axes, torque about the base origin.
    pub fn flange_wrench(&self) -> Wrench {
        self.state.report.flange_wrench
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
        let mut energy = 0.0;
        for i in 0..self.layout.joints {
            let q = self.state.joint_position_rad[i] - self.rest[i];
            energy += 0.5 * self.stiffness[i] * q * q;
        }
        for k in 0..3 {
            let u = self.state.mount_displacement_m[k];
            energy += 0.5 * self.parameters.mount_stiffness_n_per_m[k] * u * u;
        }
        energy + self.kinetic_energy_j()
    }

    /// Kinetic energy relative to the base, J.
    pub fn kinetic_energy_j(&self) -> f64 {
        let state = &self.state;
        let mount = &state.mount_velocity_m_per_s;
        let (mut omega, mut v, mut energy) = (0.0, [mount[0], mount[2]], 0.0);
        for link in 0..=self.layout.joints {
            let body = &self.layout.body[link];
            let e = &self.configuration.axis[link];
            if link > 0 {
                omega += state.joint_velocity_rad_per_s[link - 1];
            }
            let arm = omega * body.centre_m;
            let (x, z) = (v[0] + arm * e[1], v[1] - arm * e[0]);
            let squared = x * x + z * z + mount[1] * mount[1];
            energy += 0.5 * (body.mass_kg * squared + body.inertia_kg_m2 * omega * omega);
            let length = if link == 0 { self.layout.first_joint_m } else { self.layout.length_m[link - 1] };
            v = [v[0] + omega * length * e[1], v[1] - omega * length * e[0]];
        }
        energy
    }

    /// The complete dynamic state.
    pub(crate) fn state(&self) -> &ManipulatorState {
        &self.state
    }

    /// A copy of the complete dynamic state.
    pub fn snapshot(&self) -> ManipulatorState {
        self.state.clone()
    }

    /// Continues bit for bit from a snapshot of a tool with the same parameters.
    pub fn restore(&mut self, state: &ManipulatorState) {
        self.state.clone_from(state);
        self.update_configuration();
    }
}
