//! The cheapest rung: the flexible length is one arc of constant curvature, in closed form.
//!
//! Four degrees of freedom: the mount along base x, y, z, and the bend. Exact under a pure end moment and, for a uniform tool, under its
//! frictionless tendons. Under a tip force or in a tunnel it is the best that one curvature can do. The bending stiffness is that of the
//! flexures in series, `1 / sum(1/k)`. Frames, tendons, contact laws and mount are those of the planar rung (see [`crate::manipulator`]).
//! Every step uses linearly implicit Euler.

mod arc;
mod step;

use nalgebra::{Isometry3, Matrix4, Translation3, UnitQuaternion, Vector3, Vector4};
use serde::{Deserialize, Deserializer, Serialize, Serializer, de::Error};

use super::MAX_TENDONS;
use super::contact::ContactSolver;
use super::error::{ManipulatorError, check};
use super::geometry::{BurrBody, SphereLayout, link_lengths_m, spheres};
use super::helix;
use super::parameters::{ManipulatorParameters, TendonRoute};
use super::state::{BaseMotion, ContactResult, ProxySphere, StepReport, Wrench, places_from};
use super::tendon::{Channels, TendonMemory};
use super::{CONTACTS_PER_SPHERE, MAX_LINKS, MAX_SHAFT_SPHERES};
use arc::Arc;

/// Maximum contacts per step, four per sphere; excess contacts are refused and counted.
const MAX_CONTACTS: usize = CONTACTS_PER_SPHERE * (MAX_SHAFT_SPHERES + MAX_LINKS + 1);
/// Nodes and weights of five-point Gauss quadrature on (0, 1), used for the mass along the arc.
const GAUSS: [(f64, f64); 5] = [
    (0.046_910_077_030_668_0, 0.118_463_442_528_094_5),
    (0.230_765_344_947_158_45, 0.239_314_335_249_683_24),
    (0.5, 0.284_444_444_444_444_44),
    (0.769_234_655_052_841_5, 0.239_314_335_249_683_24),
    (0.953_089_922_969_332, 0.118_463_442_528_094_5),
];

/// A lumped mass on the axis.
#[derive(Debug, Clone, Copy)]
struct Lump {
    mass_kg: f64,
    /// Position on the straight tool, m.
    z_m: f64,
    /// About its own centre, axis y.
    inertia_kg_m2: f64,
}

/// The complete dynamic state; restoring it reproduces the run bit for bit.
#[derive(Debug, Clone, PartialEq)]
pub struct ConstantCurvatureState {
    /// Mount displacement (m) and bend (rad), and their velocities.
    position: Vector4<f64>,
    velocity: Vector4<f64>,
    base: BaseMotion,
    tendon: [TendonMemory; MAX_TENDONS],
    /// Torque of the joint stop in the last step, N m.
    stop_torque_nm: f64,
    result_count: usize,
    results: Vec<ContactResult>,
    report: StepReport,
}

impl ConstantCurvatureState {
    /// Copies a state of the same tool without allocating.
    pub(super) fn copy_from(&mut self, other: &Self) {
        self.results.clone_from(&other.results);
        let results = core::mem::take(&mut self.results);
        let Self { position, velocity, base, tendon, stop_torque_nm, result_count, report, .. } = *other;
        *self = Self { position, velocity, base, tendon, stop_torque_nm, result_count, results, report };
    }
}

/// Writes only the used results: entries past the count are left over from earlier steps.
impl Serialize for ConstantCurvatureState {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let results = &self.results[..self.result_count];
        (&self.position, &self.velocity, &self.base, &self.tendon, self.stop_torque_nm, results, &self.report)
            .serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for ConstantCurvatureState {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        type Coordinates = Vector4<f64>;
        type Whole = (
            Coordinates,
            Coordinates,
            BaseMotion,
            [TendonMemory; MAX_TENDONS],
            f64,
            Vec<ContactResult>,
            StepReport,
        );
        let (position, velocity, base, tendon, stop_torque_nm, used, report) =
            Whole::deserialize(deserializer)?;
        let results = places_from(&used, MAX_CONTACTS)
            .ok_or_else(|| D::Error::custom("more contacts than a step has"))?;
        let result_count = used.len();
        Ok(Self { position, velocity, base, tendon, stop_torque_nm, result_count, results, report })
    }
}

