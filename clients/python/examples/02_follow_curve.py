"""Bends the manipulator along a curve over time: a PI controller sets the tendon tension.

All languages use the same operations in the same order, so that a lockstep run ends with the same hash.
"""

import trabecula

PROPORTIONAL_N_PER_RAD = 6.0
INTEGRAL_N_PER_RAD_S = 40.0
TICK_S = 0.001
LARGEST_TENSION_N = 20.0


def planned_bend_rad(time_s: float) -> float:
    """0 to 0.6 rad within 0.5 s and back to 0.3 rad within the next 0.5 s."""
    return 1.2 * time_s if time_s < 0.5 else 0.6 - 0.6 * (time_s - 0.5)


integral_rad_s = 0.0
with trabecula.Client() as client:
    for state in client.states():
        error_rad = planned_bend_rad(state.sim_time_s) - state.bend_rad
        integral_rad_s += error_rad * TICK_S
        tension_n = PROPORTIONAL_N_PER_RAD * error_rad + INTEGRAL_N_PER_RAD_S * integral_rad_s
        tension_n = min(max(tension_n, 0.0), LARGEST_TENSION_N)
        if state.tick % 200 == 0:
            low, high = state.hash
            print(
                f"tick {state.tick:4}  bend {state.bend_rad:7.4f} rad  tension {tension_n:7.4f} N  "
                f"hash {high:016x}{low:016x}"
            )
        with client.command() as command:
            command.tendon_mode = trabecula.TendonMode.SERVO_JF
            command.tendon_force_n[0] = tension_n
