//! Virtual fixtures: keeps the tool out of the margin of critical structures, whatever is commanded.
//!
//! **Arm.** After each tick the stop that could begin then is planned, and the clearance of the tool's
//! contact spheres is measured on its way and where it ends, with the tool's present shape. If that and the
//! way of two more ticks would fall below the margin, the arm brakes in the next tick, whatever is commanded.
//! At rest at the margin, the first tick of a motion is tried: one that comes closer is cancelled.
//!
//! **Tendons.** A setpoint x of a tendon moves a sphere's clearance d by (∂d/∂x) ẋ, with the free tool's
//! quasi-static ∂d/∂x = n · Σ_j (lever / k_j) b_j × (p - o_j) for a tension, over the flexures j before the
//! sphere at p, with their positions o_j, axes b_j and stiffnesses k_j. The rates keep ḋ ≥ -[`RATE_PER_S`]
//! (d - margin), a vector-field inequality: Marinho et al. 2019, "Dynamic active constraints for surgical
//! robots using vector-field inequalities", IEEE Trans. Robotics 35:1166.

use nalgebra::{Isometry3, Vector3};
use scene::StructureAction;
use structures::{Memory, Spheres, Structure};

use super::tendon_drive::RateLimits;
use super::{Simulation, SimulationError};
use crate::arm::ArmError;
use crate::manipulator::{
    AnyManipulator, MAX_TENDONS, ManipulatorModel, ManipulatorParameters, ProxySphere, SphereKind,
    TendonCommand,
};

/// Share of what is left of the clearance that tendons may use up in a second.
const RATE_PER_S: f64 = 10.0;
/// Clearance beyond the margin up to which an arm at rest accepts only motions that do not come closer, m.
const AT_MARGIN_M: f64 = 10e-6;
/// Clearance beyond the margin and the way of half a second from which on no stop is planned, m.
const FAR_M: f64 = 20e-3;
/// Clearance beyond the margin within which the direction of a sphere's motion counts for tendons, m.
const NEAR_M: f64 = 20e-3;
/// Step of the difference quotient for the direction away from a structure, m.
const GRADIENT_STEP_M: f64 = 1e-6;

/// What keeps the tool out of structures.
#[derive(Debug)]
pub(super) struct Fixture {
    /// Index of each structure with a fixture, and the clearance that it keeps, m.
    kept: Vec<(usize, f64)>,
    /// The tool's spheres on the way of a stop.
    ahead: Spheres,
    memories: Vec<Memory>,
    /// The structure that the arm is held back from.
    hold: Option<Hold>,
    /// What a stop would use up of the clearance, m.
    stop_m: f64,
    /// Whether the tendons' rates were limited in the last tick.
    has_slowed: bool,
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct Hold {
    structure: usize,
    /// Whether the arm is at rest.
    is_at_rest: bool,
}

impl Fixture {
    /// Returns the fixture of structures, if one asks for it.
    pub fn new(structures: &[Structure]) -> Option<Fixture> {
        let kept_m = |it: &Structure| match (it.on_margin, it.on_breach) {
            (StructureAction::Fixture, _) => Some(it.margin_m),
            (_, StructureAction::Fixture) => Some(0.0),
            _ => None,
        };
        let each = structures.iter().enumerate();
        let kept: Vec<(usize, f64)> = each.filter_map(|(index, it)| Some((index, kept_m(it)?))).collect();
        let memories = vec![Memory::default(); kept.len()];
        (!kept.is_empty()).then(|| Fixture {
            kept,
            ahead: Spheres::default(),
            memories,
            hold: None,
            stop_m: 0.0,
            has_slowed: false,
        })
    }

