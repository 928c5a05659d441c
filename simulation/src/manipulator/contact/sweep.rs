//! Gauss-Seidel sweeps of the contact solver, with conjugate-gradient acceleration between them.

use super::{ContactSolver, Outcome};
use crate::manipulator::MAX_ROWS;
use crate::manipulator::articulated::{Articulated, Generalised};
use crate::manipulator::parameters::ContactParameters;
use crate::manipulator::row::{search_on, search_share};

/// [`ContactSolver::solve`], compiled for each instruction set. No operation is reordered or fused, so the result is the same to the bit.
struct Solve<'a> {
    solver: &'a mut ContactSolver,
    articulated: &'a Articulated,
    free: &'a Generalised,
    parameters: &'a ContactParameters,
}

impl pulp::WithSimd for Solve<'_> {
    type Output = Outcome;

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) -> Outcome {
        self.solver.sweep(self.articulated, self.free, self.parameters)
    }
}

impl ContactSolver {
    /// Sweeps until no row changes its velocity by more than the tolerance, or the parameters' iteration limit is reached.
    pub fn solve(
        &mut self,
        articulated: &Articulated,
        free: &Generalised,
        parameters: &ContactParameters,
    ) -> Outcome {
        self.arch.dispatch(Solve { solver: self, articulated, free, parameters })
    }

    #[inline(always)]
    fn sweep(
        &mut self,
        articulated: &Articulated,
        free: &Generalised,
        parameters: &ContactParameters,
    ) -> Outcome {
        let (max_iterations, tolerance) = (parameters.max_iterations, parameters.tolerance_m_per_s);
        let lateral = articulated.lateral;
        self.delassus.velocities(articulated, free, &mut self.velocity);
        self.lateral_velocity = free.mount[1];
        self.apply_start(lateral);
        self.velocity_direction.fill(0.0);
        self.lateral_direction = 0.0;
        let mut outcome = Outcome { iterations: 0, residual: 0.0 };
        let mut last = 0.0;
        while outcome.iterations < max_iterations {
            outcome.iterations += 1;
            outcome.residual = 0.0;
            self.keep();
            for probe in 0..self.delassus.sphere_count {
                self.relax_sphere(probe, lateral, &mut outcome.residual);
            }
            for k in 0..self.delassus.joint_count {
                self.relax_stop(k, &mut outcome.residual);
            }
            if outcome.residual <= tolerance || outcome.iterations == max_iterations {
                break;
            }
            last = self.accelerate(last);
        }
        self.accumulate();
        outcome
    }

    /// Applies the warm-start impulses to the probe velocities.
    #[inline(always)]
    fn apply_start(&mut self, lateral: f64) {
        self.accumulate();
        for row in 0..self.delassus.rows() {
            let impulse = self.impulse[row];
            if impulse != 0.0 {
                add_scaled(&mut self.velocity, impulse, self.delassus.column(row));
            }
        }
        self.lateral_velocity += lateral * self.lateral_impulse;
    }

    /// Sums the row impulses per probe.
    #[inline(always)]
    fn accumulate(&mut self) {
        let rows = self.delassus.rows();
        self.impulse[..rows].fill(0.0);
        self.lateral_impulse = 0.0;
        for row in &self.row[..self.row_count] {
            let sum = row.combined(&row.impulse);
            for j in 0..3 {
                self.impulse[3 * row.probe + j] += sum[j];
            }
            self.lateral_impulse += sum[3];
        }
        for k in 0..self.delassus.joint_count {
            self.impulse[3 * self.delassus.sphere_count + k] = self.stop[k].sign * self.stop[k].impulse;
        }
    }

    /// Saves impulses and velocities before a sweep.
    #[inline(always)]
    fn keep(&mut self) {
        for row in &mut self.row[..self.row_count] {
            row.before = row.impulse;
        }
        for stop in &mut self.stop[..self.delassus.joint_count] {
            stop.before = stop.impulse;
        }
        let rows = self.delassus.rows();
        self.velocity_before[..rows].copy_from_slice(&self.velocity[..rows]);
        self.lateral_before = self.lateral_velocity;
    }

