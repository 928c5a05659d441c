//! The reference controller: curved drilling.
//!
//! It feeds the tool at constant speed with the burr on and ramps tendon 0 over the inserted length. The ramp
//! is in tension or, with a calibration, in bend up to the bend of the planned path: the circular arc that
//! leaves the insertion axis where the ramp begins and ends at the target. The lateral error against that
//! path corrects the tension. The error comes from X-ray frames, from the measured shape, or is not used at
//! all. In each frame the controller finds the burr and locates it in the manipulator's bending plane (the
//! feed waits for the first frame). At the end it can retract the tool with the burr still turning and the
//! tension following the same ramp down, so that the last frames show the tunnel.

use messages::{ArmMode, BurrMode, Command, Frame, State, TendonMode};
use nalgebra::Vector3;
use scene::{CurvedDrilling, Feedback, Scene};
use serde::{Deserialize, Serialize};

use crate::Controller;
use crate::calibration::{Calibration, CalibrationError, ReadText};
use crate::geometry::{back_project, position_m, rotation};
use crate::reset::ResetWatch;
use crate::tip_finder::find_tip;

/// Fraction of the measured error that a single frame corrects.
const CORRECTION_SHARE: f64 = 0.5;
/// Interval between corrections from the measured shape.
const SHAPE_PERIOD_S: f64 = 0.05;
/// Limit on the correction of the ramp's tension, in both directions.
const MAX_CORRECTION_N: f64 = 8.0;

/// Curved drilling.
#[derive(Debug, Clone)]
pub struct CurvedDrillingController {
    plan: CurvedDrilling,
    calibration: Option<Calibration>,
    burr_radius_m: f64,
    pub(crate) memory: Memory,
}

/// Everything that its steps change.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Memory {
    waits_for_frame: bool,
    shape_due_s: f64,
    start: Option<Start>,
    correction_n: f64,
    phase: Phase,
    reset: ResetWatch,
    remark: Option<String>,
}

/// Phase of the procedure.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
enum Phase {
    /// Advancing.
    Feeding,
    /// At the end of the feed since this simulated time.
    Arrived { since_s: f64 },
    /// Retracting.
    Retracting,
}

/// Distance from the end of the feed at which it counts as reached.
const ARRIVED_M: f64 = 1e-5;
/// Pause at the end of the feed: a frame or two.
const REST_S: f64 = 0.5;

/// Pose of the tool at the start.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
struct Start {
    flange_m: Vector3<f64>,
    burr_m: Vector3<f64>,
    along: Vector3<f64>,
    bend: Vector3<f64>,
}

impl CurvedDrillingController {
    /// Creates a controller for this plan in this scene; `read` returns the text of the calibration that the
    /// plan names.
    ///
    /// # Errors
    /// If the plan's calibration cannot be read or does not cover the bend of the arc to the target, or the
    /// target lies on the side that the tool cannot bend toward.
    pub fn new(
        plan: &CurvedDrilling,
        scene: &Scene,
        read: &ReadText,
    ) -> Result<CurvedDrillingController, CalibrationError> {
        let calibration =
            plan.calibration.as_deref().map(|path| Calibration::load(path, read)).transpose()?;
        let controller = CurvedDrillingController {
            plan: plan.clone(),
            calibration,
            burr_radius_m: scene.manipulator.radii().cutter.front_radius_m(),
            memory: Memory {
                waits_for_frame: plan.feedback == Feedback::Image && scene.frame_period_ticks().is_some(),
                shape_due_s: 0.0,
                start: None,
                correction_n: 0.0,
                phase: Phase::Feeding,
                reset: ResetWatch::default(),
                remark: None,
            },
        };
        if let Some(calibration) = &controller.calibration {
            let along = Vector3::from(scene.tool.direction).normalize();
            let toward = Vector3::from(scene.tool.bend_toward);
            let bend = (toward - along * toward.dot(&along)).normalize();
            let burr_m = Vector3::from(scene.tool.burr_start_mm) * 1e-3;
            let arc_deg = controller.arc_deg(&burr_m, &along, &bend);
            // Rounding can move a target straight ahead this far to the side.
            if arc_deg < -1e-9 {
                return Err(CalibrationError::OtherSide { wanted_deg: arc_deg });
            }
            calibration.tension_for_bend_n(arc_deg)?;
        }
        Ok(controller)
    }

