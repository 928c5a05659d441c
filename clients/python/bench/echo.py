"""Answers states: `echo.py spin|event ROUNDS`. `trabecula-lab bench latency` measures the other side."""

import sys

import trabecula

spin, rounds = sys.argv[1] == "spin", int(sys.argv[2])
with trabecula.Client() as client:
    for _ in range(rounds):
        if spin:
            state = client.poll_state()
            while state is None:
                state = client.poll_state()
        else:
            state = client.wait_state()
        command = client.loan_command()
        command.tendon_mode = trabecula.TENDON_SERVO_JF
        command.tendon_force_n[0] = state.bend_rad
        client.send_command()