    /// Extrapolates along the last sweeps' direction: nonsmooth nonlinear conjugate gradients on the sweep (Silcowitz, Niebe, Erleben
    /// 2010, "A nonsmooth nonlinear conjugate gradient method for interactive contact force problems", Visual Computer 26). `last` is the
    /// previous sweep's squared gradient, 0 at the start; returns this sweep's.
    #[inline(always)]
    fn accelerate(&mut self, last: f64) -> f64 {
        let mut squared = 0.0;
        for row in &self.row[..self.row_count] {
            let weight = [1.0 / row.inverse, row.tangential[0], row.tangential[2]];
            for j in 0..3 {
                let change = row.impulse[j] - row.before[j];
                squared += weight[j] * change * change;
            }
        }
        for stop in &self.stop[..self.delassus.joint_count] {
            let change = stop.impulse - stop.before;
            squared += change * change / stop.inverse;
        }
        let share = search_share(squared, last);
        for row in &mut self.row[..self.row_count] {
            for j in 0..3 {
                search_on(share, &mut row.impulse[j], row.before[j], &mut row.direction[j]);
            }
        }
        for stop in &mut self.stop[..self.delassus.joint_count] {
            search_on(share, &mut stop.impulse, stop.before, &mut stop.direction);
        }
        for k in 0..self.delassus.rows() {
            let direction = &mut self.velocity_direction[k];
            search_on(share, &mut self.velocity[k], self.velocity_before[k], direction);
        }
        search_on(share, &mut self.lateral_velocity, self.lateral_before, &mut self.lateral_direction);
        squared
    }

    /// Relaxes all contacts of one sphere probe.
    #[inline(always)]
    fn relax_sphere(&mut self, probe: usize, lateral: f64, residual: &mut f64) {
        let base = 3 * probe;
        let block = [0, 1, 2].map(|i| {
            let column = self.delassus.column(base + i);
            [column[base], column[base + 1], column[base + 2]]
        });
        let v = &self.velocity;
        let mut local = [v[base], v[base + 1], v[base + 2], self.lateral_velocity];
        let mut total = [0.0; 4];
        let (first, end) = (self.first_row[probe], self.first_row[probe + 1]);
        for row in &mut self.row[first..end] {
            let before = row.impulse;
            row.relax(&local, residual);
            let change = [0, 1, 2].map(|j| row.impulse[j] - before[j]);
            if change != [0.0; 3] {
                let step = row.combined(&change);
                for i in 0..3 {
                    total[i] += step[i];
                    for j in 0..3 {
                        local[j] += block[i][j] * step[i];
                    }
                }
                total[3] += step[3];
                local[3] += lateral * step[3];
            }
        }
        if total != [0.0; 4] {
            let [x, y, z] = [0, 1, 2].map(|i| self.delassus.column(base + i));
            for (v, ((x, y), z)) in self.velocity.iter_mut().zip(x.iter().zip(y).zip(z)) {
                *v = *v + total[0] * x + total[1] * y + total[2] * z;
            }
            self.lateral_velocity += lateral * total[3];
        }
    }

    #[inline(always)]
    fn relax_stop(&mut self, k: usize, residual: &mut f64) {
        let row = 3 * self.delassus.sphere_count + k;
        let stop = &mut self.stop[k];
        let change = stop.relax(self.velocity[row], residual);
        if change != 0.0 {
            add_scaled(&mut self.velocity, change, self.delassus.column(row));
        }
    }
}

/// velocity += scale column.
#[inline(always)]
fn add_scaled(velocity: &mut [f64; MAX_ROWS], scale: f64, column: &[f64]) {
    for (v, c) in velocity.iter_mut().zip(column) {
        *v += scale * c;
    }
}
