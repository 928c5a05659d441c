//! The bodies, their contact planes for the tool, and their state.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use rapier3d_f64::dynamics::RigidBodyHandle;
use serde::{Deserialize, Serialize};

use super::body::{BodyDrive, BodyMotion, BodyParameters, FASTEST_DRIVEN};
use super::coupling::{CouplingReport, MovingPlane};
use super::descent::{Descent, Inertia, Motion, Pair};
use super::error::{DriveError, RigidError};
use super::query::QueryShape;
use super::world::{Stepper, World};
use crate::contact_plane::ContactPlane;
use crate::manipulator::{ManipulatorModel, ProxySphere, Wrench};

pub(super) struct Body {
    pub handle: RigidBodyHandle,
    pub kind: BodyMotion,
    shape: QueryShape,
    /// Pose, derived from the world.
    pub t_world_body: Isometry3<f64>,
    /// Centre of mass, world, m. Derived from the world.
    pub centre_m: Vector3<f64>,
    /// Velocities, derived from the world; of a driven body those of its next step, once it is planned.
    pub motion: Motion,
    /// Mean motion over the last tick, from which the next tick's iteration starts. Part of the state.
    pub mean: Motion,
    /// Where a driven body is commanded to be. Part of the state.
    goal: Isometry3<f64>,
    /// Wrench of the tool in the last step, about the centre of mass.
    wrench: Wrench,
}

/// Everything that a tick changes in the rigid scene.
#[derive(Clone, Deserialize)]
pub struct RigidSnapshot {
    world: World,
    mean: Vec<Motion>,
    memory: Vec<Pair>,
    touched: Vec<Inertia>,
    report: CouplingReport,
    goals: Vec<Isometry3<f64>>,
}

impl core::fmt::Debug for RigidSnapshot {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("RigidSnapshot").field("report", &self.report).finish_non_exhaustive()
    }
}

/// A part of each body's state, in order.
struct Each<'a, T>(&'a [Body], fn(&Body) -> &T);

impl<T: Serialize> Serialize for Each<'_, T> {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_seq(self.0.iter().map(self.1))
    }
}

/// Rigid bodies next to the manipulator; [the module](super) describes the method.
pub struct RigidScene {
    pub(super) dt_s: f64,
    pub(super) bodies: Vec<Body>,
    pub(super) stepper: Stepper,
    pub(super) world: World,
    /// Workspace: the world after a trial step.
    pub(super) trial: World,
    /// Body of each plane that the last [`Self::find_contacts`] appended, and the index of the first such
    /// plane.
    pub(super) plane_body: Vec<usize>,
    pub(super) first_plane: usize,
    pub(super) moving: Vec<MovingPlane>,
    pub(super) descent: Descent,
    pub(super) report: CouplingReport,
}

impl RigidScene {
    /// Creates the bodies at rest at their start poses. `dt_s` is the tick; gravity is in world axes and acts
    /// on free bodies; `sphere_count` is the number of the tool's proxy spheres.
    ///
    /// # Errors
    /// [`RigidError`]: a number is invalid.
    pub fn new(
        bodies: &[BodyParameters],
        gravity_m_per_s2: &Vector3<f64>,
        dt_s: f64,
        sphere_count: usize,
    ) -> Result<RigidScene, RigidError> {
        for body in bodies {
            body.validate()?;
        }
        let scene = |field, value, allowed| Err(RigidError::Scene { field, value, allowed });
        if !(1e-7..=0.1).contains(&dt_s) {
            return scene("dt_s", dt_s, "1e-7 to 0.1 s");
        }
        if let Some(&value) = gravity_m_per_s2.iter().find(|x| x.is_nan() || x.abs() > 1000.0) {
            return scene("gravity_m_per_s2", value, "-1000 to 1000 m/s^2");
        }
        let (world, handles) = World::new(bodies);
        let most_planes = sphere_count * bodies.len();
        let bodies = bodies.iter().zip(handles.iter().copied()).map(|(body, handle)| Body {
            handle,
            kind: body.motion,
            shape: QueryShape::new(&body.shape),
            t_world_body: world.pose(handle),
            centre_m: world.centre_m(handle),
            motion: world.motion(handle),
            mean: Motion::zero(),
            goal: body.t_world_body,
            wrench: Wrench::zero(),
        });
        Ok(RigidScene {
            dt_s,
            bodies: bodies.collect(),
            stepper: Stepper::new(dt_s, gravity_m_per_s2),
            trial: world.clone(),
            world,
            plane_body: Vec::with_capacity(most_planes),
            first_plane: 0,
            moving: Vec::with_capacity(most_planes),
            descent: Descent::new(handles.len()),
            report: CouplingReport::none(),
        })
    }

