//! Tool and bodies in one tick: the fixed point of the planes' speeds.
//!
//! Unknown is the speed u_j with which plane j moves along its normal through the tick. The tool, stepped against planes
//! whose gap is shortened by u_j dt, exerts impulses; Rapier, given these, moves the bodies, and with them the planes, by
//! g_j(u) dt. Wanted is g(u) = u. Both sides are monotone (the harder the tool is met, the larger its impulse; the larger
//! the impulse, the faster the body yields), so there is one solution, and while no contact opens or closes g is linear:
//! Anderson's acceleration finds it in one evaluation more than there are directions in which bodies yield.

use crate::contact_plane::ContactPlane;
use crate::manipulator::{BaseMotion, Manipulator, ManipulatorError, StepInput, StepReport, TendonCommand, Wrench};

use super::scene::RigidScene;

/// Largest |g(u) - u| that ends the iteration, m/s: ten times what the tool's contact solver leaves.
const TOLERANCE_M_PER_S: f64 = 1e-5;
/// Bound on the evaluations of g in a tick.
const MAX_EVALUATIONS: usize = 12;
/// Largest step along a direction whose slope is not known, m/s: small, so that it does not leave the contact (a body
/// lighter than the tool would answer the full residual with many times the right speed).
const PROBING_M_PER_S: f64 = 1e-3;
/// Differences that the acceleration remembers.
const DEPTH: usize = 5;
/// A difference that is left with less than this share of itself says nothing new.
const DEPENDENT: f64 = 1e-6;

/// How tool and free bodies meet in a tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Coupling {
    /// Iterated to the common motion.
    Iterated,
    /// Baseline: the tool meets a body that goes on as before, then the body gets the impulse. A body lighter than the
    /// tool is thrown off with more energy than the tool had.
    Staggered,
}

/// What drives the tool through the tick.
#[derive(Debug, Clone, Copy)]
pub struct ToolDrive {
    /// Motion of the flange.
    pub base: BaseMotion,
    /// The tendons.
    pub tendon: TendonCommand,
    /// External load on the burr.
    pub tip_wrench: Wrench,
}

/// How the coupling of a tick ended.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CouplingReport {
    /// Contact planes on free bodies.
    pub moving_planes: usize,
    /// Steps of the tool and the bodies that were tried.
    pub evaluations: usize,
    /// Largest difference between a plane's speed as the tool saw it and as the body made it, m/s.
    pub residual_m_per_s: f64,
}

impl CouplingReport {
    pub(super) fn none() -> Self {
        Self { moving_planes: 0, evaluations: 0, residual_m_per_s: 0.0 }
    }
}

/// A contact plane on a free body.
#[derive(Debug, Clone, Copy)]
pub(super) struct Moving {
    /// Index in the list of planes.
    plane: usize,
    body: usize,
    /// Gap if the body stood still, m.
    still_gap_m: f64,
    /// Whether the tool pressed on it in the last evaluation.
    pressed: bool,
}

impl RigidScene {
    /// Steps the manipulator against `planes` (those of the last [`Self::find_contacts`] among them) and the bodies with
    /// what it exerts on them. The planes' gaps are left as they were.
    ///
    /// # Errors
    /// The manipulator refuses its input; nothing has changed.
    pub fn step(
        &mut self,
        manipulator: &mut Manipulator,
        drive: &ToolDrive,
        planes: &mut [ContactPlane],
    ) -> Result<StepReport, ManipulatorError> {
        self.collect_moving(planes);
        let report = if self.moving.is_empty() {
            self.report = CouplingReport::none();
            let report = step_tool(manipulator, self.dt_s, drive, planes)?;
            if !self.bodies.iter().any(|body| body.free) {
                return Ok(report);
            }
            self.stepper.step(&mut self.world);
            report
        } else {
            let outcome = self.iterate(manipulator, drive, planes);
            for moving in &self.moving {
                planes[moving.plane].gap_m = moving.still_gap_m;
            }
            let report = outcome?;
            core::mem::swap(&mut self.world, &mut self.trial);
            report
        };
        self.update_bodies();
        Ok(report)
    }

