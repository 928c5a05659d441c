//! The tool in Rapier: links as rigid bodies, flexures as Rapier joints, walls as half-spaces.

use nalgebra::{Isometry3, Vector3};
use rapier3d_f64::prelude::{
    ColliderBuilder, ColliderHandle, GenericJointBuilder, Group, ImpulseJointHandle, InteractionGroups,
    InteractionTestMode, JointAxesMask, JointAxis, MassProperties, MotorModel, MultibodyJointHandle,
    PhysicsWorld, Pose, RevoluteJointBuilder, RigidBodyBuilder, RigidBodyHandle, Rotation,
    SpringCoefficients, Vector,
};
use simulation::manipulator::{ManipulatorParameters, StepInput, TendonCommand};

use super::wall::Wall;

/// Joint model of the flexures.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RapierJoints {
    /// Hinges of a multibody with `set_spring`, which is implicit.
    Multibody,
    /// A motor on each of the six axes of an impulse joint, as in the published simulator.
    Springs,
}

enum Joint {
    Hinge(MultibodyJointHandle),
    Motors(ImpulseJointHandle),
}

/// The tool in Rapier. Its burr is a ball; for a longer cutter, the ball at its front.
pub struct RapierChain {
    world: PhysicsWorld,
    parameters: ManipulatorParameters,
    root: RigidBodyHandle,
    links: Vec<RigidBodyHandle>,
    joints: Vec<Joint>,
    stiffness: Vec<f64>,
    damping: Vec<f64>,
    tip_offset_m: f64,
    walls: Vec<ColliderHandle>,
}

const TOOL: Group = Group::GROUP_1;
const WALLS: Group = Group::GROUP_2;

impl RapierChain {
    /// Creates a straight tool on `t_world_base` in front of walls. `frequency_hz`, its first bending mode,
    /// sets the
    /// dampers.
    pub fn new(
        joints: RapierJoints,
        parameters: &ManipulatorParameters,
        frequency_hz: f64,
        t_world_base: &Isometry3<f64>,
        walls: &[Wall],
    ) -> Self {
        let mut world =
            PhysicsWorld { gravity: vector(&parameters.gravity_m_per_s2), ..PhysicsWorld::default() };
        let settings = &mut world.integration_parameters;
        settings.length_unit = 0.01;
        settings.num_solver_iterations = if joints == RapierJoints::Multibody { 1 } else { 4 };
        // Rapier's stiffest setting: with the default, 10 N penetrate a wall by millimetres.
        settings.contact_softness = SpringCoefficients::new(1e5, 1.0);
        settings.static_contact_softness = SpringCoefficients::new(1e5, 1.0);
        let root = world.bodies.insert(RigidBodyBuilder::kinematic_position_based().pose(pose(t_world_base)));
        let friction = parameters.contact.friction_coefficient;
        let mut handles = Vec::new();
        for wall in walls {
            let up = vector(&wall.normal).normalize();
            let collider = ColliderBuilder::new(rapier3d_f64::prelude::SharedShape::halfspace(up))
                .translation(vector(&wall.point_m))
                .friction(friction)
                .collision_groups(groups(WALLS, TOOL));
            handles.push(world.colliders.insert(collider));
        }
        let mut chain = Self {
            root,
            links: Vec::new(),
            joints: Vec::new(),
            stiffness: parameters.joint_stiffness_nm_per_rad.clone(),
            damping: Vec::new(),
            tip_offset_m: parameters.tip_offset_m,
            parameters: parameters.clone(),
            walls: handles,
            world,
        };
        let beta = 2.0 * parameters.damping_ratio / (2.0 * core::f64::consts::PI * frequency_hz);
        chain.damping = chain.stiffness.iter().map(|k| beta * k).collect();
        chain.insert_links(joints, t_world_base);
        chain
    }

