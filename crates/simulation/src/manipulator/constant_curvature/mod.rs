//! The cheapest rung: the flexible length is one arc of constant curvature, in closed form.
//!
//! It has four degrees of freedom: the mount along base x, y, z, and the bend. It is exact under a pure end
//! moment and, for a uniform tool, under its frictionless tendons. Under a tip force or in a tunnel it is the
//! best approximation by a single curvature. The bending stiffness is that of the flexures in series, `1 /
//! sum(1/k)`. Frames, tendons, contact laws and mount are those of the planar rung (see
//! [`crate::manipulator`]). Every step uses linearly implicit Euler.

mod arc;
mod step;

use nalgebra::{Isometry3, Matrix4, Vector3, Vector4};

use super::common::{Common, StateSizes};
use super::contact::ContactSolver;
use super::error::{ManipulatorError, check};
use super::geometry::{BurrBody, SphereLayout};
use super::helix;
use super::model::{ManipulatorModel, Rung, own_parts};
use super::parameters::{ManipulatorParameters, TendonRoute};
use super::row::StopLaw;
use super::spatial::algebra::{dot, shift_along, turn_about};
use super::state::{BaseMotion, StepInput, StepReport};
use super::tendon::{Channels, friction_w};
use super::tip_jacobian::{FewFreedoms, LinkMotion, Support, stiffness, supports};
use super::{CONTACTS_PER_SPHERE, MAX_LINKS, MAX_SHAFT_SPHERES, MAX_TENDONS};
use arc::{Arc, AxisPoint};

/// Maximum contacts per step; excess contacts are rejected and counted.
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
    /// Inertia about its own centre, axis y.
    inertia_kg_m2: f64,
}

/// A continuum manipulator bent to one curvature.
#[derive(Debug, Clone)]
pub struct ConstantCurvature {
    common: Common,
    arc: Arc,
    /// Stiffness of the mount (N/m) and the bend (N m/rad).
    stiffness: Vector4<f64>,
    damping: Vector4<f64>,
    /// Unloaded bend, rad.
    rest_rad: f64,
    stop: StopLaw,
    lumps: Vec<Lump>,
    /// Position of each sphere on the straight tool, m.
    sphere_z_m: Vec<f64>,
    /// Boundaries of the flexures' cells, m.
    edges_m: Vec<f64>,
    contact: ContactSolver<4>,
    channels: Channels,
    /// Part of the slope of each tendon whose share of the tension friction took in the last step.
    lost: [[f64; 1]; MAX_TENDONS],
}

impl ConstantCurvature {
    /// Creates a tool in its rest shape, at rest on `base`, with slack tendons. The total bend of a
    /// pre-curved tool is spread evenly.
    ///
    /// # Errors
    /// A parameter is out of range, or a tendon bends only part of the tool; the error names it.
    pub fn new(parameters: ManipulatorParameters, base: &BaseMotion) -> Result<Self, ManipulatorError> {
        Common::check(&parameters, base)?;
        let p = &parameters;
        refuse_partial_tendons(p)?;
        let arc = Arc::new(p);
        let joints = p.joint_positions_m.len() as f64;
        let rest_rad = p.joint_rest_rad.iter().sum();
        let compliance: f64 = p.joint_stiffness_nm_per_rad.iter().map(|k| 1.0 / k).sum();
        let [mx, my, mz] = p.mount_stiffness_n_per_m;
        let stiffness = Vector4::new(mx, my, mz, 1.0 / compliance);
        let lumps = lumps(p, &arc);
        let inertia = mass_matrix(&lumps, &arc, 0.0)[(3, 3)];
        let first = libm::sqrt(stiffness[3] / inertia);
        let total: f64 = lumps.iter().map(|lump| lump.mass_kg).sum();
        let (edges_m, channels) = (p.cell_edges_m(), Channels::of(p));
        // The stops of the flexures act in series.
        let one = p.stop_law();
        let stop = StopLaw {
            limit_rad: joints * one.limit_rad,
            stiffness_nm_per_rad: one.stiffness_nm_per_rad / joints,
            soft_rad: joints * one.soft_rad,
        };
        let room = StateSizes { freedoms: 4, stops: 1, contacts: MAX_CONTACTS };
        let common = Common::new(Rung::ConstantCurvature, parameters, base, total, first, room);
        let along = |s: &SphereLayout| match s.link {
            0 => s.along_m,
            link => common.parameters.joint_positions_m[link - 1] + s.along_m,
        };
        let [cx, cy, cz] = common.mount_damping;
        let mut tool = Self {
            damping: Vector4::new(cx, cy, cz, common.damping_s() * stiffness[3]),
            sphere_z_m: common.sphere_layout.iter().map(along).collect(),
            common,
            arc,
            stiffness,
            rest_rad,
            stop,
            edges_m,
            lumps,
            contact: ContactSolver::new(vec![0, 4], MAX_CONTACTS),
            channels,
            lost: [[0.0]; MAX_TENDONS],
        };
        tool.common.state.position[3] = rest_rad;
        tool.follow_state();
        Ok(tool)
    }

    /// Returns the mount displacement (m) and bend (rad).
    fn position(&self) -> Vector4<f64> {
        Vector4::from_column_slice(&self.common.state.position)
    }

    /// Returns the velocities of [`Self::position`].
    fn velocity(&self) -> Vector4<f64> {
        Vector4::from_column_slice(&self.common.state.velocity)
    }

    /// Returns the length of tendon `t` taken up by the bent tool, from its rest shape, m.
    fn take_up_m(&self, t: usize) -> f64 {
        self.channels.offset_m[t][0] * self.deflection()[3]
    }

