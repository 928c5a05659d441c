//! Sweeps a tendon up and down in steps, to measure a calibration.

use messages::{ArmMode, BurrMode, Command, State, TendonMode};
use scene::{Drives, TensionSweep};
use serde::{Deserialize, Serialize};

use crate::Controller;
use crate::calibration::{Calibration, CalibrationRow};
use crate::geometry::isometry;

/// Pulls tendon 0 level by level and records the tip's pose at the end of each level.
#[derive(Debug, Clone)]
pub struct TensionSweepController {
    drives: Vec<Drives>,
    by_force: bool,
    /// Commanded levels, N or m, and whether the sweep is rising at each.
    levels: Vec<(f64, bool)>,
    settle_s: f64,
    pub(crate) memory: Memory,
}

/// Everything that its steps change.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub(crate) struct Memory {
    start_s: Option<f64>,
    calibration: Calibration,
    remark: Option<String>,
}

impl TensionSweepController {
    /// Creates a controller for this plan that drives these parts.
    pub fn new(plan: &TensionSweep, drives: &[Drives]) -> TensionSweepController {
        let force = plan.most_n.zip(plan.step_n);
        let displacement = plan.most_mm.zip(plan.step_mm).map(|(most, step)| (most * 1e-3, step * 1e-3));
        let (most, step) = force.or(displacement).unwrap_or((0.0, 1.0));
        let steps = plan.steps();
        let level = |i: usize| most.min(step * i as f64);
        let up = (0..=steps).map(|i| (level(i), true));
        let down = (0..steps).rev().map(|i| (level(i), false));
        TensionSweepController {
            drives: drives.to_vec(),
            by_force: force.is_some(),
            levels: up.chain(down).collect(),
            settle_s: plan.settle_s,
            memory: Memory::default(),
        }
    }

    /// Returns the rows recorded so far.
    pub fn calibration(&self) -> &Calibration {
        &self.memory.calibration
    }

    /// Returns whether every level has been recorded.
    pub fn is_done(&self) -> bool {
        self.memory.calibration.rows.len() == self.levels.len()
    }

    fn note(&mut self, index: usize, state: &State) {
        let (commanded, rising) = self.levels[index];
        let base = isometry(&state.t_world_base);
        let tip = base.inverse() * isometry(&state.t_world_tip);
        let rates = state.joint_velocity_rad_per_s.iter().take(state.joint_count as usize);
        let row = CalibrationRow {
            rising,
            commanded: if self.by_force { commanded } else { commanded * 1e3 },
            tension_n: state.tendon_tension_n[0],
            displacement_mm: state.tendon_displacement_m[0] * 1e3,
            bend_deg: state.bend_rad.to_degrees(),
            tip_mm: (tip.translation.vector * 1e3).into(),
            tip_rotation_deg: tip.rotation.scaled_axis().map(f64::to_degrees).into(),
            rate_deg_per_s: rates.sum::<f64>().to_degrees(),
        };
        self.memory.remark = Some(format!(
            "level {} of {}: {:.3} N, {:.3} mm, bend {:.3} deg",
            index + 1,
            self.levels.len(),
            row.tension_n,
            row.displacement_mm,
            row.bend_deg
        ));
        self.memory.calibration.rows.push(row);
    }

    /// Returns the commanded level at `time_s` after the start: a ramp during the first half of each level.
    fn commanded(&self, time_s: f64) -> f64 {
        let place = time_s / self.settle_s;
        let index = (place as usize).min(self.levels.len() - 1);
        let (level, _) = self.levels[index];
        let (before, _) = self.levels[index.saturating_sub(1)];
        before + (level - before) * (2.0 * (place - index as f64)).clamp(0.0, 1.0)
    }
}

impl Controller for TensionSweepController {
    fn step(&mut self, state: &State, command: &mut Command) {
        let time_s = state.sim_time_s - *self.memory.start_s.get_or_insert(state.sim_time_s);
        let next = self.memory.calibration.rows.len();
        // The tolerance absorbs rounding of the time and is far below a tick.
        if next < self.levels.len() && time_s >= (next + 1) as f64 * self.settle_s - 1e-9 {
            self.note(next, state);
        }
        let level = self.commanded(time_s);
        if self.drives.contains(&Drives::Tendon) {
            if self.by_force {
                command.tendon_mode = TendonMode::ServoJf.code();
                command.tendon_force_n[0] = level;
            } else {
                command.tendon_mode = TendonMode::ServoJp.code();
                // The antagonist pays out as much as tendon 0 pulls in.
                command.tendon_displacement_m[..2].copy_from_slice(&[level, -level]);
            }
        }
        if self.drives.contains(&Drives::Arm) {
            command.arm_mode = ArmMode::Hold.code();
        }
        if self.drives.contains(&Drives::Burr) {
            command.burr_mode = BurrMode::Speed.code();
        }
    }

    fn remark(&mut self) -> Option<String> {
        self.memory.remark.take()
    }
}