/// A continuum manipulator bent to one curvature.
#[derive(Debug, Clone)]
pub struct ConstantCurvature {
    parameters: ManipulatorParameters,
    arc: Arc,
    /// Of the mount (N/m) and the bend (N m/rad).
    stiffness: Vector4<f64>,
    damping: Vector4<f64>,
    /// Bend without load, rad.
    rest_rad: f64,
    limit_rad: f64,
    stop_stiffness_nm_per_rad: f64,
    first_frequency_rad_per_s: f64,
    lumps: Vec<Lump>,
    sphere_layout: Vec<SphereLayout>,
    /// Position of each sphere on the straight tool, m.
    sphere_z_m: Vec<f64>,
    /// Boundaries of the flexures' cells, m.
    edges_m: Vec<f64>,
    state: ConstantCurvatureState,
    spheres: Vec<ProxySphere>,
    /// Per-flexure bending angles (rad) and rates (rad/s), for callers that expect flexures.
    bend: [Vec<f64>; 2],
    contact: ContactSolver<4>,
    channels: Channels,
}

impl ConstantCurvature {
    /// A tool in its rest shape, at rest on `base`, with slack tendons. Of a pre-curved tool it takes the whole bend, and spreads it evenly.
    ///
    /// # Errors
    /// A parameter is out of range, or a tendon bends only a part of the tool; the error names it.
    pub fn new(parameters: ManipulatorParameters, base: &BaseMotion) -> Result<Self, ManipulatorError> {
        parameters.validate()?;
        super::validation::validate_base(base)?;
        let arc = Arc::new(&parameters);
        let p = &parameters;
        let joints = p.joint_positions_m.len();
        refuse_partial_tendons(p)?;
        let rest_rad = p.joint_rest_rad.iter().sum();
        let compliance: f64 = p.joint_stiffness_nm_per_rad.iter().map(|k| 1.0 / k).sum();
        let [mx, my, mz] = p.mount_stiffness_n_per_m;
        let stiffness = Vector4::new(mx, my, mz, 1.0 / compliance);
        let lumps = lumps(p, &arc);
        let inertia = mass_matrix(&lumps, &arc, 0.0)[(3, 3)];
        let first = libm::sqrt(stiffness[3] / inertia);
        let total: f64 = lumps.iter().map(|lump| lump.mass_kg).sum();
        let mount = |k: f64| 2.0 * p.mount_damping_ratio * libm::sqrt(k * total);
        let damping =
            Vector4::new(mount(mx), mount(my), mount(mz), 2.0 * p.damping_ratio / first * stiffness[3]);
        let lengths = link_lengths_m(p);
        let sphere_layout = spheres(p, &lengths);
        let along = |s: &SphereLayout| match s.link {
            0 => s.along_m,
            link => p.joint_positions_m[link - 1] + s.along_m,
        };
        let blank = |s: &SphereLayout| ProxySphere {
            centre_m: Vector3::zeros(),
            velocity_m_per_s: Vector3::zeros(),
            radius_m: s.radius_m,
            kind: s.kind,
        };
        let mut tool = Self {
            arc,
            stiffness,
            damping,
            rest_rad,
            limit_rad: joints as f64 * p.joint_limit_rad,
            // The stops of the flexures act in series.
            stop_stiffness_nm_per_rad: p.joint_stop_stiffness_nm_per_rad / joints as f64,
            first_frequency_rad_per_s: first,
            sphere_z_m: sphere_layout.iter().map(along).collect(),
            spheres: sphere_layout.iter().map(blank).collect(),
            sphere_layout,
            edges_m: p.cell_edges_m(),
            lumps,
            state: ConstantCurvatureState {
                position: Vector4::new(0.0, 0.0, 0.0, rest_rad),
                velocity: Vector4::zeros(),
                base: *base,
                tendon: [TendonMemory::default(); MAX_TENDONS],
                stop_torque_nm: 0.0,
                result_count: 0,
                results: vec![ContactResult::none(); MAX_CONTACTS],
                report: StepReport::none(),
            },
            bend: [vec![0.0; joints], vec![0.0; joints]],
            contact: ContactSolver::new(vec![0, 4], MAX_CONTACTS),
            channels: Channels::of(&parameters),
            parameters,
        };
        tool.update_configuration();
        Ok(tool)
    }