    /// Returns the structure of which the least is left if the tool moves with its base from `from` to `to`,
    /// and what that is, m.
    fn least_left(
        &mut self,
        structures: &[Structure],
        spheres: &[ProxySphere],
        [from, to]: [&Isometry3<f64>; 2],
    ) -> (usize, f64) {
        let motion = to * from.inverse();
        let moved = |sphere: &ProxySphere| {
            ((motion * nalgebra::Point3::from(sphere.centre_m)).coords, sphere.radius_m)
        };
        self.ahead.place(spheres.iter().map(moved));
        let mut least = (0, f64::INFINITY);
        for ((index, kept_m), memory) in self.kept.iter().zip(&mut self.memories) {
            if let Some(clearance) = structures[*index].nearest(&self.ahead, memory)
                && clearance.distance_m - kept_m < least.1
            {
                least = (*index, clearance.distance_m - kept_m);
            }
        }
        least
    }
}

impl Simulation<'_> {
    /// Finds out from the present state whether the arm has to be held back in the next tick.
    ///
    /// # Errors
    /// Ruckig finds no stop.
    pub(super) fn look_ahead(&mut self) -> Result<(), SimulationError> {
        let watch = &mut self.structure_watch;
        let Some(fixture) = &mut watch.fixture else { return Ok(()) };
        let (arm, spheres) = (*self.arm.state(), self.manipulator.proxy_spheres());
        let now = arm.t_world_tool;
        let (mut structure, left_now_m) = fixture.least_left(&watch.structures, spheres, [&now, &now]);
        let reach_m = spheres.iter().map(|sphere| (sphere.centre_m - now.translation.vector).norm());
        let reach_m = reach_m.fold(0.0, f64::max);
        let speed_m_per_s = arm.linear_velocity_m_s.norm() + arm.angular_velocity_rad_s.norm() * reach_m;
        (fixture.hold, fixture.stop_m) = (None, 0.0);
        if left_now_m > FAR_M + 0.5 * speed_m_per_s {
            return Ok(());
        }
        let mut least_m = left_now_m;
        let is_at_rest = speed_m_per_s == 0.0;
        if !is_at_rest {
            self.arm.visit_stop(|pose| {
                let (index, left_m) = fixture.least_left(&watch.structures, spheres, [&now, pose]);
                if left_m < least_m {
                    (structure, least_m) = (index, left_m);
                }
            })?;
        }
        fixture.stop_m = left_now_m - least_m;
        let next_m = 2.0 * self.dt_s * speed_m_per_s;
        let is_held =
            if is_at_rest { least_m < AT_MARGIN_M } else { least_m < next_m && least_m < left_now_m };
        fixture.hold = is_held.then_some(Hold { structure, is_at_rest });
        Ok(())
    }

    /// Moves the arm by a tick, or holds it back.
    pub(super) fn step_arm(&mut self) {
        let watch = &mut self.structure_watch;
        let Some((fixture, hold)) = watch.fixture.as_mut().and_then(|it| it.hold.map(|hold| (it, hold)))
        else {
            self.arm.step();
            return;
        };
        let reason = ArmError::Fixture { structure: hold.structure };
        if self.arm.state().protective_stop.is_stopped() {
            self.arm.step();
        } else if hold.is_at_rest {
            let before = *self.arm.state();
            let after = self.arm.step().t_world_tool;
            let (now, spheres) = (&before.t_world_tool, self.manipulator.proxy_spheres());
            let (_, left_m) = fixture.least_left(&watch.structures, spheres, [now, now]);
            let (_, next_m) = fixture.least_left(&watch.structures, spheres, [now, &after]);
            if next_m < left_m {
                self.arm.stand(&before.q_rad, reason);
            }
        } else {
            self.arm.brake(reason);
        }
    }

    /// Moves the tendons' actuators by a tick, as quickly as a fixture allows.
    pub(super) fn step_tendons(&mut self) -> TendonCommand {
        let mut limits = RateLimits { up: [f64::INFINITY; MAX_TENDONS], down: [f64::INFINITY; MAX_TENDONS] };
        let Some(is_force) = self.tendon.is_force_under_way() else {
            self.structure_watch.fixture.iter_mut().for_each(|fixture| fixture.has_slowed = false);
            return self.tendon.step(self.dt_s, &limits);
        };
        let nearest = self.limit_tendons(&mut limits, is_force);
        let command = self.tendon.step(self.dt_s, &limits);
        let is_slowed = self.tendon.is_slowed();
        let had_slowed =
            self.structure_watch.fixture.as_mut().map(|it| core::mem::replace(&mut it.has_slowed, is_slowed));
        if let (true, Some(false), Some(structure)) = (is_slowed, had_slowed, nearest) {
            self.tell_tendon_driver(format!(
                "tendon: the fixture of `structure[{structure}]` slows the tendons down"
            ));
        }
        command
    }

