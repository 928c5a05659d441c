//! Twist of the drive shaft between motor and burr.
//!
//! The shaft is a torsion spring `k = G J / length`, whose wind-up `phi` is the angle by which the motor
//! leads the burr; its inertia is neglected. The burr of inertia J turns at w, the motor at w_m; M is the
//! torque of cutting and shaft friction:
//!
//! ```text
//! phi' = w_m - w        J w' = k phi + c phi' - M sign(w)
//! w_m = w_0 (1 - k phi / M_s), or w_0 without a stall torque M_s
//! ```
//!
//! In steady state, `phi = M / k` and `w = w_0 (1 - M / M_s)`; without a stall torque, the burr oscillates
//! about it at `sqrt(k/J)`. The motor never turns backward. Like dry friction, M also holds a burr that has
//! stopped. Between stopping and starting events the equations are linear and are solved in closed form, even
//! for shafts that oscillate many times per tick.

use nalgebra::{Matrix2, Vector2};
use serde::{Deserialize, Serialize};

/// Number of substeps per tick; the burr and the motor can stop or start at their ends.
const PIECES: usize = 16;

/// A compliant drive shaft.
#[derive(Debug, Clone, Copy)]
pub(super) struct Torsion {
    /// Torsional stiffness, N m/rad.
    pub stiffness_nm_per_rad: f64,
    /// Torsional damping, N m s/rad.
    pub damping_nms_per_rad: f64,
    /// Inertia of the burr about its axis, kg m^2.
    pub inertia_kg_m2: f64,
}

/// State of the shaft.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct TorsionState {
    /// Angle by which the motor leads the burr, rad.
    pub wind_up_rad: f64,
    /// Speed of the burr, rad/s.
    pub speed_rad_per_s: f64,
    /// Whether the motor is stalled.
    pub is_stalled: bool,
}

/// Torques and commanded speed during a tick.
#[derive(Debug, Clone, Copy)]
pub(super) struct Load {
    /// Commanded speed of the motor, rad/s.
    pub command_rad_per_s: f64,
    /// Stall torque of the motor, N m.
    pub stall_torque_nm: Option<f64>,
    /// Torque that brakes the burr, N m.
    pub brake_nm: f64,
}

/// Speed of the motor in a substep: `speed - slope phi`.
struct Motor {
    speed_rad_per_s: f64,
    slope_per_s: f64,
}

impl Torsion {
    /// Turns the burr for `time_s` and returns its mean speed, rad/s.
    pub fn turn(&self, state: &mut TorsionState, load: &Load, time_s: f64) -> f64 {
        // The equations assume one sense of rotation, that of the command.
        let sense = if load.command_rad_per_s < 0.0 { -1.0 } else { 1.0 };
        let mut now = Vector2::new(state.wind_up_rad, state.speed_rad_per_s) * sense;
        let piece_s = time_s / PIECES as f64;
        let mut turned_rad = 0.0;
        for _ in 0..PIECES {
            let motor = self.motor(now.x, load);
            let drive_nm = self.stiffness_nm_per_rad * now.x;
            if now.y == 0.0 && drive_nm.abs() <= load.brake_nm {
                now.x = wound(now.x, &motor, piece_s);
                continue;
            }
            let forward = if now.y == 0.0 { drive_nm.signum() } else { now.y.signum() };
            let (mut after, angle_rad) = self.flow(&now, &motor, load.brake_nm * forward, piece_s);
            if load.brake_nm > 0.0 && after.y * forward < 0.0 {
                after.y = 0.0;
                turned_rad += if angle_rad * forward > 0.0 { angle_rad } else { 0.0 };
            } else {
                turned_rad += angle_rad;
            }
            now = after;
        }
        (state.wind_up_rad, state.speed_rad_per_s) = (sense * now.x, sense * now.y);
        let turns = load.command_rad_per_s != 0.0;
        state.is_stalled = turns && load.stall_torque_nm.is_some_and(|stall_nm| load.brake_nm >= stall_nm);
        sense * turned_rad / time_s
    }

