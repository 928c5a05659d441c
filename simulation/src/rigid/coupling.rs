//! Tool and bodies in one tick: the common motion.
//!
//! The tool is stepped against planes whose gap is shortened by what the bodies are thought to move, and exerts impulses;
//! Rapier, given these, moves the bodies. [`Descent`] brings thought and motion together.

use serde::{Deserialize, Serialize};

use crate::contact_plane::ContactPlane;
use crate::manipulator::{
    BaseMotion, ManipulatorError, ManipulatorModel, StepInput, StepReport, TendonCommand, Wrench,
};

use super::descent::{Inertia, Motion};
use super::scene::RigidScene;

/// Largest difference between a plane's speed as the tool saw it and as the body made it that ends the iteration, m/s:
/// ten times what the tool's contact solver leaves.
const TOLERANCE_M_PER_S: f64 = 1e-5;
/// Bound on the evaluations in a tick.
const MAX_EVALUATIONS: usize = 24;

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
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
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
        manipulator: &mut impl ManipulatorModel,
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
            self.trial.clone_from(&self.world);
            self.stepper.step(&mut self.trial);
            report
        } else {
            let outcome = self.iterate(manipulator, drive, planes);
            for moving in &self.moving {
                planes[moving.plane].gap_m = moving.still_gap_m;
            }
            outcome?
        };
        core::mem::swap(&mut self.world, &mut self.trial);
        self.update_bodies();
        Ok(report)
    }

    /// The planes on free bodies, and how these bodies move if they do as in the last tick.
    fn collect_moving(&mut self, planes: &[ContactPlane]) {
        self.moving.clear();
        for (own, &body_index) in self.plane_body.iter().enumerate() {
            let plane = self.first_plane + own;
            let Some(contact) = planes.get(plane) else { continue };
            if self.bodies[body_index].free {
                let still_gap_m = contact.gap_m;
                self.moving.push(Moving { plane, body: body_index, still_gap_m, pressed: false });
            }
        }
        let mut changed = false;
        for (k, body) in self.bodies.iter().enumerate() {
            let touched = self.moving.iter().any(|moving| moving.body == k);
            changed |= touched != (self.descent.inertia[k].mass_kg > 0.0);
            self.descent.motion[k] = if touched { body.mean } else { Motion::zero() };
            self.descent.residual[k] = Motion::zero();
            self.descent.inertia[k] = if touched { self.world.inertia(body.handle) } else { Inertia::none() };
        }
        if changed {
            self.descent.forget();
        }
    }

    /// Finds the common motion; tool and trial world are those of the evaluation that ends it.
    fn iterate(
        &mut self,
        manipulator: &mut impl ManipulatorModel,
        drive: &ToolDrive,
        planes: &mut [ContactPlane],
    ) -> Result<StepReport, ManipulatorError> {
        let start = manipulator.snapshot();
        let most = if self.coupling == Coupling::Iterated { MAX_EVALUATIONS } else { 1 };
        let mut evaluations = 1;
        let (mut report, mut residual) = self.evaluate(manipulator, drive, planes)?;
        let mut best = residual;
        self.descent.keep_best();
        while residual > TOLERANCE_M_PER_S && evaluations < most {
            if evaluations == 1 {
                self.descent.begin()
            } else {
                self.descent.advance()
            }
            manipulator.restore(&start);
            (report, residual) = self.evaluate(manipulator, drive, planes)?;
            evaluations += 1;
            if residual < best {
                best = residual;
                self.descent.keep_best();
            }
        }
        if evaluations > 1 {
            self.descent.remember();
        }
        if residual > best {
            self.descent.take_best();
            manipulator.restore(&start);
            (report, residual) = self.evaluate(manipulator, drive, planes)?;
            evaluations += 1;
        }
        self.report =
            CouplingReport { moving_planes: self.moving.len(), evaluations, residual_m_per_s: residual };
        Ok(report)
    }

    /// Steps tool and trial world with the motion of the descent; its residual, and the largest of a plane's speed, m/s.
    fn evaluate(
        &mut self,
        manipulator: &mut impl ManipulatorModel,
        drive: &ToolDrive,
        planes: &mut [ContactPlane],
    ) -> Result<(StepReport, f64), ManipulatorError> {
        for moving in &mut self.moving {
            let plane = &mut planes[moving.plane];
            let arm = plane.point_m - self.bodies[moving.body].centre_m;
            let speed = self.descent.motion[moving.body].at(&arm).dot(&plane.normal);
            plane.gap_m = moving.still_gap_m - speed * self.dt_s;
            moving.pressed = false;
        }
        let report = step_tool(manipulator, self.dt_s, drive, planes)?;
        self.trial.clone_from(&self.world);
        for result in manipulator.contact_results() {
            let Ok(place) = self.moving.binary_search_by_key(&result.contact_index, |moving| moving.plane)
            else {
                continue;
            };
            let moving = &mut self.moving[place];
            moving.pressed = result.normal_force_n > 0.0;
            let force = result.normal * result.normal_force_n + result.friction_force_n;
            let handle = self.bodies[moving.body].handle;
            self.trial.apply_impulse(handle, &(force * -self.dt_s), &planes[moving.plane].point_m);
        }
        self.stepper.step(&mut self.trial);
        Ok((report, self.residuals(planes)))
    }

    /// Response minus motion; the largest difference of a plane's speeds, m/s.
    fn residuals(&mut self, planes: &[ContactPlane]) -> f64 {
        let mut largest = 0.0f64;
        for moving in &self.moving {
            let body = &self.bodies[moving.body];
            let response = self.world.motion_to(&self.trial, body.handle, self.dt_s);
            let residual = response.plus(-1.0, &self.descent.motion[moving.body]);
            self.descent.residual[moving.body] = residual;
            let plane = &planes[moving.plane];
            let difference = residual.at(&(plane.point_m - body.centre_m)).dot(&plane.normal);
            // A plane that no force holds and that recedes faster than the tool was told changes nothing.
            if moving.pressed || difference > 0.0 {
                largest = largest.max(difference.abs());
            }
        }
        largest
    }
}

fn step_tool(
    manipulator: &mut impl ManipulatorModel,
    dt_s: f64,
    drive: &ToolDrive,
    planes: &[ContactPlane],
) -> Result<StepReport, ManipulatorError> {
    let input =
        StepInput { base: drive.base, tendon: drive.tendon, tip_wrench: drive.tip_wrench, contacts: planes };
    manipulator.step(dt_s, &input)
}
