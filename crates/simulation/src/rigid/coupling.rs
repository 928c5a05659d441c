//! Couples the tool and the free bodies within a tick by finding their common motion.
//!
//! The tool steps against planes whose gaps account for the assumed motion of the bodies, and exerts
//! impulses. Rapier then moves the bodies under these impulses. [`Descent`] iterates until the assumed motion
//! and the response agree.

use serde::{Deserialize, Serialize};

use crate::contact_plane::ContactPlane;
use crate::manipulator::{
    BaseMotion, ManipulatorError, ManipulatorModel, StepInput, StepReport, TendonCommand, Wrench,
};

use super::body::BodyMotion;
use super::descent::{Inertia, Motion};
use super::scene::RigidScene;

/// Convergence threshold, m/s: the largest difference between a plane's speed as assumed by the tool and as
/// produced by the body. Ten times the residual of the tool's contact solver.
const TOLERANCE_M_PER_S: f64 = 1e-5;
/// Maximum evaluations per tick.
const MAX_EVALUATIONS: usize = 24;

/// Inputs of the tool in this tick.
#[derive(Debug, Clone, Copy)]
pub struct ToolDrive {
    /// Motion of the flange.
    pub base: BaseMotion,
    /// The tendons.
    pub tendon: TendonCommand,
    /// External load on the burr.
    pub tip_wrench: Wrench,
}

/// Outcome of one tick's coupling.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CouplingReport {
    /// Contact planes on free bodies.
    pub moving_planes: usize,
    /// Number of trial steps of tool and bodies.
    pub evaluations: usize,
    /// Largest difference between a plane's speed as assumed by the tool and as produced by the body, m/s.
    pub residual_m_per_s: f64,
}

impl CouplingReport {
    pub(super) fn none() -> Self {
        Self { moving_planes: 0, evaluations: 0, residual_m_per_s: 0.0 }
    }
}

/// A contact plane on a free body.
#[derive(Debug, Clone, Copy)]
pub(super) struct MovingPlane {
    /// Index in the list of planes.
    plane: usize,
    body: usize,
    /// Gap for a body at rest, m.
    still_gap_m: f64,
    /// True if the tool pressed on it in the last evaluation.
    pressed: bool,
}

impl RigidScene {
    /// Steps the manipulator against `planes` (including those of the last [`Self::find_contacts`]), and the
    /// bodies under its reaction. The planes' gaps are unchanged on return.
    ///
    /// # Errors
    /// The manipulator rejects its input; nothing has changed.
    pub fn step(
        &mut self,
        manipulator: &mut impl ManipulatorModel,
        drive: &ToolDrive,
        planes: &mut [ContactPlane],
    ) -> Result<StepReport, ManipulatorError> {
        self.collect_moving(planes);
        let are_fixed = self.bodies.iter().all(|body| body.kind == BodyMotion::Fixed);
        let report = if self.moving.is_empty() {
            self.report = CouplingReport::none();
            let report = step_tool(manipulator, self.dt_s, drive, planes)?;
            if !are_fixed {
                self.trial.clone_from(&self.world);
                self.stepper.step(&mut self.trial);
            }
            report
        } else {
            let outcome = self.iterate(manipulator, drive, planes);
            for moving in &self.moving {
                planes[moving.plane].gap_m = moving.still_gap_m;
            }
            outcome?
        };
        self.note_wrenches(manipulator, planes);
        if !are_fixed {
            core::mem::swap(&mut self.world, &mut self.trial);
            self.update_bodies();
        }
        Ok(report)
    }

    /// Collects the planes on free bodies, and predicts the motion of these bodies from the last tick.
    fn collect_moving(&mut self, planes: &[ContactPlane]) {
        self.moving.clear();
        for (own, &body_index) in self.plane_body.iter().enumerate() {
            let plane = self.first_plane + own;
            let Some(contact) = planes.get(plane) else { continue };
            if self.bodies[body_index].kind == BodyMotion::Free {
                let still_gap_m = contact.gap_m;
                self.moving.push(MovingPlane { plane, body: body_index, still_gap_m, pressed: false });
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

    /// Finds the common motion. Afterwards, tool and trial world hold the result of the final evaluation.
    fn iterate(
        &mut self,
        manipulator: &mut impl ManipulatorModel,
        drive: &ToolDrive,
        planes: &mut [ContactPlane],
    ) -> Result<StepReport, ManipulatorError> {
        let start = manipulator.snapshot();
        let mut evaluations = 1;
        let (mut report, mut residual) = self.evaluate(manipulator, drive, planes)?;
        let mut best = residual;
        self.descent.keep_best();
        while residual > TOLERANCE_M_PER_S && evaluations < MAX_EVALUATIONS {
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

    /// Steps tool and trial world with the descent's motion; returns the residual and the largest plane
    /// speed, m/s.
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

    /// Computes response minus assumed motion; returns the largest difference in plane speed, m/s.
    fn residuals(&mut self, planes: &[ContactPlane]) -> f64 {
        let mut largest = 0.0f64;
        for moving in &self.moving {
            let body = &self.bodies[moving.body];
            let response = self.world.motion_to(&self.trial, body.handle, self.dt_s);
            let residual = response.plus(-1.0, &self.descent.motion[moving.body]);
            self.descent.residual[moving.body] = residual;
            let plane = &planes[moving.plane];
            let difference = residual.at(&(plane.point_m - body.centre_m)).dot(&plane.normal);
            // An unloaded plane that recedes faster than the tool assumed has no effect.
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