    fn insert_links(&mut self, joints: RapierJoints, t_world_base: &Isometry3<f64>) {
        let p = self.parameters.clone();
        let [outer, inner] = p.tube_radii_m;
        let gyration = 0.25 * (outer * outer + inner * inner);
        let n = p.joint_positions_m.len();
        let mut parent = self.root;
        for i in 0..n {
            let z = p.joint_positions_m[i];
            let length = p.joint_positions_m.get(i + 1).map_or(p.tip_offset_m, |next| next - z);
            let last = i + 1 == n;
            let tube = p.linear_density_kg_per_m * length;
            let burr = if last { p.burr_mass_kg } else { 0.0 };
            let mass = tube + burr;
            let centre = (tube * 0.5 * length + burr * p.tip_offset_m) / mass;
            let radius_m = p.cutter.front_radius_m();
            let own = 0.4 * burr * radius_m * radius_m;
            let across = tube * (length * length / 12.0 + gyration + (0.5 * length - centre).powi(2))
                + own
                + burr * (p.tip_offset_m - centre).powi(2);
            let along = 2.0 * tube * gyration + own;
            let inertia = Vector::new(across, across, along);
            let properties = MassProperties::new(Vector::new(0.0, 0.0, centre), mass, inertia);
            let place = t_world_base * Isometry3::translation(0.0, 0.0, z);
            let body = RigidBodyBuilder::dynamic()
                .pose(pose(&place))
                .additional_mass_properties(properties)
                .can_sleep(false);
            let link = self.world.bodies.insert(body);
            let previous = if i == 0 { 0.0 } else { p.joint_positions_m[i - 1] };
            let anchor = Vector::new(0.0, 0.0, z - previous);
            self.insert_joint(joints, parent, link, anchor, i);
            let segment = if last && n > 1 { (z - previous).min(length) } else { length };
            self.insert_sphere(link, 0.5 * segment, p.segment_sphere_radius_m);
            if last {
                self.insert_sphere(link, p.tip_offset_m, p.cutter.front_radius_m());
            }
            self.links.push(link);
            parent = link;
        }
        if joints == RapierJoints::Multibody {
            self.set_hinge_dampings();
        }
    }

    fn insert_joint(
        &mut self,
        joints: RapierJoints,
        parent: RigidBodyHandle,
        link: RigidBodyHandle,
        anchor: Vector,
        index: usize,
    ) {
        let world = &mut self.world;
        let handle = match joints {
            RapierJoints::Multibody => {
                let hinge =
                    RevoluteJointBuilder::new(Vector::Y).local_anchor1(anchor).local_anchor2(Vector::ZERO);
                world.multibody_joints.insert(parent, link, hinge.build(), true).map(Joint::Hinge)
            }
            RapierJoints::Springs => {
                let bending = self.stiffness[index];
                let ratios = self.parameters.stiffness_ratios(index);
                let beta = self.damping[index] / bending;
                let axes = [
                    (JointAxis::LinX, bending * ratios.shear_toward_per_m2),
                    (JointAxis::LinY, bending * ratios.shear_across_per_m2),
                    (JointAxis::LinZ, bending * ratios.axial_per_m2),
                    (JointAxis::AngX, bending * ratios.lateral),
                    (JointAxis::AngY, bending),
                    (JointAxis::AngZ, bending * ratios.torsion),
                ];
                let mut joint = GenericJointBuilder::new(JointAxesMask::empty()).local_anchor1(anchor);
                for (axis, k) in axes {
                    joint = joint.motor_model(axis, MotorModel::ForceBased);
                    joint = joint.motor_position(axis, 0.0, k, beta * k);
                }
                Some(Joint::Motors(world.impulse_joints.insert(parent, link, joint.build(), true)))
            }
        };
        self.joints.extend(handle);
    }

    fn insert_sphere(&mut self, link: RigidBodyHandle, along_m: f64, radius_m: f64) {
        let ball = ColliderBuilder::ball(radius_m)
            .translation(Vector::new(0.0, 0.0, along_m))
            .density(0.0)
            .friction(self.parameters.contact.friction_coefficient)
            .collision_groups(groups(TOOL, WALLS));
        self.world.colliders.insert_with_parent(ball, link, &mut self.world.bodies);
    }

    fn set_hinge_dampings(&mut self) {
        self.set_targets(&[0.0; 2]);
        // Until the first step the root has six degrees of freedom; only afterwards do the damping entries
        // belong to the hinges.
        self.world.integration_parameters.dt = 1e-7;
        self.world.step();
        if let Some(Joint::Hinge(handle)) = self.joints.first()
            && let Some((multibody, _)) = self.world.multibody_joints.get_mut(*handle)
        {
            let own = multibody.damping_mut();
            let skipped = own.len().saturating_sub(self.damping.len());
            own.fill(0.0);
            for (slot, damping) in own.iter_mut().skip(skipped).zip(&self.damping) {
                *slot = *damping;
            }
        }
    }

    /// Angle of each flexure, rad.
    pub fn joint_positions_rad(&self) -> Vec<f64> {
        let mut before = self.world.bodies[self.root].position().rotation;
        let mut angles = Vec::with_capacity(self.links.len());
        for link in &self.links {
            let rotation = self.world.bodies[*link].position().rotation;
            let between = before.inverse() * rotation;
            angles.push(2.0 * libm::atan2(between.y, between.w));
            before = rotation;
        }
        angles
    }

