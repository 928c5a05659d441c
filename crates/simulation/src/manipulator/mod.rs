//! The planar manipulator model: a chain of flexures in reduced coordinates, stepped implicitly, with
//! tendons, contacts and joint stops in the same velocity solve. The five models of increasing detail are the
//! rungs of a ladder ([`Rung`]); this is the middle one.
//!
//! # Frames
//!
//! World is the patient frame (LPS, metres). The base frame is at the flange: +z is the insertion axis along
//! the straight tool, +x the bending direction toward tendon 0. Every flexure turns about +y, so positive
//! angles bend toward +x. A translational mount (three springs along the base axes) connects the tool to the
//! base and carries axial and out-of-plane loads; the chain itself bends only in the x-z plane. Link 0 is the
//! rigid shaft; link i + 1 is distal to flexure i. The tip frame is that of the last link, with its origin at
//! the burr centre.
//!
//! # Method
//!
//! Hinges are at the flexure centres, which makes the error against the continuum O(1/n^2). The operator `M +
//! dt D + dt^2 K` is factored in O(n) (`articulated`). Tendons act along their channels (`tendon`). Contact
//! is compliant and solved by Newton's method, each of whose iterations factors the same operator with the
//! pressing contacts on its links (`contact`). Nothing is allocated after [`Manipulator::new`].

#![expect(
    clippy::needless_range_loop,
    reason = "loops over joints and vector components index several arrays at once"
)]

mod articulated;
mod common;
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
mod tip_jacobian;
mod validation;

use nalgebra::{Isometry3, Vector3};
use scene::MAX_CUTTER_BALLS;

use articulated::{Articulated, Generalised};
use common::StateSizes;
use contact::ContactSolver;
use coupling::Coupling;
use geometry::{Configuration, Layout};
use loads::Loads;
use model::own_parts;
use pressing::{MAX_FREEDOMS, MOUNT};
use spatial::algebra::{shift_along, turn_about};
use tendon::{Channels, TendonLoad};
use tip_jacobian::{LinkMotion, Pulls, stiffness, supports};

pub use common::Common;
pub use constant_curvature::ConstantCurvature;
pub use error::ManipulatorError;
pub use flexure::{Notch, StiffnessRatios, UnitStiffness};
pub use geometry::SphereKind;
pub use model::{AnyManipulator, ManipulatorModel, Rung};
pub use moment_modes::MomentModes;
pub use outer_tube::{BendingSpring, OuterTube};
pub(crate) use parameters::pitch_m;
pub use parameters::{
    ContactParameters, Integrator, ManipulatorParameters, STANDARD_MOMENT_MODES, Section, TendonParameters,
    TendonReach, TendonRoute,
};
use pressed::PressedStops;
pub use spatial::SpatialChain;
pub use state::{
    BaseMotion, ContactResult, ManipulatorState, ProxySphere, StepInput, StepReport, TendonCommand, Wrench,
};
pub use tip_jacobian::TipJacobian;

/// Maximum number of flexures of the planar rung.
pub const MAX_JOINTS: usize = 32;
/// Maximum number of flexures of the spatial rungs.
pub const MAX_LINKS: usize = 64;
/// Maximum number of tendons.
pub const MAX_TENDONS: usize = 4;
/// Maximum number of proxy spheres on the shaft.
pub const MAX_SHAFT_SPHERES: usize = 8;
/// Maximum number of proxy spheres: shaft, one per segment, and burr.
pub(crate) const MAX_SPHERES: usize = MAX_SHAFT_SPHERES + MAX_JOINTS + MAX_CUTTER_BALLS;
/// Capacity for contacts per sphere. Most spheres have at most four; one in a hole of its own size can have
/// more.
pub const CONTACTS_PER_SPHERE: usize = 10;
/// Number of spheres in the contact capacity: shaft, one per segment, one burr. The balls of a longer burr
/// share the capacity of the whole tool.
const COUNTED_SPHERES: usize = MAX_SHAFT_SPHERES + MAX_JOINTS + 1;
/// Maximum contacts per step; excess contacts are rejected and counted.
pub const MAX_CONTACTS: usize = CONTACTS_PER_SPHERE * COUNTED_SPHERES;

