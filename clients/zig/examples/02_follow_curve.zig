//! Bends the manipulator along a curve over time: a PI controller sets the tendon tension.
//!
//! All languages use the same operations in the same order, so that a lockstep run ends with the same hash.

const example = @import("example.zig");
const c = example.c;

const proportional_n_per_rad: f64 = 6.0;
const integral_n_per_rad_s: f64 = 40.0;
const tick_s: f64 = 0.001;
const largest_tension_n: f64 = 20.0;

/// 0 to 0.6 rad within 0.5 s and back to 0.3 rad within the next 0.5 s.
fn plannedBendRad(time_s: f64) f64 {
    return if (time_s < 0.5) 1.2 * time_s else 0.6 - 0.6 * (time_s - 0.5);
}

pub fn main() void {
    const client = example.connected();
    var integral_rad_s: f64 = 0.0;
    while (example.nextState(client)) |state| {
        const error_rad = plannedBendRad(state.sim_time_s) - state.bend_rad;
        integral_rad_s += error_rad * tick_s;
        var tension_n = proportional_n_per_rad * error_rad + integral_n_per_rad_s * integral_rad_s;
        if (tension_n < 0.0) tension_n = 0.0;
        if (tension_n > largest_tension_n) tension_n = largest_tension_n;
        if (state.tick % 200 == 0) {
            _ = c.printf("tick %4llu  bend %7.4f rad  tension %7.4f N  hash %016llx%016llx\n", state.tick, state.bend_rad, tension_n, state.hash[1], state.hash[0]);
        }
        example.sendTension(client, tension_n);
    }
    _ = example.checked(c.trb_disconnect(client));
    _ = c.fflush(null);
}
