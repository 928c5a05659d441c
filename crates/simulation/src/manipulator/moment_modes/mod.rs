//! The planar tool in a few moment modes: as exact at rest as all flexures, with 2 to 8 degrees of freedom and the mount's three.
//!
//! Every flexure is still there, with its place, its spring, its links' masses and its proxy sphere; but the bends of all follow from the
//! amplitudes of a few modes of the bending moment (`basis`). Mass, tendons, loads and contacts of the planar rung are projected onto the
//! modes (Galerkin), so frames, laws and parameters are those of [`crate::manipulator`]. The implicit operator is dense and small
//! (`operator`); contacts go through the same solver as in the other rungs, which sees the whole tool as one body.
//!
//! **Where it is not valid.** A flexure on its stop has a bending moment that jumps, which smooth modes cannot follow. The stops are springs
//! on the single flexures all the same, so that nothing bends without bound, but the shape there is an approximation:
//! [`StepReport::stopped_joint_count`] says how many flexures are beyond their stops, and [`MomentModes::is_valid`] is then false. Tendons
//! that bend a part of the tool, and outer tubes, make such jumps by themselves and are refused.

mod basis;
mod contacts;
mod operator;
mod shape;
mod spheres;
mod state;
mod step;
mod tendons;

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};

use super::contact::{ContactSolver, Dense, Factor};
use super::error::{ManipulatorError, check};
use super::geometry::{Layout, SphereLayout};
use super::parameters::{ManipulatorParameters, TendonRoute};
use super::state::{BaseMotion, ContactResult, ProxySphere, StepReport, Wrench};
use super::tendon::Channels;
use super::{MAX_CONTACTS, MAX_JOINTS};
use super::{frequencies, helix};
use basis::Basis;
use operator::Dynamics;
use shape::{Links, Motion, OfFlexures, Shape};
use spheres::SphereWork;
use tendons::{Bent, Tendons};

pub use state::MomentModesState;

/// Freedoms of the mount, base x, y, z; they come first.
const MOUNT: usize = 3;
/// Modes for which [`MomentModes<8>`] has room; more take [`MomentModes<16>`].
pub(super) const FEW_MODES: usize = 5;
/// Most freedoms of either size.
const MAX_FREEDOMS: usize = 16;

/// A continuum manipulator in moment modes. N is the number of freedoms, rounded up: 8 for up to five modes, 16 for more.
#[derive(Debug, Clone)]
pub struct MomentModes<const N: usize> {
    parameters: ManipulatorParameters,
    layout: Layout,
    links: Links,
    basis: Basis<N>,
    /// Bending stiffness (N m/rad) and angle without load (rad) of the flexures; 1 and 0 past the last.
    stiffness: OfFlexures,
    rest: OfFlexures,
    /// Damping of the flexures over their stiffness, s.
    damping_s: f64,
    mount_damping: [f64; MOUNT],
    first_frequency_rad_per_s: f64,
    state: MomentModesState,
    /// The fields from here on are derived from `state`: angles (rad) and rates (rad/s) of the flexures, links, spheres.
    bend: [OfFlexures; 2],
    shape: Shape,
    motion: Motion,
    bent: Bent,
    spheres: Vec<ProxySphere>,
    /// Number of flexures beyond their stops.
    stopped: usize,
    /// The fields from here on are workspace.
    sphere_work: SphereWork,
    trial: (Shape, Motion),
    dynamics: Dynamics<N>,
    factor: Factor<N>,
    tendons: Tendons<N>,
    contact: ContactSolver<N, Dense<N>>,
    /// Contacts of this step that the solver looks at.
    enters: Vec<bool>,
}

/// [`MomentModes::follow_state`], compiled for each instruction set.
struct FollowState<'a, const N: usize> {
    tool: &'a mut MomentModes<N>,
}

impl<const N: usize> pulp::WithSimd for FollowState<'_, N> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) {
        self.tool.follow_state();
    }
}