    /// Limits the rates of the tendons; returns the structure that limits them most.
    fn limit_tendons(&self, limits: &mut RateLimits, is_force: bool) -> Option<usize> {
        let watch = &self.structure_watch;
        let fixture = watch.fixture.as_ref()?;
        let tool = &self.manipulator;
        let mut bending = Bending::new(tool, is_force);
        let (mut least_rate, mut nearest) = (f64::INFINITY, None);
        for (number, sphere) in tool.proxy_spheres().iter().enumerate() {
            bending.pass_flexures_before(tool, sphere);
            for (index, kept_m) in &fixture.kept {
                let (structure, memory) = (&watch.structures[*index], &watch.memories[*index]);
                if number < memory.first() {
                    continue;
                }
                // Not what is remembered of it: that depends on where the run began.
                let distance_m = |at: &Vector3<f64>| structure.shape.distance_m(at);
                let here_m = distance_m(&sphere.centre_m);
                let left_m = here_m - sphere.radius_m - kept_m - fixture.stop_m;
                let beside = |axis: usize| {
                    distance_m(&(sphere.centre_m + Vector3::ith(axis, GRADIENT_STEP_M))) - here_m
                };
                let away = (left_m < NEAR_M)
                    .then(|| Vector3::new(beside(0), beside(1), beside(2)) / GRADIENT_STEP_M);
                for t in 0..tool.tendon_count() {
                    let motion = bending.motion(t, &sphere.centre_m);
                    let (change, is_both) = match away {
                        Some(away) => (away.dot(&motion), false),
                        None => (-motion.norm(), true),
                    };
                    let rate = RATE_PER_S * left_m.max(0.0) / (change.abs() * tool.tendon_count() as f64);
                    if change < 0.0 {
                        limits.up[t] = limits.up[t].min(rate);
                    }
                    if change > 0.0 || is_both {
                        limits.down[t] = limits.down[t].min(rate);
                    }
                    if rate < least_rate {
                        (least_rate, nearest) = (rate, Some(*index));
                    }
                }
            }
        }
        nearest
    }
}

/// How tendons move the points of the free tool, summed over the flexures passed so far: a tendon moves the
/// point p by `turn` x p - `moment` for each unit of its setpoint.
struct Bending<'t> {
    parameters: &'t ManipulatorParameters,
    levers_m: [[f64; 2]; MAX_TENDONS],
    /// 1 for tensions; for displacements, the tension for each metre.
    scale: [f64; MAX_TENDONS],
    passed: usize,
    turn: [Vector3<f64>; MAX_TENDONS],
    moment: [Vector3<f64>; MAX_TENDONS],
}

impl<'t> Bending<'t> {
    fn new(tool: &'t AnyManipulator, is_force: bool) -> Bending<'t> {
        let parameters = tool.parameters();
        let mut levers_m = [[0.0; 2]; MAX_TENDONS];
        match &parameters.tendon_routes {
            None => {
                levers_m[0][0] = parameters.tendon.offset_m;
                levers_m[1][0] = -parameters.tendon.offset_m;
            }
            Some(routes) => {
                levers_m.iter_mut().zip(routes).for_each(|(lever, route)| *lever = route.channel_m)
            }
        }
        let compliance: f64 = parameters.joint_stiffness_nm_per_rad.iter().map(|k| 1.0 / k).sum();
        let scale = levers_m.map(|[x, y]| {
            let displacement_m_per_n = compliance * (x * x + y * y);
            if is_force || displacement_m_per_n == 0.0 { 1.0 } else { 1.0 / displacement_m_per_n }
        });
        let zeros = [Vector3::zeros(); MAX_TENDONS];
        Bending { parameters, levers_m, scale, passed: 0, turn: zeros, moment: zeros }
    }

    /// Adds the flexures between the sphere before and this one.
    fn pass_flexures_before(&mut self, tool: &AnyManipulator, sphere: &ProxySphere) {
        let all = self.parameters.joint_stiffness_nm_per_rad.len();
        let before = match sphere.kind {
            SphereKind::Shaft => 0,
            SphereKind::Segment(segment) => (segment + 1).min(all),
            SphereKind::Burr => all,
        };
        while self.passed < before {
            let flexure = tool.t_world_point(self.passed + 1, 0.0);
            let stiffness_nm_per_rad = self.parameters.joint_stiffness_nm_per_rad[self.passed];
            for t in 0..MAX_TENDONS {
                let [x, y] = self.levers_m[t];
                // A pull at +x bends toward +x, about +y.
                let axis = flexure.rotation * Vector3::new(-y, x, 0.0);
                let turn = axis * (self.scale[t] / stiffness_nm_per_rad);
                self.turn[t] += turn;
                self.moment[t] += turn.cross(&flexure.translation.vector);
            }
            self.passed += 1;
        }
    }

    /// Returns by how much a tendon moves a point for each unit of its setpoint, m/N or m/m.
    fn motion(&self, tendon: usize, point_m: &Vector3<f64>) -> Vector3<f64> {
        self.turn[tendon].cross(point_m) - self.moment[tendon]
    }
}