/// The planar manipulator model; see the [module](self).
#[derive(Debug, Clone)]
pub struct Manipulator {
    common: Common,
    layout: Layout,
    stiffness: [f64; MAX_JOINTS],
    /// Unloaded joint angles, rad.
    rest: [f64; MAX_JOINTS],
    damping: [f64; MAX_JOINTS],
    /// Configuration, derived from the state.
    configuration: Configuration,
    /// This and the following fields are workspace.
    trial: Configuration,
    articulated: Articulated,
    tendon: TendonLoad,
    coupling: Coupling<Generalised>,
    loads: Loads,
    contact: ContactSolver<4>,
    pressed: PressedStops,
}

impl Manipulator {
    /// Creates a tool in its rest shape, at rest on `base`, with slack tendons.
    ///
    /// # Errors
    /// A parameter is out of range, or a tendon winds around the tool; the error names it.
    pub fn new(parameters: ManipulatorParameters, base: &BaseMotion) -> Result<Self, ManipulatorError> {
        Common::check(&parameters, base)?;
        let given = parameters.joint_positions_m.len();
        if given > MAX_JOINTS {
            let expected = "1 to 32 for the planar model";
            return Err(ManipulatorError::Length { field: "joint_positions_m", given, expected });
        }
        helix::refuse(&parameters, "0: the planar model cannot twist")?;
        let layout = Layout::new(&parameters);
        let n = layout.joints;
        let mut stiffness = [0.0; MAX_JOINTS];
        stiffness[..n].copy_from_slice(&parameters.joint_stiffness_nm_per_rad);
        let mut rest = [0.0; MAX_JOINTS];
        rest[..parameters.joint_rest_rad.len()].copy_from_slice(&parameters.joint_rest_rad);
        let (channels, first) = (Channels::of(&parameters), parameters.first_frequency_rad_per_s());
        let room = StateSizes { freedoms: MAX_FREEDOMS, stops: MAX_JOINTS, contacts: MAX_CONTACTS };
        let common = Common::new(Rung::Planar, parameters, base, layout.total_mass_kg, first, room);
        let mut manipulator = Self {
            damping: stiffness.map(|k| common.damping_s() * k),
            common,
            stiffness,
            rest,
            configuration: Configuration::new(),
            trial: Configuration::new(),
            articulated: Articulated::new(n),
            tendon: TendonLoad::new(channels),
            coupling: Coupling::new(Generalised::ZERO),
            loads: Loads::new(),
            contact: ContactSolver::new(pressing::first_freedoms(n), MAX_CONTACTS),
            pressed: PressedStops::new(n),
            layout,
        };
        manipulator.set_deployed(0.0);
        manipulator.common.state.position[MOUNT..].copy_from_slice(&manipulator.rest);
        manipulator.follow_state();
        Ok(manipulator)
    }