    fn update_configuration(&mut self) {
        let state = &self.state;
        let (q, v) = (&state.position, &state.velocity);
        let rotation = state.base.t_world_base.rotation;
        for (sphere, &z_m) in self.spheres.iter_mut().zip(&self.sphere_z_m) {
            let place = self.arc.place(z_m, q[3]);
            let centre = rotation * Vector3::new(q[0] + place.point[0], q[1], q[2] + place.point[1]);
            let own = Vector3::new(v[0] + v[3] * place.first[0], v[1], v[2] + v[3] * place.first[1]);
            sphere.centre_m = state.base.t_world_base.translation.vector + centre;
            sphere.velocity_m_per_s = state.base.linear_velocity_m_per_s
                + state.base.angular_velocity_rad_per_s.cross(&centre)
                + rotation * own;
        }
        for joint in 0..self.bend[0].len() {
            let share = (self.edges_m[joint + 1] - self.edges_m[joint]) / self.arc.length_m;
            self.bend[0][joint] = share * q[3];
            self.bend[1][joint] = share * v[3];
        }
    }

    /// Number of flexures that the arc replaces.
    pub fn joint_count(&self) -> usize {
        self.bend[0].len()
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

    /// Each flexure's share of the bend, rad.
    pub fn joint_positions_rad(&self) -> &[f64] {
        &self.bend[0]
    }

    /// Bend of a flexure without load, rad.
    pub fn rest_rad(&self, joint: usize) -> f64 {
        self.parameters.rest_rad(joint)
    }

    /// Each flexure's share of the bend's rate, rad/s.
    pub fn joint_velocities_rad_per_s(&self) -> &[f64] {
        &self.bend[1]
    }

    /// Pose at flexure `link` - 1, z along the axis distal to its cell; link 0 is the shaft at the base origin. An index past the last
    /// link returns the last link.
    pub fn t_world_link(&self, link: usize) -> Isometry3<f64> {
        let joints = self.joint_count();
        match link.min(joints) {
            0 => self.t_world_point(0.0, 0.0),
            link => {
                let behind = (self.edges_m[link] - self.edges_m[0]) / self.arc.length_m;
                self.t_world_point(self.parameters.joint_positions_m[link - 1], behind)
            }
        }
    }

    /// Pose of the tip frame: origin at the burr centre, z along the axis there.
    pub fn t_world_tip(&self) -> Isometry3<f64> {
        self.t_world_point(self.parameters.burr_centre_m(), 1.0)
    }

    fn t_world_point(&self, z_m: f64, share: f64) -> Isometry3<f64> {
        let q = &self.state.position;
        let point = self.arc.place(z_m, q[3]).point;
        let translation = Translation3::new(q[0] + point[0], q[1], q[2] + point[1]);
        let rotation = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), share * q[3]);
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

    /// What the tool exerted on the flange in the last step.
    pub fn flange_wrench(&self) -> Wrench {
        self.state.report.flange_wrench
    }

    /// Makes the tool straight, and at rest: a pre-curved tool that a hole or a guide holds.
    pub fn straighten(&mut self) {
        self.state.position.fill(0.0);
        self.state.velocity.fill(0.0);
        self.update_configuration();
        for t in 0..self.channels.count {
            self.state.tendon[t].take_up_m = self.take_up_m(t);
        }
    }

    /// Length of tendon `t` taken up by the bent tool, from its rest shape, m.
    fn take_up_m(&self, t: usize) -> f64 {
        self.channels.offset_m[t][0] * self.deflection()[3]
    }