impl<const N: usize> MomentModes<N> {
    /// A tool in its rest shape, at rest on `base`, with slack tendons.
    ///
    /// # Errors
    /// A parameter is out of range, or the tool bends in parts (an outer tube, tendons that end on the way); the error names it.
    pub fn new(parameters: ManipulatorParameters, base: &BaseMotion) -> Result<Self, ManipulatorError> {
        parameters.validate()?;
        super::validation::validate_base(base)?;
        refuse_jumps(&parameters)?;
        let (given, room) = (parameters.joint_positions_m.len(), parameters.moment_modes <= N - MOUNT);
        if given > MAX_JOINTS {
            let expected = "1 to 32 entries for the rung modal";
            return Err(ManipulatorError::Length { field: "joint_positions_m", given, expected });
        }
        if !room {
            let (field, expected) = ("moment_modes", "at most 5 for MomentModes<8>");
            return Err(ManipulatorError::Length { field, given: parameters.moment_modes, expected });
        }
        let layout = Layout::new(&parameters);
        let (mut stiffness, mut rest) = ([1.0; MAX_JOINTS], [0.0; MAX_JOINTS]);
        stiffness[..given].copy_from_slice(&parameters.joint_stiffness_nm_per_rad);
        rest[..parameters.joint_rest_rad.len()].copy_from_slice(&parameters.joint_rest_rad);
        let first = frequencies::first_frequency_rad_per_s(
            layout.first_joint_m,
            &layout.length_m[..given],
            &layout.body[..=given],
            &stiffness[..given],
        );
        let ratio = parameters.mount_damping_ratio;
        let mount_damping =
            parameters.mount_stiffness_n_per_m.map(|k| 2.0 * ratio * libm::sqrt(k * layout.total_mass_kg));
        let blank = |s: &SphereLayout| ProxySphere {
            centre_m: Vector3::zeros(),
            velocity_m_per_s: Vector3::zeros(),
            radius_m: s.radius_m,
            kind: s.kind,
        };
        let mut tool = Self {
            basis: Basis::new(&parameters),
            spheres: layout.spheres.iter().map(blank).collect(),
            stiffness,
            rest,
            damping_s: 2.0 * parameters.damping_ratio / first,
            mount_damping,
            first_frequency_rad_per_s: first,
            state: MomentModesState::new(base),
            bend: [[0.0; MAX_JOINTS]; 2],
            shape: Shape::new(),
            motion: Motion::new(),
            bent: Bent::NONE,
            stopped: 0,
            sphere_work: SphereWork::new(&layout.spheres),
            trial: (Shape::new(), Motion::new()),
            dynamics: Dynamics::new(),
            factor: Factor::new(),
            tendons: Tendons::new(Channels::of(&parameters)),
            contact: ContactSolver::on(Dense::new(), (1, 0), MAX_CONTACTS),
            enters: vec![false; MAX_CONTACTS],
            links: Links::of(&layout),
            layout,
            parameters,
        };
        tool.update_shape();
        Ok(tool)
    }

    /// The first N entries of a vector of the state.
    #[inline(always)]
    fn freedoms(all: &[f64; MAX_FREEDOMS]) -> [f64; N] {
        core::array::from_fn(|k| all[k])
    }

    #[inline(always)]
    fn mount_of(x: &[f64; N]) -> [f64; MOUNT] {
        [x[0], x[1], x[2]]
    }

    /// Angles of the flexures for amplitudes `x`, rad.
    #[inline(always)]
    fn angles(&self, x: &[f64; N]) -> OfFlexures {
        let mut q = self.basis.angles(x);
        for (q, rest) in q.iter_mut().zip(&self.rest) {
            *q += rest;
        }
        q
    }

    /// Flexures, links and spheres for the present state.
    fn update_shape(&mut self) {
        let arch = self.contact.arch;
        arch.dispatch(FollowState { tool: self });
    }

    #[inline(always)]
    fn follow_state(&mut self) {
        let (x, v) = (Self::freedoms(&self.state.position), Self::freedoms(&self.state.velocity));
        self.bend = [self.angles(&x), self.basis.angles(&v)];
        let mount = Self::mount_of(&x);
        self.shape.update(&self.links, &self.bend[0], &mount);
        self.bent = Bent::of(&self.shape);
        let rate = Self::mount_of(&v);
        self.motion.update(&self.links, &self.shape, &self.bend[1], &rate);
        let (spheres, moves) =
            ((&mut self.spheres[..], &self.layout.spheres[..]), (&self.links, &self.shape, &self.motion));
        self.sphere_work.place(spheres, moves, (&mount, &rate), &self.state.base);
        let limit = self.parameters.joint_limit_rad;
        let mut stopped = [false; MAX_JOINTS];
        for i in 0..MAX_JOINTS {
            stopped[i] = (self.bend[0][i] - self.rest[i]).abs() > limit;
        }
        self.stopped =
            if stopped == [false; MAX_JOINTS] { 0 } else { stopped.iter().filter(|s| **s).count() };
    }