    /// The planes on free bodies, and the speeds that these planes have if the bodies go on as in the last tick.
    fn collect_moving(&mut self, planes: &[ContactPlane]) {
        self.moving.clear();
        self.fixed_point.clear();
        for (own, &body_index) in self.plane_body.iter().enumerate() {
            let body = &self.bodies[body_index];
            let plane = self.first_plane + own;
            let Some(contact) = planes.get(plane) else { continue };
            if body.free {
                let velocity = body.twist.at(&contact.point_m) * 2.0 - body.previous.at(&contact.point_m);
                self.fixed_point.guess.push(velocity.dot(&contact.normal));
                self.fixed_point.residual.push(0.0);
                let still_gap_m = contact.gap_m;
                self.moving.push(Moving { plane, body: body_index, still_gap_m, pressed: false });
            }
        }
    }

    /// Finds the fixed point; tool and trial world are those of the evaluation that ends it.
    fn iterate(
        &mut self,
        manipulator: &mut Manipulator,
        drive: &ToolDrive,
        planes: &mut [ContactPlane],
    ) -> Result<StepReport, ManipulatorError> {
        let start = manipulator.snapshot();
        let mut evaluations = 1;
        let mut report = self.evaluate(manipulator, drive, planes)?;
        let mut residual = self.fixed_point.largest_residual();
        let mut best = residual;
        self.fixed_point.keep_best();
        let most = if self.coupling == Coupling::Iterated { MAX_EVALUATIONS } else { 1 };
        while residual > TOLERANCE_M_PER_S && evaluations < most {
            self.fixed_point.improve();
            manipulator.restore(&start);
            report = self.evaluate(manipulator, drive, planes)?;
            evaluations += 1;
            residual = self.fixed_point.largest_residual();
            if residual < best {
                best = residual;
                self.fixed_point.keep_best();
            }
        }
        if residual > best {
            self.fixed_point.take_best();
            manipulator.restore(&start);
            report = self.evaluate(manipulator, drive, planes)?;
            evaluations += 1;
        }
        let residual_m_per_s = self.fixed_point.largest_residual();
        self.report = CouplingReport { moving_planes: self.moving.len(), evaluations, residual_m_per_s };
        Ok(report)
    }

    /// Steps tool and trial world at the guessed speeds; the residuals go to the fixed point.
    fn evaluate(
        &mut self,
        manipulator: &mut Manipulator,
        drive: &ToolDrive,
        planes: &mut [ContactPlane],
    ) -> Result<StepReport, ManipulatorError> {
        for (moving, speed) in self.moving.iter_mut().zip(&self.fixed_point.guess) {
            planes[moving.plane].gap_m = moving.still_gap_m - speed * self.dt_s;
            moving.pressed = false;
        }
        let report = step_tool(manipulator, self.dt_s, drive, planes)?;
        self.trial.clone_from(&self.world);
        for result in manipulator.contact_results() {
            let Ok(place) = self.moving.binary_search_by_key(&result.contact_index, |moving| moving.plane) else {
                continue;
            };
            let moving = &mut self.moving[place];
            moving.pressed = result.normal_force_n > 0.0;
            let force = result.normal * result.normal_force_n + result.friction_force_n;
            let handle = self.bodies[moving.body].handle;
            self.trial.apply_impulse(handle, &(force * -self.dt_s), &planes[moving.plane].point_m);
        }
        self.stepper.step(&mut self.trial);
        for (k, moving) in self.moving.iter().enumerate() {
            let (plane, body) = (&planes[moving.plane], &self.bodies[moving.body]);
            let point = plane.point_m.into();
            let moved = self.trial.pose(body.handle) * body.t_world_body.inverse_transform_point(&point) - point;
            let speed = moved.dot(&plane.normal) / self.dt_s;
            let difference = speed - self.fixed_point.guess[k];
            // A plane that no force holds and that recedes faster than the tool was told changes nothing.
            self.fixed_point.residual[k] = if moving.pressed || difference > 0.0 { difference } else { 0.0 };
        }
        Ok(report)
    }
}