    /// Returns the kinetic energy relative to the base, J.
    pub fn kinetic_energy_j(&self) -> f64 {
        let Generalised { joint, mount } = Generalised::of(&self.common.state.velocity);
        let (mut omega, mut v, mut energy) = (0.0, [mount[0], mount[2]], 0.0);
        for link in 0..=self.layout.joints {
            let body = &self.layout.body[link];
            let e = &self.configuration.axis[link];
            if link > 0 {
                omega += joint[link - 1];
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
}

impl ManipulatorModel for Manipulator {
    own_parts!();

    fn follow_state(&mut self) {
        self.common.copy_bend(|joint| MOUNT + joint);
        let state = &self.common.state;
        let (q, v) = (Generalised::of(&state.position), Generalised::of(&state.velocity));
        self.configuration.update(&self.layout, &q.joint, &q.mount);
        let (pose, mount) = (&state.base.t_world_base, &v.mount);
        let rotation = pose.rotation.to_rotation_matrix();
        // Rate and origin velocity (x, z) of the link that carries the sphere; spheres come in ascending link
        // order.
        let (mut link, mut omega, mut origin) = (0, 0.0, [mount[0], mount[2]]);
        for (sphere, fixed) in self.common.spheres.iter_mut().zip(&self.common.sphere_layout) {
            while link < fixed.link {
                let length =
                    if link == 0 { self.layout.first_joint_m } else { self.layout.length_m[link - 1] };
                let e = &self.configuration.axis[link];
                origin = [origin[0] + omega * length * e[1], origin[1] - omega * length * e[0]];
                omega += v.joint[link];
                link += 1;
            }
            let e = &self.configuration.axis[link];
            let c = self.configuration.point(link, fixed.along_m);
            let arm = omega * fixed.along_m;
            let relative = rotation * Vector3::new(origin[0] + arm * e[1], mount[1], origin[1] - arm * e[0]);
            let centre = rotation * Vector3::new(c[0], q.mount[1], c[1]);
            sphere.centre_m = pose.translation.vector + centre;
            sphere.velocity_m_per_s = state.base.linear_velocity_m_per_s
                + state.base.angular_velocity_rad_per_s.cross(&centre)
                + relative;
        }
    }

    fn update_take_up(&mut self) {
        let take_up = |t: usize| self.tendon.take_up(&self.configuration, t);
        self.common.set_take_up(&self.tendon.channels, take_up);
    }

    fn set_deployed(&mut self, deployed_m: f64) {
        if self.common.parameters.outer_tube.is_none() {
            return;
        }
        for joint in 0..self.layout.joints {
            let spring = self.common.parameters.bending_spring(joint, deployed_m);
            (self.stiffness[joint], self.rest[joint]) = (spring.bend_nm_per_rad, spring.rest_rad);
            self.damping[joint] = self.common.damping_s() * spring.bend_nm_per_rad;
        }
        self.common.cover_spheres(deployed_m);
    }

    fn rest_rad(&self, joint: usize) -> f64 {
        self.rest[joint]
    }

    fn t_world_point(&self, link: usize, along_m: f64) -> Isometry3<f64> {
        let angle: f64 = self.common.bend[0][..link].iter().sum();
        self.common.t_world_in_plane(self.configuration.point(link, along_m), angle)
    }

    fn energy_j(&self) -> f64 {
        let Generalised { joint, mount } = Generalised::of(&self.common.state.position);
        let mut energy = 0.0;
        for i in 0..self.layout.joints {
            let q = joint[i] - self.rest[i];
            energy += 0.5 * self.stiffness[i] * q * q;
        }
        for (u, stiffness) in mount.iter().zip(&self.common.parameters.mount_stiffness_n_per_m) {
            energy += 0.5 * stiffness * u * u;
        }
        energy + self.kinetic_energy_j()
    }

    fn damping_w(&self) -> f64 {
        let Generalised { joint, .. } = Generalised::of(&self.common.state.velocity);
        let flexures = self.damping.iter().zip(&joint[..self.layout.joints]);
        self.common.mount_damping_w() + flexures.map(|(damping, rate)| damping * rate * rate).sum::<f64>()
    }

    fn tendon_friction_w(&self) -> f64 {
        tendon::friction_w(&self.tendon_tensions_n(), &self.tendon.lost, self.joint_velocities_rad_per_s())
    }

    fn tip_motion(&self) -> LinkMotion {
        let Self { common, layout, configuration, .. } = self;
        let (law, mut pulls) =
            (common.parameters.stop_law(), Pulls::of(&self.tendon.channels, &common.state));
        let (mut motion, mut supports) = (LinkMotion::of_base(), supports(common).peekable());
        for (axis, stiffness) in [Vector3::x(), Vector3::y(), Vector3::z()]
            .into_iter()
            .zip(common.parameters.mount_stiffness_n_per_m)
        {
            motion.cross(&shift_along(&axis), stiffness, &[0.0; MAX_TENDONS]);
        }
        for link in 0..=layout.joints {
            if let Some(i) = link.checked_sub(1) {
                let half = [configuration.half_sin[i], configuration.half_cos[i]];
                let (added, pull) = pulls.planar(i, common.bend[0][i], half);
                let stop = law.stiffness_at(common.state.stop_torque_nm[i]);
                let [x, z] = configuration.origin[link];
                let axis = turn_about(&Vector3::new(x, 0.0, z), &Vector3::y());
                motion.cross(&axis, stiffness(self.stiffness[i], added, stop), &pull);
            }
            while let Some(support) = supports.next_if(|support| support.link == link) {
                motion.support(&support.force, common.parameters.contact.stiffness_n_per_m);
            }
        }
        motion
    }

    fn mass_moment_kg_m(&self) -> Vector3<f64> {
        let across_m = self.common.state.position[1];
        (0..=self.layout.joints).fold(Vector3::zeros(), |sum, link| {
            let body = &self.layout.body[link];
            let [x, z] = self.configuration.point(link, body.centre_m);
            sum + Vector3::new(x, across_m, z) * body.mass_kg
        })
    }
}
