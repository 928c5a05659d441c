//! The planar tool in a few moment modes: as accurate at rest as the full planar chain, with 2 to 8 degrees
//! of freedom plus three of the mount.
//!
//! Every flexure keeps its position, its spring, its links' masses and its proxy sphere, but all bends follow
//! from the amplitudes of a few modes of the bending moment (`basis`). Mass, tendons, loads and contacts of
//! the planar rung are projected onto the modes (Galerkin), so frames, laws and parameters are those of
//! [`crate::manipulator`]. The implicit operator is dense and small (`operator`); contacts go through the
//! same solver as in the other rungs, which sees the whole tool as one body.
//!
//! **Where it is not valid.** At a flexure on its stop, the bending moment jumps, which smooth modes cannot
//! represent. The stops still act as springs on the individual flexures, which bounds the bend, but the shape
//! there is an approximation: [`StepReport::stopped_joint_count`] is the number of flexures beyond their
//! stops, and [`ManipulatorModel::is_valid`] then returns false. Tendons that bend only part of the tool, and
//! outer tubes, cause such jumps by themselves and are rejected.

mod basis;
mod contacts;
mod operator;
mod shape;
mod spheres;
mod step;
mod tendons;

use nalgebra::{Isometry3, Vector3};

use super::common::{Common, StateSizes};
use super::contact::chain::add_scaled;
use super::contact::{ContactSolver, Dense, Factor};
use super::error::{ManipulatorError, check};
use super::geometry::Layout;
use super::helix;
use super::model::{ManipulatorModel, Rung, own_parts};
use super::parameters::{ManipulatorParameters, TendonRoute};
use super::spatial::algebra::{dot, shift_along, turn_about};
use super::state::{BaseMotion, StepInput, StepReport};
use super::tendon::{Channels, friction_w};
use super::tip_jacobian::{FewFreedoms, LinkMotion, Pulls, supports};
use super::{MAX_CONTACTS, MAX_JOINTS};
use basis::Basis;
use operator::Dynamics;
use shape::{FlexureArray, Links, Motion, Shape};
use spheres::SphereWork;
use tendons::{BendSums, Tendons};

/// Number of freedoms of the mount, base x, y, z, which come first.
const MOUNT: usize = 3;
/// Maximum number of modes of [`MomentModes<8>`]; more need [`MomentModes<16>`].
pub(super) const FEW_MODES: usize = 5;

/// A continuum manipulator in moment modes. N is the number of freedoms, rounded up: 8 for up to five modes,
/// 16 for more.
#[derive(Debug, Clone)]
pub struct MomentModes<const N: usize> {
    common: Common,
    layout: Layout,
    links: Links,
    basis: Basis<N>,
    /// Bending stiffness (N m/rad) and unloaded angle (rad) of the flexures; 1 and 0 past the last.
    stiffness: FlexureArray,
    rest: FlexureArray,
    /// Damping of the flexures over their stiffness, s.
    damping_s: f64,
    /// This and the following fields are derived from the state: angles (rad) and rates (rad/s) of the
    /// flexures, links.
    bend: [FlexureArray; 2],
    shape: Shape,
    motion: Motion,
    bent: BendSums,
    /// Number of flexures beyond their stops.
    stopped: usize,
    /// This and the following fields are workspace.
    sphere_work: SphereWork,
    trial: (Shape, Motion),
    dynamics: Dynamics<N>,
    factor: Factor<N>,
    tendons: Tendons<N>,
    contact: ContactSolver<N, Dense<N>>,
    /// Contacts of this step that enter the solver.
    enters: Vec<bool>,
}

/// [`MomentModes::update_shape`], compiled for each instruction set.
struct UpdateShape<'a, const N: usize> {
    tool: &'a mut MomentModes<N>,
}

impl<const N: usize> pulp::WithSimd for UpdateShape<'_, N> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) {
        self.tool.update_shape();
    }
}

