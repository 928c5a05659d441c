//! The bodies in Rapier: SI units, stiff contacts, no sleeping.

use nalgebra::{Isometry3, Matrix3, UnitQuaternion, Vector3};
use rapier3d_f64::dynamics::{
    CCDSolver, ImpulseJointSet, IntegrationParameters, IslandManager, MultibodyJointSet, RigidBody,
    RigidBodyBuilder, RigidBodyHandle, RigidBodySet, SoftBodySet, SpringCoefficients,
};
use rapier3d_f64::geometry::{BroadPhaseBvh, Collider, ColliderBuilder, ColliderSet, NarrowPhase};
use rapier3d_f64::math::Vector;
use rapier3d_f64::pipeline::PhysicsPipeline;
use serde::{Deserialize, Serialize};

use super::body::{BodyMotion, BodyParameters, BodyShape};
use super::descent::{Inertia, Motion};
use crate::manipulator::Wrench;

/// Typical size of the bodies, m; Rapier's tolerances scale with it.
const LENGTH_UNIT_M: f64 = 0.01;
/// Distance at which contact detection starts, m: a body at 2 m/s travels this far in 1 ms.
const PREDICTION_M: f64 = 2e-3;
/// Velocity clamp in Rapier, m/s. Far above any velocity in a scene, so clamping never removes momentum.
const FASTEST_M_PER_S: f64 = 1e4;

/// The parts of Rapier's world that a step changes. A clone continues bit for bit.
#[derive(Clone, Serialize, Deserialize)]
pub(super) struct World {
    bodies: RigidBodySet,
    colliders: ColliderSet,
    islands: IslandManager,
    broad_phase: BroadPhaseBvh,
    narrow_phase: NarrowPhase,
}

/// What a step needs besides the world: settings, empty sets and workspace, none of which is state.
pub(super) struct Stepper {
    gravity: Vector,
    parameters: IntegrationParameters,
    pipeline: PhysicsPipeline,
    impulse_joints: ImpulseJointSet,
    multibody_joints: MultibodyJointSet,
    soft_bodies: SoftBodySet,
    ccd_solver: CCDSolver,
}

impl Stepper {
    pub fn new(dt_s: f64, gravity_m_per_s2: &Vector3<f64>) -> Stepper {
        // With the default springs (30 Hz), 10 N press a light body millimetres into its support; 1e5 Hz
        // holds it.
        let stiff = SpringCoefficients::new(1e5, 1.0);
        let parameters = IntegrationParameters {
            dt: dt_s,
            length_unit: LENGTH_UNIT_M,
            contact_softness: stiff,
            static_contact_softness: stiff,
            normalized_prediction_distance: PREDICTION_M / LENGTH_UNIT_M,
            normalized_max_linear_velocity: FASTEST_M_PER_S / LENGTH_UNIT_M,
            ..IntegrationParameters::default()
        };
        Stepper {
            gravity: vector(gravity_m_per_s2),
            parameters,
            pipeline: PhysicsPipeline::new(),
            impulse_joints: ImpulseJointSet::new(),
            multibody_joints: MultibodyJointSet::new(),
            soft_bodies: SoftBodySet::new(),
            ccd_solver: CCDSolver::new(),
        }
    }

    /// Advances the world by one time step.
    pub fn step(&mut self, world: &mut World) {
        self.pipeline.step(
            self.gravity,
            &self.parameters,
            &mut world.islands,
            &mut world.broad_phase,
            &mut world.narrow_phase,
            &mut world.bodies,
            &mut world.colliders,
            &mut self.impulse_joints,
            &mut self.multibody_joints,
            &mut self.soft_bodies,
            &mut self.ccd_solver,
            &(),
            &(),
        );
    }
}

impl World {
    /// Creates the bodies at their start poses, in the given order, with their handles.
    pub fn new(list: &[BodyParameters]) -> (World, Vec<RigidBodyHandle>) {
        let mut world = World {
            bodies: RigidBodySet::new(),
            colliders: ColliderSet::new(),
            islands: IslandManager::new(),
            broad_phase: BroadPhaseBvh::default(),
            narrow_phase: NarrowPhase::new(),
        };
        let handles = list
            .iter()
            .map(|body| {
                let builder = match body.motion {
                    BodyMotion::Fixed => RigidBodyBuilder::fixed(),
                    BodyMotion::Free => RigidBodyBuilder::dynamic(),
                    BodyMotion::Driven => RigidBodyBuilder::kinematic_position_based(),
                };
                let handle = world.bodies.insert(builder.pose(body.t_world_body.into()).can_sleep(false));
                world.colliders.insert_with_parent(collider(body), handle, &mut world.bodies);
                if let Some(inserted) = world.bodies.get_mut(handle) {
                    inserted.recompute_mass_properties_from_colliders(&world.colliders);
                }
                handle
            })
            .collect();
        (world, handles)
    }

