"""Holds 5 N on tendon 0 and prints the sensor readings (scene: configs/examples/sensors.toml with an external
controller).
"""

import trabecula

with trabecula.Client() as client:
    for state in client.states():
        for reading in client.readings():
            if reading.sample_tick % 200 == 0:
                age = reading.tick - reading.sample_tick
                values = " ".join(f"{value:8.4f}" for value in reading.value) if reading.valid else "nothing"
                print(f"tick {reading.tick:4}  {reading.kind.name.lower():12} {age:2} ticks old: {values}")
        with client.command() as command:
            command.tendon_mode = trabecula.TendonMode.SERVO_JF
            command.tendon_force_n[0] = 5.0