    /// Drives a body until the next command.
    ///
    /// # Errors
    /// Its motion does not allow it, or there is no such body. Nothing has changed then.
    pub fn drive(&mut self, body: usize, drive: BodyDrive) -> Result<(), DriveError> {
        let body = self.bodies.get_mut(body).ok_or(DriveError::NoBody)?;
        match (drive, body.kind) {
            (BodyDrive::Wrench(wrench), BodyMotion::Free) => self.world.set_wrench(body.handle, &wrench),
            (BodyDrive::Pose(goal), BodyMotion::Driven) => body.goal = goal,
            (BodyDrive::Wrench(_), _) => return Err(DriveError::NotFree),
            (BodyDrive::Pose(_), _) => return Err(DriveError::NotDriven),
        }
        Ok(())
    }

    /// Plans the motion of driven bodies in the next step.
    fn plan_driven(&mut self) {
        for body in self.bodies.iter_mut().filter(|body| body.kind == BodyMotion::Driven) {
            let (next, motion) = toward(&body.t_world_body, &body.goal, self.dt_s);
            self.world.set_next_pose(body.handle, &next);
            body.motion = motion;
        }
    }

    /// Plans the motion of driven bodies. Then, for each sphere and body, appends the plane at the body's
    /// nearest surface point if the gap is below `margin_m` or could close within the tick at the current
    /// velocities. At most one plane per sphere and body.
    pub fn find_contacts(&mut self, spheres: &[ProxySphere], margin_m: f64, planes: &mut Vec<ContactPlane>) {
        self.plan_driven();
        self.first_plane = planes.len();
        self.plane_body.clear();
        for (index, body) in self.bodies.iter().enumerate() {
            let reach_m = body.shape.bounding_radius_m();
            for (sphere_index, sphere) in spheres.iter().enumerate() {
                let relative = sphere.velocity_m_per_s - body.motion.at(&(sphere.centre_m - body.centre_m));
                let margin_m = margin_m + libm::sqrt(relative.norm_squared()) * self.dt_s;
                let near_m = reach_m + sphere.radius_m + margin_m;
                let between = sphere.centre_m - body.t_world_body.translation.vector;
                if between.norm_squared() > near_m * near_m {
                    continue;
                }
                let nearest = body.shape.nearest(&body.t_world_body, &sphere.centre_m);
                let gap_m = nearest.distance_m - sphere.radius_m;
                if gap_m <= margin_m {
                    let is_driven = body.kind == BodyMotion::Driven;
                    let surface_m_per_s =
                        is_driven.then(|| body.motion.at(&(nearest.point_m - body.centre_m)));
                    let plane = ContactPlane::hard(sphere_index, nearest.point_m, nearest.normal, gap_m);
                    planes.push(ContactPlane { surface_m_per_s, ..plane });
                    self.plane_body.push(index);
                }
            }
        }
    }

    /// Returns the smallest gap between each body and these spheres, m; negative if they overlap; in the
    /// order of the definition.
    pub fn gaps_m(&self, spheres: &[ProxySphere]) -> Vec<f64> {
        let gap_m = |body: &Body, sphere: &ProxySphere| {
            body.shape.nearest(&body.t_world_body, &sphere.centre_m).distance_m - sphere.radius_m
        };
        let smallest_m =
            |body: &Body| spheres.iter().map(|sphere| gap_m(body, sphere)).fold(f64::INFINITY, f64::min);
        self.bodies.iter().map(smallest_m).collect()
    }

    /// Returns the number of bodies.
    pub fn body_count(&self) -> usize {
        self.bodies.len()
    }

    /// Returns the pose of each body, in the order of the definition.
    pub fn poses(&self) -> impl Iterator<Item = &Isometry3<f64>> {
        self.bodies.iter().map(|body| &body.t_world_body)
    }

    /// Returns the velocity of a body's centre of mass and its angular velocity, world axes, m/s and rad/s;
    /// `None` past the last.
    pub fn velocity(&self, body: usize) -> Option<(Vector3<f64>, Vector3<f64>)> {
        self.bodies.get(body).map(|body| (body.motion.linear, body.motion.angular))
    }

    /// Returns the mean wrench of the tool on each body in the last step, about its centre of mass, world
    /// axes.
    pub fn tool_wrenches(&self) -> impl Iterator<Item = &Wrench> {
        self.bodies.iter().map(|body| &body.wrench)
    }

    /// Returns the mass of a body, kg; `None` past the last.
    pub fn mass_kg(&self, body: usize) -> Option<f64> {
        self.bodies.get(body).map(|body| self.world.body(body.handle).mass())
    }

    /// Returns the body of a plane of the last [`Self::find_contacts`], by index in the list; `None` if the
    /// plane has another source.
    pub fn body_of_plane(&self, plane: usize) -> Option<usize> {
        plane.checked_sub(self.first_plane).and_then(|own| self.plane_body.get(own)).copied()
    }

    /// Returns the outcome of the last step's coupling.
    pub fn last_report(&self) -> &CouplingReport {
        &self.report
    }

