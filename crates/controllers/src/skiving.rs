//! The skiving test: a straight feed with the burr on, measuring how far the burr drifts off its line.

use messages::{ArmMode, BurrMode, Command, State, TendonMode};
use nalgebra::Vector3;
use scene::Skiving;
use serde::{Deserialize, Serialize};

use crate::Controller;
use crate::geometry::{position_m, rotation};
use crate::reset::ResetWatch;

/// Depth between points.
const REPORT_M: f64 = 1e-3;

/// Position of the burr relative to the line of the feed.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct SkivingPoint {
    /// Feed of the tool's base.
    pub depth_m: f64,
    /// Burr's distance from the line, toward the side that tendon 0 bends to.
    pub toward_bend_m: f64,
    /// Burr's distance from the line, perpendicular to the bending direction.
    pub across_m: f64,
}

/// Feeds straight ahead and records the drift.
#[derive(Debug, Clone)]
pub struct SkivingController {
    plan: Skiving,
    pub(crate) memory: Memory,
}

/// Everything that its steps change.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub(crate) struct Memory {
    start: Option<Start>,
    points: Vec<SkivingPoint>,
    reset: ResetWatch,
    remark: Option<String>,
}

#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
struct Start {
    flange_m: Vector3<f64>,
    burr_m: Vector3<f64>,
    bend: Vector3<f64>,
    across: Vector3<f64>,
    along: Vector3<f64>,
}

impl SkivingController {
    /// Creates a controller for this plan.
    pub fn new(plan: &Skiving) -> SkivingController {
        SkivingController { plan: plan.clone(), memory: Memory::default() }
    }

    /// Returns the points so far: one per millimetre, and one at the end.
    pub fn points(&self) -> &[SkivingPoint] {
        &self.memory.points
    }

    fn look(&mut self, start: &Start, state: &State) {
        let depth_m = (position_m(&state.t_world_flange) - start.flange_m).dot(&start.along);
        let end_m = self.plan.depth_mm * 1e-3;
        let due_m = (self.memory.points.len() as f64 * REPORT_M).min(end_m);
        let reported_m = self.memory.points.last().map_or(-1.0, |point| point.depth_m);
        // The tolerance of a nanometre covers rounding: the arm reaches its end exactly otherwise.
        if depth_m < due_m - 1e-9 || reported_m >= end_m - 1e-9 {
            return;
        }
        let off = position_m(&state.t_world_burr) - start.burr_m;
        let point =
            SkivingPoint { depth_m, toward_bend_m: off.dot(&start.bend), across_m: off.dot(&start.across) };
        self.memory.points.push(point);
        self.memory.remark = Some(format!(
            "skiving: at {:.2} mm the burr is {:+.3} mm off its line toward the bend, {:+.3} mm across; bend \
             {:+.2} deg, force {:.2} N",
            depth_m * 1e3,
            point.toward_bend_m * 1e3,
            point.across_m * 1e3,
            state.bend_rad.to_degrees(),
            state.burr_force_n
        ));
    }
}

impl Controller for SkivingController {
    fn step(&mut self, state: &State, command: &mut Command) {
        let turn = rotation(&state.t_world_base);
        let begin = Start {
            flange_m: position_m(&state.t_world_flange),
            burr_m: position_m(&state.t_world_burr),
            bend: turn * Vector3::x(),
            across: turn * Vector3::y(),
            along: turn * Vector3::z(),
        };
        if self.memory.reset.was_reset(state) {
            (self.memory.start, self.memory.points) = (None, Vec::new());
        }
        let start = *self.memory.start.get_or_insert(begin);
        self.look(&start, state);
        command.tendon_mode = TendonMode::ServoJf.code();
        command.tendon_force_n[..2].fill(self.plan.tension_n);
        command.burr_mode = BurrMode::Speed.code();
        command.burr_speed_rad_per_s = self.plan.burr_speed_rpm * core::f64::consts::TAU / 60.0;
        command.arm_mode = ArmMode::Insert.code();
        command.arm_axis = start.along.into();
        command.arm_depth_m = self.plan.depth_mm * 1e-3;
        command.arm_speed_m_per_s = self.plan.feed_mm_per_s * 1e-3;
    }

    fn remark(&mut self) -> Option<String> {
        self.memory.remark.take()
    }
}