    /// Makes the tool straight, and at rest: a pre-curved tool that a hole or a guide holds. As straight as the modes allow: the bend that
    /// is left has the least elastic energy.
    pub fn straighten(&mut self) {
        self.state.velocity.fill(0.0);
        let moment = core::array::from_fn(|i| -self.stiffness[i] * self.rest[i]);
        // The modes are orthonormal under the compliance.
        let amplitudes = self.basis.project(&moment);
        self.state.position.fill(0.0);
        self.state.position[..N].copy_from_slice(&amplitudes);
        self.update_shape();
        for t in 0..self.tendons.channels.count {
            self.state.tendon[t].take_up_m = self.bent.take_up_m(&self.tendons.channels, t);
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

    /// Number of flexures.
    pub fn joint_count(&self) -> usize {
        self.layout.joints
    }

    /// Number of modes.
    pub fn mode_count(&self) -> usize {
        self.basis.modes
    }

    /// False while a flexure is beyond its stop: see the module's documentation.
    pub fn is_valid(&self) -> bool {
        self.stopped == 0
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

    /// Flexure angles that the modes imply, base to tip, rad.
    pub fn joint_positions_rad(&self) -> &[f64] {
        &self.bend[0][..self.layout.joints]
    }

    /// Flexure rates that the modes imply, base to tip, rad/s.
    pub fn joint_velocities_rad_per_s(&self) -> &[f64] {
        &self.bend[1][..self.layout.joints]
    }

    /// Bend of a flexure without load, rad.
    pub fn rest_rad(&self, joint: usize) -> f64 {
        self.rest[joint]
    }

    /// Pose of link `link` (0 is the shaft at the base origin, i + 1 sits at flexure i), z along the link. An index past the last link
    /// returns the last link.
    pub fn t_world_link(&self, link: usize) -> Isometry3<f64> {
        self.t_world_point(link.min(self.layout.joints), 0.0)
    }

    /// Pose of the tip frame: origin at the burr centre, z along the last link.
    pub fn t_world_tip(&self) -> Isometry3<f64> {
        let n = self.layout.joints;
        self.t_world_point(n, self.layout.length_m[n - 1])
    }

    fn t_world_point(&self, link: usize, along_m: f64) -> Isometry3<f64> {
        let angle: f64 = self.bend[0][..link].iter().sum();
        let point = self.shape.point(link, along_m);
        let translation = Translation3::new(point[0], self.state.position[1], point[1]);
        let rotation = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), angle);
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
        self.update_shape();
        Ok(())
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

    /// Kinetic energy relative to the base plus elastic energy of modes and mount, J.
    pub fn energy_j(&self) -> f64 {
        let (x, v) = (&self.state.position, &self.state.velocity);
        let mut energy: f64 = x[MOUNT..].iter().map(|c| 0.5 * c * c).sum();
        for (k, stiffness) in self.parameters.mount_stiffness_n_per_m.iter().enumerate() {
            energy += 0.5 * stiffness * x[k] * x[k];
        }
        for l in 0..=self.links.joints {
            let (arm, omega) = (self.motion.omega[l] * self.links.centre_m[l], self.motion.omega[l]);
            let x = self.motion.vx[l] + arm * self.shape.cos[l];
            let z = self.motion.vz[l] - arm * self.shape.sin[l];
            let squared = x * x + z * z + v[1] * v[1];
            energy += 0.5 * (self.links.mass_kg[l] * squared + self.links.inertia_kg_m2[l] * omega * omega);
        }
        energy
    }

    /// The complete dynamic state.
    pub(crate) fn state(&self) -> &MomentModesState {
        &self.state
    }

    /// A copy of the complete dynamic state.
    pub fn snapshot(&self) -> MomentModesState {
        self.state.clone()
    }

    /// Continues bit for bit from a snapshot of a tool with the same parameters.
    pub fn restore(&mut self, state: &MomentModesState) {
        self.state.clone_from(state);
        self.update_shape();
    }
}

/// A few smooth moments cannot jump where a tendon or an outer tube ends, nor twist.
fn refuse_jumps(p: &ManipulatorParameters) -> Result<(), ManipulatorError> {
    helix::refuse(p, "0: the rung modal does not twist")?;
    if let Some(outer) = &p.outer_tube {
        let allowed = "none: the moments of the rung modal do not jump where an outer tube ends";
        check("outer_tube.end_m", outer.end_m, allowed, |_| false)?;
    }
    let joints = p.joint_positions_m.len();
    for TendonRoute { reach, .. } in p.tendon_routes.iter().flatten() {
        let allowed = "all flexures: the moments of the rung modal do not jump where a tendon ends";
        let number = reach.to.unwrap_or(joints) - reach.from;
        check("tendon_routes.reach", number as f64, allowed, |_| number == joints)?;
    }
    Ok(())
}