    /// Returns the bend of the tip at the end of the arc to the target; 0 without a target.
    fn arc_deg(&self, burr_m: &Vector3<f64>, along: &Vector3<f64>, bend: &Vector3<f64>) -> f64 {
        let Some(target_mm) = self.plan.target_mm else { return 0.0 };
        let target = Vector3::from(target_mm) * 1e-3 - burr_m;
        let ahead = target.dot(along) - self.plan.ramp_start_mm * 1e-3;
        // The angle at the centre is twice the angle between tangent and chord.
        2.0 * libm::atan2(target.dot(bend), ahead).to_degrees()
    }

    fn begin(&mut self, state: &State) -> Start {
        let memory = &mut self.memory;
        if memory.reset.was_reset(state) {
            (memory.start, memory.phase, memory.correction_n, memory.shape_due_s) =
                (None, Phase::Feeding, 0.0, 0.0);
            memory.remark = Some("the run was reset: starting over".to_owned());
        }
        let turn = rotation(&state.t_world_base);
        let start = Start {
            flange_m: position_m(&state.t_world_flange),
            burr_m: position_m(&state.t_world_burr),
            along: turn * Vector3::z(),
            bend: turn * Vector3::x(),
        };
        *self.memory.start.get_or_insert(start)
    }

    /// Returns the target depth, and the speed to get there.
    fn feed(&mut self, inserted_m: f64, time_s: f64) -> (f64, f64) {
        let plan = &self.plan;
        let end_m = plan.insertion_mm * 1e-3;
        let back_m = (plan.insertion_mm - plan.retraction_mm).max(0.0) * 1e-3;
        self.memory.phase = match self.memory.phase {
            Phase::Feeding if inserted_m >= end_m - ARRIVED_M => Phase::Arrived { since_s: time_s },
            Phase::Arrived { since_s } if plan.retraction_mm > 0.0 && time_s - since_s >= REST_S => {
                Phase::Retracting
            }
            same => same,
        };
        match self.memory.phase {
            Phase::Retracting => (back_m, plan.retraction_mm_per_s * 1e-3),
            Phase::Feeding | Phase::Arrived { .. } => (end_m, plan.feed_mm_per_s * 1e-3),
        }
    }

    /// Returns the ramp's tension at an inserted length.
    fn planned_tension_n(&self, start: &Start, inserted_m: f64) -> f64 {
        let plan = &self.plan;
        let ramp_mm = (plan.ramp_end_mm - plan.ramp_start_mm).max(1e-9);
        let share = ((inserted_m * 1e3 - plan.ramp_start_mm) / ramp_mm).clamp(0.0, 1.0);
        match &self.calibration {
            Some(calibration) => {
                let arc_deg = self.arc_deg(&start.burr_m, &start.along, &start.bend);
                // `new` has checked that the calibration covers the end of the arc.
                calibration.tension_for_bend_n(arc_deg * share).unwrap_or(0.0)
            }
            None => plan.tension_n.unwrap_or(0.0) * share,
        }
    }

    /// Returns the lateral position of the planned path, `along_m` from the burr's start along the insertion
    /// axis.
    fn planned_sideways_m(&self, start: &Start, along_m: f64) -> Option<f64> {
        let target = Vector3::from(self.plan.target_mm?) * 1e-3 - start.burr_m;
        let begin_m = self.plan.ramp_start_mm * 1e-3;
        let (z, x) = (target.dot(&start.along) - begin_m, target.dot(&start.bend));
        let ahead = along_m - begin_m;
        if ahead <= 0.0 || x.abs() < 1e-9 {
            return Some(0.0);
        }
        // Circle through the start of the ramp (tangent to the axis) and the target: radius (z² + x²) / 2x.
        let radius = (z * z + x * x) / (2.0 * x);
        let inside = (radius * radius - ahead * ahead).max(0.0);
        Some(radius - radius.signum() * libm::sqrt(inside))
    }