    /// Applies the tendons as rest angles of the springs, which is exact at equilibrium: `T(d cos(q/2) + g/2
    /// sin(q/2)) / k`, with the tension reduced by the wrap of a tendon that slides inward.
    fn set_targets(&mut self, tension_n: &[f64; 2]) {
        let (tendon, angles) = (self.parameters.tendon, self.joint_positions_rad());
        let mut wrap = 0.0;
        for (i, q) in angles.into_iter().enumerate() {
            let mut torque = 0.0;
            wrap += 0.5 * q.abs();
            for (side, tension) in [1.0, -1.0].into_iter().zip(tension_n) {
                let local = tension.max(0.0) * libm::exp(-tendon.friction_coefficient * wrap);
                let (sin, cos) = libm::sincos(0.5 * q);
                torque += local * (side * tendon.offset_m * cos + 0.5 * tendon.gap_m * sin);
            }
            wrap += 0.5 * q.abs();
            let target = torque / self.stiffness[i];
            match self.joints.get(i) {
                Some(Joint::Hinge(handle)) => {
                    if let Some((multibody, id)) = self.world.multibody_joints.get_mut(*handle)
                        && let Some(link) = multibody.link_mut(id)
                    {
                        // Axis 3 is the first angular axis, about which a revolute joint rotates.
                        link.joint.set_spring(3, self.stiffness[i], target);
                    }
                }
                Some(Joint::Motors(handle)) => {
                    if let Some(joint) = self.world.impulse_joints.get_mut(*handle, true) {
                        let (k, c) = (self.stiffness[i], self.damping[i]);
                        joint.data.set_motor_position(JointAxis::AngY, target, k, c);
                    }
                }
                None => (),
            }
        }
    }

    /// Advances by `dt_s` with Rapier's own contacts. Supports tendon tensions only (a displacement counts
    /// as 0).
    pub fn step(&mut self, dt_s: f64, input: &StepInput) {
        let tension = match input.tendon {
            TendonCommand::Force(tension_n) => tension_n,
            TendonCommand::EachForce([a, b, ..]) => [a, b],
            TendonCommand::Displacement(_) | TendonCommand::EachDisplacement(_) => [0.0; 2],
        };
        self.set_targets(&tension);
        self.world.integration_parameters.dt = dt_s;
        self.world.bodies[self.root].set_next_kinematic_position(pose(&input.base.t_world_base));
        if let Some(&last) = self.links.last() {
            let tip = vector(&self.tip_m());
            let body = &mut self.world.bodies[last];
            body.reset_forces(true);
            body.reset_torques(true);
            body.add_force_at_point(vector(&input.tip_wrench.force_n), tip, true);
            body.add_torque(vector(&input.tip_wrench.torque_nm), true);
        }
        self.world.step();
    }

    /// Removes all walls.
    pub fn remove_walls(&mut self) {
        for wall in self.walls.drain(..) {
            let world = &mut self.world;
            world.colliders.remove(wall, &mut world.islands, &mut world.bodies, &mut world.soft_bodies, true);
        }
    }

    /// Burr centre, world, m.
    pub fn tip_m(&self) -> Vector3<f64> {
        let Some(&last) = self.links.last() else { return Vector3::zeros() };
        let tip =
            self.world.bodies[last].position().transform_point(Vector::new(0.0, 0.0, self.tip_offset_m));
        Vector3::new(tip.x, tip.y, tip.z)
    }

    /// Kinetic energy plus bending energy, J.
    pub fn energy_j(&self) -> f64 {
        let kinetic = |link: &RigidBodyHandle| self.world.bodies[*link].kinetic_energy();
        let angles = self.joint_positions_rad();
        let elastic = angles.iter().zip(&self.stiffness).map(|(q, k)| 0.5 * k * q * q);
        self.links.iter().map(kinetic).sum::<f64>() + elastic.sum::<f64>()
    }
}

fn groups(own: Group, other: Group) -> InteractionGroups {
    InteractionGroups::new(own, other, InteractionTestMode::And)
}

fn vector(v: &Vector3<f64>) -> Vector {
    Vector::new(v.x, v.y, v.z)
}

fn pose(t: &Isometry3<f64>) -> Pose {
    let [x, y, z, w] = t.rotation.coords.into();
    Pose::from_parts(vector(&t.translation.vector), Rotation::from_xyzw(x, y, z, w))
}