impl<const N: usize> MomentModes<N> {
    /// Creates a tool in its rest shape, at rest on `base`, with slack tendons.
    ///
    /// # Errors
    /// A parameter is out of range, or the tool has moment jumps (an outer tube, tendons that end before the
    /// tip); the error names it.
    pub fn new(parameters: ManipulatorParameters, base: &BaseMotion) -> Result<Self, ManipulatorError> {
        Common::check(&parameters, base)?;
        refuse_jumps(&parameters)?;
        let (given, enough) = (parameters.joint_positions_m.len(), parameters.moment_modes <= N - MOUNT);
        if given > MAX_JOINTS {
            let expected = "1 to 32 for the modal model";
            return Err(ManipulatorError::Length { field: "joint_positions_m", given, expected });
        }
        if !enough {
            let (field, expected) = ("moment_modes", "at most 5 for MomentModes<8>");
            return Err(ManipulatorError::Length { field, given: parameters.moment_modes, expected });
        }
        let layout = Layout::new(&parameters);
        let (mut stiffness, mut rest) = ([1.0; MAX_JOINTS], [0.0; MAX_JOINTS]);
        stiffness[..given].copy_from_slice(&parameters.joint_stiffness_nm_per_rad);
        rest[..parameters.joint_rest_rad.len()].copy_from_slice(&parameters.joint_rest_rad);
        let first = parameters.first_frequency_rad_per_s();
        let (basis, channels) = (Basis::new(&parameters), Channels::of(&parameters));
        let room = StateSizes { freedoms: N, stops: 0, contacts: MAX_CONTACTS };
        let common = Common::new(Rung::Modal, parameters, base, layout.total_mass_kg, first, room);
        let mut tool = Self {
            basis,
            stiffness,
            rest,
            damping_s: common.damping_s(),
            bend: [[0.0; MAX_JOINTS]; 2],
            shape: Shape::new(),
            motion: Motion::new(),
            bent: BendSums::NONE,
            stopped: 0,
            sphere_work: SphereWork::new(&common.sphere_layout),
            common,
            trial: (Shape::new(), Motion::new()),
            dynamics: Dynamics::new(),
            factor: Factor::new(),
            tendons: Tendons::new(channels),
            contact: ContactSolver::on(Dense::new(), (1, 0), MAX_CONTACTS),
            enters: vec![false; MAX_CONTACTS],
            links: Links::of(&layout),
            layout,
        };
        tool.follow_state();
        Ok(tool)
    }

    /// Returns position and velocity.
    #[inline(always)]
    fn freedoms(&self) -> [[f64; N]; 2] {
        let (mut x, mut v) = ([0.0; N], [0.0; N]);
        x.copy_from_slice(&self.common.state.position);
        v.copy_from_slice(&self.common.state.velocity);
        [x, v]
    }

    #[inline(always)]
    fn mount_of(x: &[f64; N]) -> [f64; MOUNT] {
        [x[0], x[1], x[2]]
    }

    /// Returns the angles of the flexures for amplitudes `x`, rad.
    #[inline(always)]
    fn angles(&self, x: &[f64; N]) -> FlexureArray {
        let mut q = self.basis.angles(x);
        for (q, rest) in q.iter_mut().zip(&self.rest) {
            *q += rest;
        }
        q
    }

    /// Updates flexures, links and spheres for the present state.
    #[inline(always)]
    fn update_shape(&mut self) {
        let [x, v] = self.freedoms();
        self.bend = [self.angles(&x), self.basis.angles(&v)];
        for (all, bend) in self.common.bend.iter_mut().zip(&self.bend) {
            all.copy_from_slice(&bend[..self.layout.joints]);
        }
        let mount = Self::mount_of(&x);
        self.shape.update(&self.links, &self.bend[0], &mount);
        self.bent = BendSums::of(&self.shape);
        let rate = Self::mount_of(&v);
        self.motion.update(&self.links, &self.shape, &self.bend[1], &rate);
        let Common { spheres, sphere_layout, state, parameters, .. } = &mut self.common;
        let moves = (&self.links, &self.shape, &self.motion);
        self.sphere_work.place((spheres, sphere_layout), moves, (&mount, &rate), &state.base);
        let limit = parameters.joint_limit_rad;
        let mut stopped = [false; MAX_JOINTS];
        for i in 0..MAX_JOINTS {
            stopped[i] = (self.bend[0][i] - self.rest[i]).abs() > limit;
        }
        self.stopped =
            if stopped == [false; MAX_JOINTS] { 0 } else { stopped.iter().filter(|s| **s).count() };
    }
}

impl<const N: usize> ManipulatorModel for MomentModes<N> {
    own_parts!();

    fn follow_state(&mut self) {
        self.common.arch.dispatch(UpdateShape { tool: self });
    }

    /// Straightens the tool as far as the modes allow: the remaining bend has minimum elastic energy.
    fn straighten(&mut self) {
        self.common.straighten();
        let moment = core::array::from_fn(|i| -self.stiffness[i] * self.rest[i]);
        // Projects onto the modes, which are orthonormal under the compliance.
        self.common.state.position.copy_from_slice(&self.basis.project(&moment));
        self.follow_state();
        self.update_take_up();
    }