    /// Returns true if the world holds exactly these bodies and no NaN.
    pub fn holds(&self, handles: impl ExactSizeIterator<Item = RigidBodyHandle>) -> bool {
        let finite = |v: Vector| v.is_finite();
        let body_is_sound = |body: &RigidBody| finite(body.translation()) && finite(body.linvel());
        self.bodies.len() == handles.len()
            && handles.into_iter().all(|handle| self.bodies.get(handle).is_some_and(body_is_sound))
    }

    pub fn body(&self, handle: RigidBodyHandle) -> &RigidBody {
        &self.bodies[handle]
    }

    pub fn pose(&self, handle: RigidBodyHandle) -> Isometry3<f64> {
        (*self.body(handle).position()).into()
    }

    /// Returns the velocity of a body's centre of mass, and its angular velocity.
    pub fn motion(&self, handle: RigidBodyHandle) -> Motion {
        let body = self.body(handle);
        Motion { linear: from_vector(body.linvel()), angular: from_vector(body.angvel()) }
    }

    pub fn centre_m(&self, handle: RigidBodyHandle) -> Vector3<f64> {
        from_vector(self.body(handle).center_of_mass())
    }

    /// Returns the mean motion of a body between this world and `later`, which is `dt_s` after it.
    pub fn motion_to(&self, later: &World, handle: RigidBodyHandle, dt_s: f64) -> Motion {
        let turn = later.pose(handle).rotation * self.pose(handle).rotation.inverse();
        Motion {
            linear: (later.centre_m(handle) - self.centre_m(handle)) / dt_s,
            angular: turn.scaled_axis() / dt_s,
        }
    }

    pub fn inertia(&self, handle: RigidBodyHandle) -> Inertia {
        let body = self.body(handle);
        let local = &body.mass_properties().local_mprops;
        let axes = self.pose(handle).rotation * UnitQuaternion::from(local.principal_inertia_local_frame);
        let axes = axes.to_rotation_matrix().into_inner();
        let principal = Matrix3::from_diagonal(&from_vector(local.principal_inertia()));
        Inertia { mass_kg: body.mass(), moment_kg_m2: axes * principal * axes.transpose() }
    }

    /// Applies an impulse (N s) to the body at a point, world axes.
    pub fn apply_impulse(&mut self, handle: RigidBodyHandle, impulse: &Vector3<f64>, point_m: &Vector3<f64>) {
        self.bodies[handle].apply_impulse_at_point(vector(impulse), vector(point_m), true);
    }

    /// Sets the wrench that acts on a free body in every step, about its centre of mass, world axes.
    pub fn set_wrench(&mut self, handle: RigidBodyHandle, wrench: &Wrench) {
        let body = &mut self.bodies[handle];
        body.reset_forces(true);
        body.reset_torques(true);
        body.add_force(vector(&wrench.force_n), true);
        body.add_torque(vector(&wrench.torque_nm), true);
    }

    /// Sets the pose of a driven body at the end of the next step.
    pub fn set_next_pose(&mut self, handle: RigidBodyHandle, pose: &Isometry3<f64>) {
        self.bodies[handle].set_next_kinematic_position((*pose).into());
    }
}

fn collider(body: &BodyParameters) -> Collider {
    let shape = match body.shape {
        BodyShape::Box { half_extents_m: half } => ColliderBuilder::cuboid(half.x, half.y, half.z),
        BodyShape::Ball { radius_m } => ColliderBuilder::ball(radius_m),
        BodyShape::Capsule { half_height_m, radius_m } => ColliderBuilder::capsule_z(half_height_m, radius_m),
    };
    shape.density(body.density_kg_per_m3).friction(body.friction).restitution(0.0).build()
}

/// Converts from nalgebra to glam.
pub(super) fn vector(v: &Vector3<f64>) -> Vector {
    Vector::new(v.x, v.y, v.z)
}

/// Converts from glam to nalgebra.
pub(super) fn from_vector(v: Vector) -> Vector3<f64> {
    Vector3::new(v.x, v.y, v.z)
}