    fn motor(&self, wind_up_rad: f64, load: &Load) -> Motor {
        let speed_rad_per_s = load.command_rad_per_s.abs();
        match load.stall_torque_nm {
            None => Motor { speed_rad_per_s, slope_per_s: 0.0 },
            Some(stall_nm) if self.stiffness_nm_per_rad * wind_up_rad > stall_nm => {
                Motor { speed_rad_per_s: 0.0, slope_per_s: 0.0 }
            }
            Some(stall_nm) => {
                let slope_per_s = speed_rad_per_s * self.stiffness_nm_per_rad / stall_nm;
                Motor { speed_rad_per_s, slope_per_s }
            }
        }
    }

    /// Returns the wind-up and speed of a turning burr after `time_s` under a constant braking torque, and
    /// the angle it has turned: `x = x* + exp(A t) (x_0 - x*)`, `int x = x* t + A^-1 (x - x_0)`.
    fn flow(&self, now: &Vector2<f64>, motor: &Motor, brake_nm: f64, time_s: f64) -> (Vector2<f64>, f64) {
        let (k, c, j) = (self.stiffness_nm_per_rad, self.damping_nms_per_rad, self.inertia_kg_m2);
        let slope = motor.slope_per_s;
        let rest_rad = brake_nm / k;
        let rest = Vector2::new(rest_rad, motor.speed_rad_per_s - slope * rest_rad);
        let a = Matrix2::new(-slope, -1.0, (k - c * slope) / j, -c / j);
        let after = rest + exponential(&a, k / j, time_s) * (now - rest);
        let change = after - now;
        // Second row of the inverse; the determinant is k / J.
        let angle_rad = rest.y * time_s - ((k - c * slope) / j * change.x + slope * change.y) / (k / j);
        (after, angle_rad)
    }
}

/// Returns the wind-up after `time_s` with a stationary burr.
fn wound(wind_up_rad: f64, motor: &Motor, time_s: f64) -> f64 {
    if motor.slope_per_s == 0.0 {
        return wind_up_rad + motor.speed_rad_per_s * time_s;
    }
    let end_rad = motor.speed_rad_per_s / motor.slope_per_s;
    end_rad + (wind_up_rad - end_rad) * libm::exp(-motor.slope_per_s * time_s)
}