    /// Mount displacement, and the bend from that without load.
    fn deflection(&self) -> Vector4<f64> {
        let mut q = self.state.position;
        q[3] -= self.rest_rad;
        q
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

    /// Kinetic energy relative to the base plus elastic energy of bend and mount, J.
    pub fn energy_j(&self) -> f64 {
        let (bend, from_rest, v) = (self.state.position[3], self.deflection(), &self.state.velocity);
        let elastic = from_rest.component_mul(&self.stiffness).dot(&from_rest);
        0.5 * (elastic + v.dot(&(mass_matrix(&self.lumps, &self.arc, bend) * v)))
    }

    /// A copy of the complete dynamic state.
    pub fn snapshot(&self) -> ConstantCurvatureState {
        self.state.clone()
    }

    /// The complete dynamic state.
    pub(crate) fn state(&self) -> &ConstantCurvatureState {
        &self.state
    }

    /// Continues bit for bit from a snapshot of a tool with the same parameters.
    pub fn restore(&mut self, state: &ConstantCurvatureState) {
        self.state.clone_from(state);
        self.update_configuration();
    }
}

/// One arc cannot bend in part, nor twist.
fn refuse_partial_tendons(p: &ManipulatorParameters) -> Result<(), ManipulatorError> {
    helix::refuse(p, "0: the rung constant_curvature does not twist")?;
    if let Some(outer) = &p.outer_tube {
        let allowed = "none: the rung constant_curvature is one arc, which an outer tube does not leave";
        check("outer_tube.end_m", outer.end_m, allowed, |_| false)?;
    }
    let joints = p.joint_positions_m.len();
    for TendonRoute { reach, .. } in p.tendon_routes.iter().flatten() {
        let allowed = "all flexures: the rung constant_curvature is one arc";
        let number = reach.to.unwrap_or(joints) - reach.from;
        check("tendon_routes.reach", number as f64, allowed, |_| number == joints)?;
    }
    Ok(())
}

/// Lumped masses: shaft, Gauss points of the arc, the tube distal to it, the burr.
fn lumps(p: &ManipulatorParameters, arc: &Arc) -> Vec<Lump> {
    let [outer, inner] = p.tube_radii_m;
    let gyration = 0.25 * (outer * outer + inner * inner);
    let density = p.linear_density_kg_per_m;
    let mut lumps = vec![Lump { mass_kg: p.shaft_mass_kg, z_m: p.shaft_centre_m, inertia_kg_m2: 0.0 }];
    // The tube's mass starts at the first flexure; the part of the arc proximal to it moves with the shaft.
    let first = p.joint_positions_m[0];
    let moving = arc.length_m - (first - arc.start_m).max(0.0);
    for (node, weight) in GAUSS {
        let mass_kg = density * moving * weight;
        let z_m = arc.start_m + arc.length_m - moving * (1.0 - node);
        lumps.push(Lump { mass_kg, z_m, inertia_kg_m2: mass_kg * gyration });
    }
    let burr = p.burr_centre_m();
    let end = arc.start_m + arc.length_m;
    let rest = (burr - p.cutter.span_m() - end).max(0.0);
    let mass_kg = density * rest;
    let inertia_kg_m2 = mass_kg * (rest * rest / 12.0 + gyration);
    lumps.push(Lump { mass_kg, z_m: end + 0.5 * rest, inertia_kg_m2 });
    let body = BurrBody::of(p);
    lumps.push(Lump { mass_kg: p.burr_mass_kg, z_m: burr - body.behind_m, inertia_kg_m2: body.across_kg_m2 });
    lumps
}

/// Mass matrix of mount and bend.
fn mass_matrix(lumps: &[Lump], arc: &Arc, bend_rad: f64) -> Matrix4<f64> {
    let mut m = Matrix4::zeros();
    for lump in lumps {
        let place = arc.place(lump.z_m, bend_rad);
        let [x, z] = place.first;
        for k in 0..3 {
            m[(k, k)] += lump.mass_kg;
        }
        m[(0, 3)] += lump.mass_kg * x;
        m[(2, 3)] += lump.mass_kg * z;
        m[(3, 3)] += lump.mass_kg * (x * x + z * z) + lump.inertia_kg_m2 * place.share * place.share;
    }
    m[(3, 0)] = m[(0, 3)];
    m[(3, 2)] = m[(2, 3)];
    m
}
