"""A command is what it was when it was sent: whoever writes it afterwards is told so, and reaches nobody.

Run by the test `tests/processes/sent.rs` as the external controller of a lockstep run of 1000 ticks. Each command asks for
3 N; behind its back 55 N are written in every way that Python has.
"""

import numpy as np
import trabecula as t


def refused(call):
    try:
        call()
    except ValueError as error:
        return str(error)
    raise AssertionError("written")


with t.Client() as client:
    kept = []
    for state in client.states():
        with client.command() as command:
            command.tendon_mode = t.TENDON_SERVO_JF
            force_n = command.tendon_force_n
            force_n[0] = 3.0
            slice_n, whole, pose = force_n[:1], command.array, command.t_world_base
            position_m = pose.position_m
        # While the physics is reading it.
        slice_n[0] = 55.0
        text = refused(lambda: setattr(command, "burr_mode", 7))
        assert text == "`burr_mode` of this Command cannot be written: it has been sent", text
        refused(lambda: setattr(command, "tendon_force_n", 55.0))
        refused(lambda: setattr(command, "t_world_base", t.Pose()))
        refused(lambda: setattr(pose, "position_m", 55.0))
        refused(lambda: force_n.__setitem__(0, 55.0))
        refused(lambda: command.tendon_force_n.__setitem__(0, 55.0))
        refused(lambda: whole["tendon_force_n"].__setitem__(0, 55.0))
        refused(lambda: position_m.__setitem__(0, 55.0))
        assert command.tendon_force_n[0] == 3.0 and command.state_tick == state.tick
        assert not np.shares_memory(command.tendon_force_n, slice_n)
        # Slices of all commands so far; none may alias a later one.
        kept.append(slice_n)
        for earlier in kept[-50:]:
            earlier[0] = 55.0
print("ended")
