//! Bends the manipulator along a curve over time: a PI controller sets the tendon tension.
//!
//! All languages use the same operations in the same order, so that a lockstep run ends with the same hash.

use trabecula_client::{ClientError, Command, State, TENDON_SERVO_JF};

const PROPORTIONAL_N_PER_RAD: f64 = 6.0;
const INTEGRAL_N_PER_RAD_S: f64 = 40.0;
const TICK_S: f64 = 0.001;
const LARGEST_TENSION_N: f64 = 20.0;

/// 0 to 0.6 rad within 0.5 s and back to 0.3 rad within the next 0.5 s.
fn planned_bend_rad(time_s: f64) -> f64 {
    if time_s < 0.5 { 1.2 * time_s } else { 0.6 - 0.6 * (time_s - 0.5) }
}

fn main() -> Result<(), ClientError> {
    let mut integral_rad_s = 0.0;
    trabecula_client::run(move |state: &State, command: &mut Command| {
        let error_rad = planned_bend_rad(state.sim_time_s) - state.bend_rad;
        integral_rad_s += error_rad * TICK_S;
        let tension_n = PROPORTIONAL_N_PER_RAD * error_rad + INTEGRAL_N_PER_RAD_S * integral_rad_s;
        let tension_n = tension_n.clamp(0.0, LARGEST_TENSION_N);
        if state.tick.is_multiple_of(200) {
            let [low, high] = state.hash;
            println!(
                "tick {:4}  bend {:7.4} rad  tension {tension_n:7.4} N  hash {high:016x}{low:016x}",
                state.tick, state.bend_rad
            );
        }
        command.tendon_mode = TENDON_SERVO_JF;
        command.tendon_force_n[0] = tension_n;
    })
}