    /// Sums up the tool's contact forces on each body. The bodies must be as at the start of the step.
    pub(super) fn note_wrenches(&mut self, manipulator: &impl ManipulatorModel, planes: &[ContactPlane]) {
        self.bodies.iter_mut().for_each(|body| body.wrench = Wrench::zero());
        for result in manipulator.contact_results() {
            let index = self.body_of_plane(result.contact_index);
            let (Some(index), Some(plane)) = (index, planes.get(result.contact_index)) else { continue };
            let body = &mut self.bodies[index];
            let force_n = -(result.normal * result.normal_force_n + result.friction_force_n);
            body.wrench.force_n += force_n;
            body.wrench.torque_nm += (plane.point_m - body.centre_m).cross(&force_n);
        }
    }

    /// Reads poses and velocities from the world after a step; the world before it is `trial`.
    pub(super) fn update_bodies(&mut self) {
        for body in &mut self.bodies {
            body.mean = self.trial.motion_to(&self.world, body.handle, self.dt_s);
            body.t_world_body = self.world.pose(body.handle);
            body.centre_m = self.world.centre_m(body.handle);
            body.motion = self.world.motion(body.handle);
        }
    }

    /// Returns a copy of the complete dynamic state. Allocates.
    pub fn snapshot(&self) -> RigidSnapshot {
        RigidSnapshot {
            world: self.world.clone(),
            mean: self.bodies.iter().map(|body| body.mean).collect(),
            memory: self.descent.memory().to_vec(),
            touched: self.descent.inertia.clone(),
            report: self.report,
            goals: self.bodies.iter().map(|body| body.goal).collect(),
        }
    }

    /// Returns the contents of [`Self::snapshot`], serialisable without a copy; deserialises as a
    /// [`RigidSnapshot`].
    pub fn serialised(&self) -> impl Serialize + '_ {
        let mean = Each(&self.bodies, |body| &body.mean);
        let goals = Each(&self.bodies, |body| &body.goal);
        (&self.world, mean, self.descent.memory(), &self.descent.inertia, &self.report, goals)
    }

    /// Returns true if a deserialised snapshot belongs to a scene with these bodies.
    pub fn fits(&self, snapshot: &RigidSnapshot) -> bool {
        let bodies = self.bodies.len();
        snapshot.world.holds(self.bodies.iter().map(|body| body.handle))
            && snapshot.mean.len() == bodies
            && snapshot.touched.len() == bodies
            && snapshot.goals.len() == bodies
            && snapshot.goals.iter().all(is_sound)
            && snapshot.memory.iter().all(|pair| pair.bodies() == bodies)
    }

    /// Continues bit for bit from a snapshot of a scene with the same bodies. Allocates.
    pub fn restore(&mut self, snapshot: &RigidSnapshot) {
        self.world = snapshot.world.clone();
        self.update_bodies();
        for ((body, mean), goal) in self.bodies.iter_mut().zip(&snapshot.mean).zip(&snapshot.goals) {
            (body.mean, body.goal) = (*mean, *goal);
        }
        self.descent.restore_memory(&snapshot.memory);
        self.descent.inertia.clone_from(&snapshot.touched);
        self.report = snapshot.report;
    }
}

/// Returns the pose of a driven body after a step toward its goal, at [`FASTEST_DRIVEN`] if the goal is
/// farther away, and its mean motion.
fn toward(from: &Isometry3<f64>, goal: &Isometry3<f64>, dt_s: f64) -> (Isometry3<f64>, Motion) {
    // Rapier turns along the arc between the two quaternions: choose the sign of the goal that makes it the
    // shorter one.
    let near = if from.rotation.coords.dot(&goal.rotation.coords) < 0.0 { -1.0 } else { 1.0 };
    let rotation = UnitQuaternion::new_unchecked(goal.rotation.into_inner() * near);
    let shift_m = goal.translation.vector - from.translation.vector;
    let turn_rad = (rotation * from.rotation.inverse()).scaled_axis();
    let most = FASTEST_DRIVEN.map(|fastest| fastest * dt_s);
    let excess = (shift_m.norm() / most[0]).max(turn_rad.norm() / most[1]);
    if excess <= 1.0 {
        let motion = Motion { linear: shift_m / dt_s, angular: turn_rad / dt_s };
        return (Isometry3::from_parts(goal.translation, rotation), motion);
    }
    let (shift_m, turn_rad) = (shift_m / excess, turn_rad / excess);
    let turned = UnitQuaternion::from_scaled_axis(turn_rad) * from.rotation;
    let next = Isometry3::from_parts(
        Translation3::from(from.translation.vector + shift_m),
        UnitQuaternion::new_normalize(turned.into_inner()),
    );
    (next, Motion { linear: shift_m / dt_s, angular: turn_rad / dt_s })
}

/// Returns true if a pose is finite with a unit quaternion.
fn is_sound(pose: &Isometry3<f64>) -> bool {
    pose.translation.vector.iter().all(|x| x.is_finite()) && (pose.rotation.norm() - 1.0).abs() < 1e-9
}