    /// Corrects the tension from the tip position of the measured shape.
    fn see_shape(&mut self, start: &Start, state: &State) {
        let feeds = self.plan.feedback == Feedback::Shape && state.sim_time_s >= self.memory.shape_due_s;
        if !feeds {
            return;
        }
        self.memory.shape_due_s = state.sim_time_s + SHAPE_PERIOD_S;
        let burr_m = position_m(&state.t_world_burr);
        let ahead_m = (burr_m - start.burr_m).dot(&start.along) - self.plan.ramp_start_mm * 1e-3;
        // Before the ramp there is no tension to correct, and the error would only accumulate.
        if ahead_m > 0.0 {
            self.correct(start, &burr_m);
        }
    }

    fn correct(&mut self, start: &Start, seen_m: &Vector3<f64>) -> Option<f64> {
        if self.memory.phase == Phase::Retracting {
            return None;
        }
        let moved = seen_m - start.burr_m;
        let planned = self.planned_sideways_m(start, moved.dot(&start.along))?;
        let error_m = planned - moved.dot(&start.bend);
        let correction = CORRECTION_SHARE * self.plan.guidance_gain_n_per_mm * error_m * 1e3;
        self.memory.correction_n =
            (self.memory.correction_n + correction).clamp(-MAX_CORRECTION_N, MAX_CORRECTION_N);
        Some(error_m)
    }
}

impl Controller for CurvedDrillingController {
    fn step(&mut self, state: &State, command: &mut Command) {
        let start = self.begin(state);
        let inserted_m = (position_m(&state.t_world_flange) - start.flange_m).dot(&start.along);
        command.tendon_mode = TendonMode::ServoJf.code();
        self.see_shape(&start, state);
        let planned = self.planned_tension_n(&start, inserted_m);
        let corrected = if planned > 0.0 { planned + self.memory.correction_n } else { 0.0 };
        command.tendon_force_n[0] = corrected.max(0.0);
        command.burr_mode = BurrMode::Speed.code();
        command.arm_mode = ArmMode::Insert.code();
        command.arm_axis = start.along.into();
        command.arm_speed_m_per_s = self.plan.feed_mm_per_s * 1e-3;
        if self.memory.waits_for_frame {
            return;
        }
        command.burr_speed_rad_per_s = self.plan.burr_speed_rpm * core::f64::consts::TAU / 60.0;
        let (depth_m, speed_m_per_s) = self.feed(inserted_m, state.sim_time_s);
        command.arm_speed_m_per_s = speed_m_per_s;
        command.arm_depth_m = depth_m;
    }

    fn frame(&mut self, frame: &Frame, pixels: &[u16]) {
        if self.plan.feedback != Feedback::Image {
            return;
        }
        self.memory.waits_for_frame = false;
        let Some(start) = self.memory.start else { return };
        // The prior is the burr's pose from the kinematics at the frame's own tick.
        let prior = frame.t_world_burr;
        let Some(sighting) = find_tip(&frame.geometry, pixels, &prior, self.burr_radius_m) else {
            self.memory.remark = Some(format!("frame {}: burr not found", frame.sequence));
            return;
        };
        let normal = start.along.cross(&start.bend);
        let Some(seen_m) = back_project(&frame.geometry, sighting.pixel, &start.burr_m, &normal) else {
            return;
        };
        let offset_mm = (seen_m - position_m(&prior)).norm() * 1e3;
        let error_m = self.correct(&start, &seen_m);
        self.memory.remark = Some(match error_m {
            Some(error_m) => format!(
                "frame {}: burr found {offset_mm:.2} mm from the model, {:.2} mm off the planned path, \
                 correction {:+.2} N",
                frame.sequence,
                error_m * 1e3,
                self.memory.correction_n
            ),
            None => format!("frame {}: burr found {offset_mm:.2} mm from the model", frame.sequence),
        });
    }

    fn remark(&mut self) -> Option<String> {
        self.memory.remark.take()
    }
}
