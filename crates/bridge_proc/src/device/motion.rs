//! The core: turns events into the command that answers each state. Has no clock and opens nothing.

use ipc_types::messages::{
    ArmMode, BurrMode, Command, MAX_BURR_SPEED_RAD_PER_S, MAX_DISPLACEMENT_RATE_M_PER_S, MAX_POSITION_M,
    MAX_TENDONS, State, TendonMode,
};
use ipc_types::scene::Drives;
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use ros_interface::robot::isometry;

use super::event::{EV_SYN, InputEvent, SYN_DROPPED};
use super::input::Input;
use super::mapping::{Mapping, MotionFrame, Output};

/// How long a rate holds without a sign of its source: an event of a relative axis, or the device itself for
/// anything else.
const RATE_HOLDS_S: f64 = 0.1;
/// How far the goal may be ahead of the arm: an arm that cannot follow is not given a goal far away.
const LEAD_M: f64 = 0.01;
/// The same for the angle.
const LEAD_RAD: f64 = 0.2;
/// A goal this many leads away is not the arm's any more: another program moved it.
const LOST_LEADS: f64 = 2.0;

/// The state of a device's inputs, and what it moves.
#[derive(Debug)]
pub(crate) struct DeviceMotion {
    mapping: Mapping,
    drives: Vec<Drives>,
    /// Axes of the X-ray image in the world.
    world_from_c_arm: UnitQuaternion<f64>,
    /// Newest value of the input of each of the mapping's drives.
    values: Vec<InputValue>,
    /// Time of the newest sign of life of the device.
    alive_s: f64,
    /// The clutch is held, and nothing has stopped the motion since it was pressed.
    engaged: bool,
    /// It was engaged before: until then this controller leaves everything as it is.
    begun: bool,
    goal: Option<Isometry3<f64>>,
    /// The tool's base on the flange, without deflections: that of the first state.
    t_flange_base: Option<Isometry3<f64>>,
    sim_time_s: Option<f64>,
}

#[derive(Debug, Clone, Copy, Default)]
struct InputValue {
    value: Option<f64>,
    changed_s: f64,
}

/// Rates of all parts.
#[derive(Debug, Default, PartialEq)]
struct Rates {
    /// Velocity of the burr, in the mapping's frame.
    linear_m_per_s: Vector3<f64>,
    /// Angular velocity of the tool, in the mapping's frame.
    angular_rad_per_s: Vector3<f64>,
    tendon_m_per_s: [f64; MAX_TENDONS],
    burr_rad_per_s: f64,
}

impl DeviceMotion {
    /// `drives`: what the scene lets this controller drive; the rest of the mapping moves nothing.
    pub(crate) fn new(mapping: Mapping, drives: &[Drives]) -> DeviceMotion {
        let uses = |part: Drives| {
            let of_part = |output| match output {
                Output::Along(_) | Output::About(_) => part == Drives::Arm,
                Output::Tendon(_) => part == Drives::Tendon,
                Output::Burr => part == Drives::Burr,
            };
            mapping.drives.iter().any(|drive| of_part(drive.output))
        };
        DeviceMotion {
            drives: drives.iter().copied().filter(|part| uses(*part)).collect(),
            world_from_c_arm: UnitQuaternion::identity(),
            values: vec![InputValue::default(); mapping.drives.len()],
            alive_s: 0.0,
            engaged: false,
            begun: false,
            goal: None,
            t_flange_base: None,
            sim_time_s: None,
            mapping,
        }
    }

    /// Returns the parts that the device moves: both mapped and assigned to this controller.
    pub(crate) fn drives(&self) -> &[Drives] {
        &self.drives
    }

    /// Returns whether the motion depends on the C-arm's orientation.
    pub(crate) fn follows_c_arm(&self) -> bool {
        self.mapping.frame == MotionFrame::CArm
    }

    /// Sets the orientation of the X-ray image: unit vectors along its rows and down its columns.
    pub(crate) fn turn_c_arm(&mut self, row_axis: [f64; 3], column_axis: [f64; 3]) {
        let (row, column) = (Vector3::from(row_axis), Vector3::from(column_axis));
        let axes = nalgebra::Matrix3::from_columns(&[row, column, row.cross(&column)]);
        self.world_from_c_arm = UnitQuaternion::from_matrix(&axes);
    }

    /// Registers that the device is still there, at a time on the clock of [`DeviceMotion::fill`].
    pub(crate) fn alive(&mut self, now_s: f64) {
        self.alive_s = now_s;
    }

    /// Ends all motion until the clutch is pressed again.
    pub(crate) fn release(&mut self) {
        self.engaged = false;
        self.goal = None;
        for (value, drive) in self.values.iter_mut().zip(&self.mapping.drives) {
            if drive.toggle {
                *value = InputValue::default();
            }
        }
    }

    /// Takes an event that arrived at a time.
    pub(crate) fn take(&mut self, event: &InputEvent, now_s: f64) {
        if (event.kind, event.code) == (EV_SYN, SYN_DROPPED) {
            // Which inputs have changed is unknown.
            self.values.fill(InputValue::default());
            return self.release();
        }
        let Some(input) = Input::of(event) else { return };
        let is_button = matches!(input, Input::Button(_));
        if is_button && event.value > 1 {
            return; // Repeated by the keyboard.
        }
        let pressed = event.value == 1;
        if self.mapping.halt == Some(input) && pressed {
            self.release();
        }
        if self.mapping.clutch == input {
            match pressed {
                true => (self.engaged, self.begun) = (true, true),
                false => self.release(),
            }
        }
        let engaged = self.engaged;
        let of_input = self.values.iter_mut().zip(&self.mapping.drives).filter(|(_, it)| it.input == input);
        for (slot, drive) in of_input {
            let value = match drive.toggle {
                false => f64::from(event.value),
                true if pressed && engaged => 1.0 - slot.value.unwrap_or(0.0),
                true => continue,
            };
            *slot = InputValue { value: Some(value), changed_s: now_s };
        }
    }

