//! The reference controller: image-guided curved drilling.
//!
//! It waits for the first frame, then feeds the tool at a constant speed with the burr on, and pulls tendon 0 along a
//! ramp of the inserted length. In each frame it finds the burr, places it in the plane in which the manipulator
//! bends, compares it with the planned path (the circular arc that leaves the insertion axis where the ramp begins and
//! ends in the target), and corrects the tension by the sideways error. At the end it may draw the tool back, the burr
//! still turning and the tension following the same ramp down, so that the tunnel shows in the last frames.

use ipc_types::messages::{ARM_MOVE_CP, BURR_SPEED, Command, Frame, Pose, State, TENDON_SERVO_JF};
use ipc_types::scene::{CurvedDrilling, Scene};
use nalgebra::Vector3;

use crate::Controller;
use crate::geometry::{back_project, position_m, rotation};
use crate::tip_finder::find_tip;

/// Burr radius of the standard manipulator (6.5 mm diameter).
const STANDARD_BURR_RADIUS_M: f64 = 3.25e-3;
/// Share of the measured error's correction that a single frame may add.
const CORRECTION_SHARE: f64 = 0.5;
/// Largest correction of the ramp's tension, either way.
const MAX_CORRECTION_N: f64 = 8.0;

/// Image-guided curved drilling.
#[derive(Debug, Clone)]
pub struct CurvedDrillingController {
    plan: CurvedDrilling,
    burr_radius_m: f64,
    waits_for_frame: bool,
    start: Option<Start>,
    correction_n: f64,
    phase: Phase,
    remark: Option<String>,
}

/// What the tool is doing.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Phase {
    /// On its way in.
    Feeding,
    /// At the end of the feed, since this simulated time.
    Arrived { since_s: f64 },
    /// On its way back.
    Retracting,
}

/// Distance to the end of the feed at which it is reached.
const ARRIVED_M: f64 = 1e-5;
/// Rest at the end of the feed: a frame or two.
const REST_S: f64 = 0.5;

/// Where the tool stood when it began.
#[derive(Debug, Clone, Copy)]
struct Start {
    t_world_flange: Pose,
    burr_m: Vector3<f64>,
    along: Vector3<f64>,
    bend: Vector3<f64>,
}

impl CurvedDrillingController {
    /// A controller for this plan in this scene.
    pub fn new(plan: &CurvedDrilling, scene: &Scene) -> CurvedDrillingController {
        CurvedDrillingController {
            plan: plan.clone(),
            burr_radius_m: scene.manipulator.burr_diameter_mm.map_or(STANDARD_BURR_RADIUS_M, |d| d * 0.5e-3),
            waits_for_frame: scene.frame_period_ticks().is_some(),
            start: None,
            correction_n: 0.0,
            phase: Phase::Feeding,
            remark: None,
        }
    }

    fn begin(&mut self, state: &State) -> Start {
        let turn = rotation(&state.t_world_flange);
        let start = Start {
            t_world_flange: state.t_world_flange,
            burr_m: position_m(&state.t_world_burr),
            along: turn * Vector3::z(),
            bend: turn * Vector3::x(),
        };
        *self.start.get_or_insert(start)
    }

    /// Depth to go to and the speed to go there.
    fn feed(&mut self, inserted_m: f64, time_s: f64) -> (f64, f64) {
        let plan = &self.plan;
        let end_m = plan.insertion_mm * 1e-3;
        let back_m = (plan.insertion_mm - plan.retraction_mm).max(0.0) * 1e-3;
        self.phase = match self.phase {
            Phase::Feeding if inserted_m >= end_m - ARRIVED_M => Phase::Arrived { since_s: time_s },
            Phase::Arrived { since_s } if plan.retraction_mm > 0.0 && time_s - since_s >= REST_S => {
                Phase::Retracting
            }
            same => same,
        };
        match self.phase {
            Phase::Retracting => (back_m, plan.retraction_mm_per_s * 1e-3),
            Phase::Feeding | Phase::Arrived { .. } => (end_m, plan.feed_mm_per_s * 1e-3),
        }
    }

