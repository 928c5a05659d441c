"""Holds 5 N on tendon 0 and prints the tip position."""

import trabecula

with trabecula.Client() as client:
    for state in client.states():
        if state.tick % 200 == 0:
            x, y, z = state.t_world_tip.position_m * 1e3
            print(f"tick {state.tick:4}  tip {x:8.3f} {y:8.3f} {z:8.3f} mm")
        with client.command() as command:
            command.tendon_mode = trabecula.TendonMode.SERVO_JF
            command.tendon_force_n[0] = 5.0