fn step_tool(
    manipulator: &mut Manipulator,
    dt_s: f64,
    drive: &ToolDrive,
    planes: &[ContactPlane],
) -> Result<StepReport, ManipulatorError> {
    let input = StepInput { base: drive.base, tendon: drive.tendon, tip_wrench: drive.tip_wrench, contacts: planes };
    manipulator.step(dt_s, &input)
}

/// Anderson's acceleration (Anderson 1965, J. ACM 12(4); Walker and Ni 2011, SIAM J. Numer. Anal. 49(4), eq. 2.2) of
/// u <- u + residual(u), with a bounded step where nothing is known.
pub(super) struct FixedPoint {
    /// u.
    pub guess: Vec<f64>,
    /// g(u) - u, set by the evaluation.
    pub residual: Vec<f64>,
    best: Vec<f64>,
    last_guess: Vec<f64>,
    last_residual: Vec<f64>,
    /// The newest differences of guess and residual, orthonormal in the residual; `used` of them.
    step: [Vec<f64>; DEPTH],
    change: [Vec<f64>; DEPTH],
    used: usize,
    started: bool,
}

impl FixedPoint {
    pub fn new(most_planes: usize) -> FixedPoint {
        let room = || Vec::with_capacity(most_planes);
        FixedPoint {
            guess: room(),
            residual: room(),
            best: room(),
            last_guess: room(),
            last_residual: room(),
            step: core::array::from_fn(|_| room()),
            change: core::array::from_fn(|_| room()),
            used: 0,
            started: false,
        }
    }

    pub fn clear(&mut self) {
        self.guess.clear();
        self.residual.clear();
        self.used = 0;
        self.started = false;
    }

    pub fn largest_residual(&self) -> f64 {
        self.residual.iter().fold(0.0, |most, r| most.max(r.abs()))
    }

    pub fn keep_best(&mut self) {
        self.best.clone_from(&self.guess);
    }

    pub fn take_best(&mut self) {
        self.guess.clone_from(&self.best);
    }

    /// The next guess, from the residual of this one and the differences so far.
    pub fn improve(&mut self) {
        if self.started {
            self.remember();
        }
        self.started = true;
        self.last_guess.clone_from(&self.guess);
        self.last_residual.clone_from(&self.residual);
        // Newton along the known directions; what they leave of the residual is followed by a small step.
        for k in 0..self.used {
            let share = dot(&self.change[k], &self.residual);
            subtract(&mut self.guess, share, &self.step[k]);
            subtract(&mut self.residual, share, &self.change[k]);
        }
        let largest = self.largest_residual();
        if largest > 0.0 {
            let mixing = (PROBING_M_PER_S / largest).min(1.0);
            subtract(&mut self.guess, -mixing, &self.residual);
        }
    }

    /// Takes in the last difference. The oldest is forgotten when the memory is full.
    fn remember(&mut self) {
        if self.used == DEPTH {
            self.step.rotate_left(1);
            self.change.rotate_left(1);
            self.used -= 1;
        }
        let (known_step, step) = self.step.split_at_mut(self.used);
        let (known_change, change) = self.change.split_at_mut(self.used);
        let (step, change) = (&mut step[0], &mut change[0]);
        step.clone_from(&self.guess);
        subtract(step, 1.0, &self.last_guess);
        change.clone_from(&self.residual);
        subtract(change, 1.0, &self.last_residual);
        let whole = libm::sqrt(dot(change, change));
        for (known_step, known_change) in known_step.iter().zip(known_change.iter()) {
            let share = dot(known_change, change);
            subtract(step, share, known_step);
            subtract(change, share, known_change);
        }
        let left = libm::sqrt(dot(change, change));
        if left > DEPENDENT * whole && left > 0.0 {
            step.iter_mut().chain(change.iter_mut()).for_each(|x| *x /= left);
            self.used += 1;
        }
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}

/// a -= scale b.
fn subtract(a: &mut [f64], scale: f64, b: &[f64]) {
    for (x, y) in a.iter_mut().zip(b) {
        *x -= scale * y;
    }
}