/// Returns `exp(A t)` of a 2 x 2 matrix whose eigenvalues, `m +- sqrt(m^2 - det)`, are stable.
fn exponential(a: &Matrix2<f64>, determinant: f64, time_s: f64) -> Matrix2<f64> {
    let mean = 0.5 * (a.m11 + a.m22);
    let squared = mean * mean - determinant;
    let decay = libm::exp(mean * time_s);
    let (even, odd) = if squared.abs() * time_s * time_s < 1e-12 {
        (decay, decay * time_s)
    } else if squared < 0.0 {
        let w = libm::sqrt(-squared);
        (decay * libm::cos(w * time_s), decay * libm::sin(w * time_s) / w)
    } else {
        let r = libm::sqrt(squared);
        let [fast, slow] = [mean - r, mean + r].map(|rate| libm::exp(rate * time_s));
        (0.5 * (slow + fast), 0.5 * (slow - fast) / r)
    };
    Matrix2::identity() * (even - odd * mean) + a * odd
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a hollow steel shaft of 0.2 m with a 4 mm steel ball.
    fn torsion(damping: f64) -> Torsion {
        let (k, j) = (2e-3 / 0.2, 4e-10);
        Torsion {
            stiffness_nm_per_rad: k,
            damping_nms_per_rad: 2.0 * damping * f64::sqrt(k * j),
            inertia_kg_m2: j,
        }
    }

    fn load(brake_nm: f64, stall_torque_nm: Option<f64>) -> Load {
        Load { command_rad_per_s: 800.0, stall_torque_nm, brake_nm }
    }

    fn turning() -> TorsionState {
        TorsionState { speed_rad_per_s: 800.0, ..TorsionState::default() }
    }

    /// The wind-up is T L / (G J) in either direction, and the speed is on the motor's line.
    #[test]
    fn a_constant_torque_winds_the_shaft_up_by_t_l_over_gj() {
        for sense in [1.0, -1.0] {
            for stall_nm in [None, Some(8e-3)] {
                let (torsion, mut state) = (torsion(0.2), TorsionState::default());
                let load = Load { command_rad_per_s: sense * 800.0, ..load(2e-3, stall_nm) };
                let mean = (0..400).map(|_| torsion.turn(&mut state, &load, 1e-3)).last().unwrap_or(0.0);
                let expected_rad = sense * 2e-3 * 0.2 / 2e-3;
                let speed = sense * 800.0 * stall_nm.map_or(1.0, |stall| 1.0 - 2e-3 / stall);
                println!(
                    "{stall_nm:?}: {:.9} rad, T L/GJ {expected_rad}, {mean:.6} rad/s",
                    state.wind_up_rad
                );
                assert!((state.wind_up_rad / expected_rad - 1.0).abs() < 1e-6, "{state:?}");
                assert!((mean / speed - 1.0).abs() < 1e-6, "{mean} {speed}");
            }
        }
    }

    /// `w - w_0 = -(T / sqrt(k J)) sin(sqrt(k/J) t)`: the response to a torque step on an undamped shaft over
    /// ten periods, and its period.
    #[test]
    fn a_step_of_torque_makes_the_burr_oscillate_at_the_root_of_k_over_j() {
        let (torsion, mut state, brake_nm) = (torsion(0.0), turning(), 5e-4);
        let (k, j) = (torsion.stiffness_nm_per_rad, torsion.inertia_kg_m2);
        let (w, swing) = (f64::sqrt(k / j), brake_nm / f64::sqrt(k * j));
        let (dt_s, mut before, mut crossings) = (1e-5, 0.0, Vec::new());
        for tick in 1..=1300 {
            torsion.turn(&mut state, &load(brake_nm, None), dt_s);
            let (t, off) = (f64::from(tick) * dt_s, state.speed_rad_per_s - 800.0);
            assert!((off + swing * f64::sin(w * t)).abs() < 1e-9 * 800.0, "{t}: {off}");
            if before < 0.0 && off >= 0.0 {
                crossings.push(t - dt_s * off / (off - before));
            }
            before = off;
        }
        let (first, last) = (crossings[0], crossings[crossings.len() - 1]);
        let (period_s, expected_s) =
            ((last - first) / (crossings.len() - 1) as f64, core::f64::consts::TAU / w);
        println!("period {period_s:.9} s, 2 pi sqrt(J/k) {expected_s:.9} s");
        assert!((period_s / expected_s - 1.0).abs() < 1e-4);
    }

    /// The angle turned in a tick equals that of 100 ticks of a hundredth the length.
    #[test]
    fn a_tick_is_as_good_as_a_hundred() {
        let torsion = torsion(0.05);
        let (mut whole, mut fine) = (turning(), turning());
        for tick in 0..50 {
            let load = load(if tick % 10 < 5 { 1e-3 } else { 3e-4 }, Some(8e-3));
            let mean = torsion.turn(&mut whole, &load, 1e-3);
            let sum: f64 = (0..100).map(|_| torsion.turn(&mut fine, &load, 1e-5)).sum();
            assert!((mean - sum / 100.0).abs() < 1e-7, "{tick}: {mean} {sum}");
        }
        assert!((whole.wind_up_rad - fine.wind_up_rad).abs() < 1e-9);
    }

    /// Just below the stall torque, the burr eventually turns; at and above it, it stays stalled, wound up by
    /// that torque.
    #[test]
    fn the_motor_stands_at_its_stall_torque_and_not_below() {
        for (share, stands) in [(0.99, false), (1.0, true), (1.5, true)] {
            let (torsion, mut state, stall_nm) = (torsion(0.2), turning(), 8e-3);
            let load = load(share * stall_nm, Some(stall_nm));
            let mean = (0..2000).map(|_| torsion.turn(&mut state, &load, 1e-3)).last().unwrap_or(0.0);
            assert_eq!((state.is_stalled, mean == 0.0), (stands, stands), "{share}: {mean} rad/s");
            let expected_rad = share.min(1.0) * stall_nm / torsion.stiffness_nm_per_rad;
            assert!((state.wind_up_rad / expected_rad - 1.0).abs() < 1e-3, "{share}: {state:?}");
        }
    }
}