    /// Tension of the ramp at an inserted length.
    fn planned_tension_n(&self, inserted_m: f64) -> f64 {
        let plan = &self.plan;
        let ramp_mm = (plan.ramp_end_mm - plan.ramp_start_mm).max(1e-9);
        let share = ((inserted_m * 1e3 - plan.ramp_start_mm) / ramp_mm).clamp(0.0, 1.0);
        plan.tension_n * share
    }

    /// Sideways place of the planned path, `along_m` from the burr's start along the insertion axis.
    fn planned_sideways_m(&self, start: &Start, along_m: f64) -> Option<f64> {
        let target = Vector3::from(self.plan.target_mm?) * 1e-3 - start.burr_m;
        let begin_m = self.plan.ramp_start_mm * 1e-3;
        let (z, x) = (target.dot(&start.along) - begin_m, target.dot(&start.bend));
        let ahead = along_m - begin_m;
        if ahead <= 0.0 || x.abs() < 1e-9 {
            return Some(0.0);
        }
        // Circle through the begin (tangent to the axis) and the target: radius (z² + x²) / 2x.
        let radius = (z * z + x * x) / (2.0 * x);
        let inside = (radius * radius - ahead * ahead).max(0.0);
        Some(radius - radius.signum() * libm::sqrt(inside))
    }

    fn correct(&mut self, start: &Start, seen_m: &Vector3<f64>) -> Option<f64> {
        if self.phase == Phase::Retracting {
            return None;
        }
        let moved = seen_m - start.burr_m;
        let planned = self.planned_sideways_m(start, moved.dot(&start.along))?;
        let error_m = planned - moved.dot(&start.bend);
        let correction = CORRECTION_SHARE * self.plan.guidance_gain_n_per_mm * error_m * 1e3;
        self.correction_n = (self.correction_n + correction).clamp(-MAX_CORRECTION_N, MAX_CORRECTION_N);
        Some(error_m)
    }
}

impl Controller for CurvedDrillingController {
    fn step(&mut self, state: &State, command: &mut Command) {
        let start = self.begin(state);
        let inserted_m =
            (position_m(&state.t_world_flange) - position_m(&start.t_world_flange)).dot(&start.along);
        command.tendon_mode = TENDON_SERVO_JF;
        let planned = self.planned_tension_n(inserted_m);
        let corrected = if planned > 0.0 { planned + self.correction_n } else { 0.0 };
        command.tendon_force_n[0] = corrected.max(0.0);
        command.burr_mode = BURR_SPEED;
        command.arm_mode = ARM_MOVE_CP;
        command.t_world_base = start.t_world_flange;
        if self.waits_for_frame {
            return;
        }
        command.burr_speed_rad_per_s = self.plan.burr_speed_rpm * core::f64::consts::TAU / 60.0;
        let (depth_m, speed_m_per_s) = self.feed(inserted_m, state.sim_time_s);
        command.arm_speed_m_per_s = speed_m_per_s;
        command.t_world_base.position_m = (position_m(&start.t_world_flange) + start.along * depth_m).into();
    }

    fn frame(&mut self, frame: &Frame, pixels: &[u16]) {
        self.waits_for_frame = false;
        let Some(start) = self.start else { return };
        // The prior is where the kinematics had the burr in the frame's own tick.
        let prior = frame.t_world_burr;
        let Some(sighting) = find_tip(&frame.geometry, pixels, &prior, self.burr_radius_m) else {
            self.remark = Some(format!("frame {}: no burr seen", frame.sequence));
            return;
        };
        let normal = start.along.cross(&start.bend);
        let Some(seen_m) = back_project(&frame.geometry, sighting.pixel, &start.burr_m, &normal) else {
            return;
        };
        let offset_mm = (seen_m - position_m(&prior)).norm() * 1e3;
        let error_m = self.correct(&start, &seen_m);
        self.remark = Some(match error_m {
            Some(error_m) => format!(
                "frame {}: burr seen {offset_mm:.2} mm from the model, {:.2} mm off the planned path, correction {:+.2} N",
                frame.sequence,
                error_m * 1e3,
                self.correction_n
            ),
            None => format!("frame {}: burr seen {offset_mm:.2} mm from the model", frame.sequence),
        });
    }

    fn remark(&mut self) -> Option<String> {
        self.remark.take()
    }
}