    fn update_take_up(&mut self) {
        let Self { common, tendons: Tendons { channels, .. }, bent, .. } = self;
        common.set_take_up(channels, |t| bent.take_up_m(channels, t));
    }

    /// Returns false while a flexure is beyond its stop; see the module's documentation.
    fn is_valid(&self) -> bool {
        self.stopped == 0
    }

    fn rest_rad(&self, joint: usize) -> f64 {
        self.rest[joint]
    }

    fn t_world_point(&self, link: usize, along_m: f64) -> Isometry3<f64> {
        let angle: f64 = self.bend[0][..link].iter().sum();
        self.common.t_world_in_plane(self.shape.point(link, along_m), angle)
    }

    fn energy_j(&self) -> f64 {
        let [x, v] = self.freedoms();
        let mut energy: f64 = x[MOUNT..].iter().map(|c| 0.5 * c * c).sum();
        for (k, stiffness) in self.common.parameters.mount_stiffness_n_per_m.iter().enumerate() {
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

    fn damping_w(&self) -> f64 {
        let [_, v] = self.freedoms();
        let modes: f64 = v[MOUNT..].iter().map(|rate| self.damping_s * rate * rate).sum();
        self.common.mount_damping_w() + modes
    }

    fn tendon_friction_w(&self) -> f64 {
        friction_w(&self.tendon_tensions_n(), &self.tendons.lost, self.joint_velocities_rad_per_s())
    }

    fn tip_motion(&self) -> LinkMotion {
        let Self { common, links, basis, shape, .. } = self;
        let (mut pulls, parameters) = (Pulls::of(&self.tendons.channels, &common.state), &common.parameters);
        let mut few = FewFreedoms::new();
        for k in 0..N {
            let mount = parameters.mount_stiffness_n_per_m.get(k);
            few.operator[k][k] = *mount.unwrap_or(&1.0);
        }
        let mut supports = supports(common).peekable();
        for (axis, unit) in few.axis.iter_mut().zip([Vector3::x(), Vector3::y(), Vector3::z()]) {
            *axis = shift_along(&unit);
        }
        for link in 0..=links.joints {
            if let Some(i) = link.checked_sub(1) {
                let (row, q) = (&basis.of_flexure[i], self.bend[0][i]);
                let (added, pull) = pulls.planar(i, q, [shape.half_sin[i], shape.half_cos[i]]);
                let is_stopped = (q - self.rest[i]).abs() > parameters.joint_limit_rad;
                let stop = if is_stopped { parameters.joint_stop_stiffness_nm_per_rad } else { 0.0 };
                few.add_spring(row, added.max(-self.stiffness[i]) + stop);
                let turn = turn_about(&Vector3::new(shape.x[link], 0.0, shape.z[link]), &Vector3::y());
                for k in MOUNT..N {
                    add_scaled(&mut few.axis[k], row[k], &turn);
                }
                few.add_pull(row, &pull);
            }
            while let Some(support) = supports.next_if(|support| support.link == link) {
                let on = few.axis.each_ref().map(|axis| dot(axis, &support.force));
                few.add_support(&on, &support.force, parameters.contact.stiffness_n_per_m);
            }
        }
        few.tip_motion()
    }

    fn mass_moment_kg_m(&self) -> Vector3<f64> {
        let across_m = self.common.state.position[1];
        (0..=self.links.joints).fold(Vector3::zeros(), |sum, link| {
            let [x, z] = self.shape.point(link, self.links.centre_m[link]);
            sum + Vector3::new(x, across_m, z) * self.links.mass_kg[link]
        })
    }
}

/// Rejects tools that smooth planar moments cannot represent: a tendon or an outer tube that ends before the
/// tip, and winding tendons.
fn refuse_jumps(p: &ManipulatorParameters) -> Result<(), ManipulatorError> {
    helix::refuse(p, "0: the modal model cannot twist")?;
    if let Some(outer) = &p.outer_tube {
        let allowed = "no outer tube: the modal model cannot represent the moment jump at its end";
        check("outer_tube.end_m", outer.end_m, allowed, |_| false)?;
    }
    let joints = p.joint_positions_m.len();
    for TendonRoute { reach, .. } in p.tendon_routes.iter().flatten() {
        let allowed = "all flexures: the modal model cannot represent the moment jump at a tendon's end";
        let number = reach.to.unwrap_or(joints) - reach.from;
        check("tendon_routes.reach", number as f64, allowed, |_| number == joints)?;
    }
    Ok(())
}
