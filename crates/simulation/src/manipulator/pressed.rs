//! Joint stops under load, treated as springs of the implicit operator.
//!
//! A stop that carried torque in the last step is assumed to carry torque in this one. Its unilateral law,
//! `torque = k dt (target - v)` toward the free range, then becomes an equation that the operator solves
//! exactly together with the flexures. With these stops as rows of the contact solver, a tool pressed against
//! all its stops takes more iterations. If a stop pulls in the solution, the step is solved again with that
//! stop as a contact row; if a flexure ends in the hard part of a stop that is not part of the solve, with
//! all stops as rows.

use super::parameters::ManipulatorParameters;

/// The pressed stops, one entry per degree of freedom.
#[derive(Debug, Clone)]
pub(super) struct PressedStops {
    /// Spring stiffness, N m/rad; 0 where no stop is pressed.
    stiffness: Vec<f64>,
    /// Torque at rest, N m.
    drive: Vec<f64>,
    any: bool,
}

impl PressedStops {
    pub fn new(freedoms: usize) -> Self {
        Self { stiffness: vec![0.0; freedoms], drive: vec![0.0; freedoms], any: false }
    }

    /// Releases all stops.
    pub fn clear(&mut self) {
        if self.any {
            self.stiffness.fill(0.0);
            self.drive.fill(0.0);
            self.any = false;
        }
    }

    /// Collects the stops that carried the torques `last` (N m), for flexures at `q` (rad).
    pub fn collect(&mut self, p: &ManipulatorParameters, dt: f64, q: &[f64], last: &[f64]) {
        self.clear();
        let law = p.stop_law();
        for i in (0..self.drive.len()).filter(|i| last[*i] != 0.0) {
            let sign = last[i].signum();
            let speed = law.target(dt, sign, q[i], last[i].abs());
            self.any = true;
            self.stiffness[i] = law.stiffness_nm_per_rad;
            self.drive[i] = sign * law.stiffness_nm_per_rad * dt * speed;
        }
    }

    /// Releases the stops that would pull at velocities `v` (rad/s); returns true if there were any.
    pub fn release(&mut self, dt: f64, v: &[f64], last: &[f64]) -> bool {
        let mut released = false;
        if self.any {
            for i in 0..self.drive.len() {
                if self.torque(dt, v, i) * last[i] < 0.0 {
                    (self.stiffness[i], self.drive[i]) = (0.0, 0.0);
                    released = true;
                }
            }
        }
        released
    }

    /// Adds to `out` the torques of the pressed stops at velocities `v`; returns how many there are.
    pub fn store(&self, dt: f64, v: &[f64], out: &mut [f64]) -> usize {
        let all = if self.any { self.drive.len() } else { 0 };
        let pressed = (0..all).filter(|i| self.has(*i));
        pressed.map(|i| out[i] += self.torque(dt, v, i)).count()
    }

    fn torque(&self, dt: f64, v: &[f64], i: usize) -> f64 {
        self.drive[i] - self.stiffness[i] * dt * v[i]
    }

    /// Returns true if the stop of coordinate `i` is pressed.
    pub fn has(&self, i: usize) -> bool {
        self.stiffness[i] != 0.0
    }

    /// Returns the spring stiffness of each stop, N m/rad.
    pub fn stiffness(&self) -> &[f64] {
        &self.stiffness
    }

    /// Returns the torque of each stop at rest, N m.
    pub fn drive(&self) -> &[f64] {
        &self.drive
    }
}