    /// Fills in the command for a state, at a time.
    pub(crate) fn fill(&mut self, state: &State, now_s: f64, command: &mut Command) {
        let passed_s = self.sim_time_s.map_or(0.0, |before| state.sim_time_s - before);
        self.sim_time_s = Some(state.sim_time_s);
        let flange = isometry(&state.t_world_flange);
        let t_flange_base =
            *self.t_flange_base.get_or_insert_with(|| flange.inverse() * isometry(&state.t_world_base));
        // After a gap the safe command may have stopped everything; nothing starts again by itself.
        if now_s - self.alive_s > RATE_HOLDS_S || passed_s > RATE_HOLDS_S {
            self.release();
        }
        let rates = self.rates(now_s);
        if self.begun && self.drives.contains(&Drives::Arm) {
            self.move_goal(state, &(flange * t_flange_base), &rates, passed_s.max(0.0));
        }
        // A lost goal has just stopped everything.
        let rates = if self.engaged { rates } else { Rates::default() };
        self.put(&rates, state.tendon_count as usize, command);
    }

    /// Moves the arm's goal by the rates. `base` is the tool's base without its deflection.
    fn move_goal(&mut self, state: &State, base: &Isometry3<f64>, rates: &Rates, passed_s: f64) {
        let is_still =
            rates.linear_m_per_s == Vector3::zeros() && rates.angular_rad_per_s == Vector3::zeros();
        if !self.engaged || (is_still && self.goal.is_none()) {
            self.goal = None;
            return;
        }
        let goal = *self.goal.get_or_insert(*base);
        if lead(&goal, base) > LOST_LEADS {
            return self.release();
        }
        let world_from_frame = match self.mapping.frame {
            MotionFrame::Tool => goal.rotation,
            MotionFrame::Patient => UnitQuaternion::identity(),
            MotionFrame::CArm => self.world_from_c_arm,
        };
        let turn = UnitQuaternion::from_scaled_axis(world_from_frame * rates.angular_rad_per_s * passed_s);
        // The burr as seen from the base: the point about which the tool turns.
        let t_base_burr = isometry(&state.t_world_base).inverse() * isometry(&state.t_world_burr);
        let arm_m = goal.rotation * t_base_burr.translation.vector;
        let shift_m = world_from_frame * rates.linear_m_per_s * passed_s + arm_m - turn * arm_m;
        let moved = Isometry3::from_parts(
            Translation3::from(goal.translation.vector + shift_m),
            UnitQuaternion::new_normalize((turn * goal.rotation).into_inner()),
        );
        let ahead = lead(&moved, base);
        let in_range = moved.translation.vector.iter().all(|part| part.abs() <= MAX_POSITION_M);
        if in_range && (ahead <= 1.0 || ahead < lead(&goal, base)) {
            self.goal = Some(moved);
        }
    }

    /// Returns the rates that the inputs ask for, whether the clutch is held or not.
    fn rates(&self, now_s: f64) -> Rates {
        let mut rates = Rates::default();
        for (slot, drive) in self.values.iter().zip(&self.mapping.drives) {
            let Some(value) = slot.value else { continue };
            // The kernel does not report that a relative axis is at rest.
            if matches!(drive.input, Input::Relative(_)) && now_s - slot.changed_s > RATE_HOLDS_S {
                continue;
            }
            let rate = drive.rate_at(value);
            match drive.output {
                Output::Along(axis) => rates.linear_m_per_s[axis] += rate,
                Output::About(axis) => rates.angular_rad_per_s[axis] += rate,
                Output::Tendon(tendon) => rates.tendon_m_per_s[tendon] += rate,
                Output::Burr => rates.burr_rad_per_s += rate,
            }
        }
        rates
    }

    /// Writes goal and rates of the driven parts into a command.
    fn put(&self, rates: &Rates, tendon_count: usize, command: &mut Command) {
        if !self.begun {
            return;
        }
        if self.drives.contains(&Drives::Arm) {
            command.arm_mode = ArmMode::Hold.code();
            if let Some(goal) = &self.goal {
                command.arm_mode = ArmMode::ServoCp.code();
                let [x, y, z, w] = [goal.rotation.i, goal.rotation.j, goal.rotation.k, goal.rotation.w];
                command.t_world_base.position_m = goal.translation.vector.into();
                command.t_world_base.orientation_xyzw = [x, y, z, w];
            }
        }
        if self.drives.contains(&Drives::Tendon) {
            command.tendon_mode = TendonMode::ServoJv.code();
            let most = MAX_DISPLACEMENT_RATE_M_PER_S;
            let used =
                command.tendon_velocity_m_per_s.iter_mut().zip(rates.tendon_m_per_s).take(tendon_count);
            used.for_each(|(rate, wanted)| *rate = wanted.clamp(-most, most));
        }
        if self.drives.contains(&Drives::Burr) {
            command.burr_mode = BurrMode::Speed.code();
            command.burr_speed_rad_per_s = rates.burr_rad_per_s.clamp(0.0, MAX_BURR_SPEED_RAD_PER_S);
        }
    }
}

/// Returns how far a goal is ahead of the arm, as a share of what it may be.
fn lead(goal: &Isometry3<f64>, base: &Isometry3<f64>) -> f64 {
    let distance_m = (goal.translation.vector - base.translation.vector).norm();
    (distance_m / LEAD_M).max(goal.rotation.angle_to(&base.rotation) / LEAD_RAD)
}

#[cfg(test)]
mod tests;