    /// Returns the mount displacement, and the bend relative to the unloaded bend.
    fn deflection(&self) -> Vector4<f64> {
        let mut q = self.position();
        q[3] -= self.rest_rad;
        q
    }
}

impl ManipulatorModel for ConstantCurvature {
    own_parts!();

    fn follow_state(&mut self) {
        let (q, v) = (self.position(), self.velocity());
        let Common { state, spheres, bend, .. } = &mut self.common;
        let rotation = state.base.t_world_base.rotation;
        for (sphere, &z_m) in spheres.iter_mut().zip(&self.sphere_z_m) {
            let place = self.arc.place(z_m, q[3]);
            let centre = rotation * Vector3::new(q[0] + place.point[0], q[1], q[2] + place.point[1]);
            let own = Vector3::new(v[0] + v[3] * place.first[0], v[1], v[2] + v[3] * place.first[1]);
            sphere.centre_m = state.base.t_world_base.translation.vector + centre;
            sphere.velocity_m_per_s = state.base.linear_velocity_m_per_s
                + state.base.angular_velocity_rad_per_s.cross(&centre)
                + rotation * own;
        }
        for (joint, edges) in self.edges_m.windows(2).enumerate() {
            let share = (edges[1] - edges[0]) / self.arc.length_m;
            bend[0][joint] = share * q[3];
            bend[1][joint] = share * v[3];
        }
    }

    fn update_take_up(&mut self) {
        let bent_rad = self.deflection()[3];
        self.common.set_take_up(&self.channels, |t| self.channels.offset_m[t][0] * bent_rad);
    }

    fn rest_rad(&self, joint: usize) -> f64 {
        self.common.parameters.rest_rad(joint)
    }

    /// Returns the pose of a point on a link; the links' axes are those distal to the flexures' cells.
    fn t_world_point(&self, link: usize, along_m: f64) -> Isometry3<f64> {
        let (z_m, share) = match link {
            0 => (along_m, 0.0),
            link => (
                self.common.parameters.joint_positions_m[link - 1] + along_m,
                (self.edges_m[link] - self.edges_m[0]) / self.arc.length_m,
            ),
        };
        let q = self.position();
        let [x, z] = self.arc.place(z_m, q[3]).point;
        self.common.t_world_in_plane([q[0] + x, q[2] + z], share * q[3])
    }

    fn energy_j(&self) -> f64 {
        let (bend, from_rest, v) = (self.position()[3], self.deflection(), self.velocity());
        let elastic = from_rest.component_mul(&self.stiffness).dot(&from_rest);
        0.5 * (elastic + v.dot(&(mass_matrix(&self.lumps, &self.arc, bend) * v)))
    }

    fn damping_w(&self) -> f64 {
        let v = self.velocity();
        self.damping.component_mul(&v).dot(&v)
    }

    fn tendon_friction_w(&self) -> f64 {
        friction_w(&self.tendon_tensions_n(), &self.lost, &[self.velocity()[3]])
    }

    fn tip_motion(&self) -> LinkMotion {
        let (q, parameters) = (self.position(), &self.common.parameters);
        let on_point = |z_m: f64| {
            let AxisPoint { point: [x, z], first: [along_x, along_z], share, .. } = self.arc.place(z_m, q[3]);
            let point = Vector3::new(q[0] + x, q[1], q[2] + z);
            let bend = turn_about(&point, &(Vector3::y() * share));
            [
                shift_along(&Vector3::x()),
                shift_along(&Vector3::y()),
                shift_along(&Vector3::z()),
                [0.0, bend[1], 0.0, bend[3] + along_x, 0.0, bend[5] + along_z],
            ]
        };
        let mut few = FewFreedoms::<4>::new();
        let (added, pull) = self.tendons_on_bend();
        let stop = self.stop.stiffness_at(self.common.state.stop_torque_nm[0]);
        for k in 0..3 {
            few.operator[k][k] = self.stiffness[k];
        }
        few.operator[3][3] = stiffness(self.stiffness[3], added, stop);
        few.axis = on_point(parameters.burr_centre_m());
        few.add_pull(&[0.0, 0.0, 0.0, 1.0], &pull);
        for Support { force, sphere, .. } in supports(&self.common) {
            let on = on_point(self.sphere_z_m[sphere]).map(|axis| dot(&axis, &force));
            few.add_support(&on, &force, parameters.contact.stiffness_n_per_m);
        }
        few.tip_motion()
    }

    fn mass_moment_kg_m(&self) -> Vector3<f64> {
        let q = self.position();
        self.lumps.iter().fold(Vector3::zeros(), |sum, lump| {
            let [x, z] = self.arc.place(lump.z_m, q[3]).point;
            sum + Vector3::new(q[0] + x, q[1], q[2] + z) * lump.mass_kg
        })
    }
}

/// Rejects tendons that bend only part of the tool or wind around it, and outer tubes, which a single arc
/// cannot represent.
fn refuse_partial_tendons(p: &ManipulatorParameters) -> Result<(), ManipulatorError> {
    helix::refuse(p, "0: the constant_curvature model cannot twist")?;
    if let Some(outer) = &p.outer_tube {
        let allowed = "no outer tube: the constant_curvature model is a single arc";
        check("outer_tube.end_m", outer.end_m, allowed, |_| false)?;
    }
    let joints = p.joint_positions_m.len();
    for TendonRoute { reach, .. } in p.tendon_routes.iter().flatten() {
        let allowed = "all flexures: the constant_curvature model is a single arc";
        let number = reach.to.unwrap_or(joints) - reach.from;
        check("tendon_routes.reach", number as f64, allowed, |_| number == joints)?;
    }
    Ok(())
}

/// Returns the lumped masses: shaft, Gauss points of the arc, the tube distal to it, and the burr.
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

/// Returns the mass matrix of mount and bend.
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
