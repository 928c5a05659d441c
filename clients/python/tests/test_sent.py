"""A command keeps its content once sent: later writes are refused and have no effect."""

from __future__ import annotations

from typing import Any, Callable

import numpy as np
import support
import trabecula as t
from scenes import free_space
from support import Run


def refused(call: Callable[[], Any]) -> str:
    try:
        call()
    except ValueError as error:
        return str(error)
    raise AssertionError("written")


def writes_behind_its_back() -> None:
    """Each command requests 3 N; afterwards 55 N are written in every way that Python offers."""
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


def test_a_command_that_is_written_after_it_was_sent_is_applied_and_recorded_as_sent(
    start: Callable[[str], Run],
) -> None:
    """Regression: Python's view pointed into the sent message, and 718 of 1000 ticks latched 55 N instead of
    3 N.
    """
    run = start(free_space())
    support.outside(writes_behind_its_back, session=run.session, controller="mine")
    folder = run.end()
    latched = [it["commands"][0]["command"] for it in support.messages(folder / "run.mcap", "/latched")]
    sent = support.messages(folder / "timing.mcap", "/command/mine", "tendon_force_n")
    assert len(latched) == 1000 and len(sent) >= 1000
    for commands in (latched, sent):
        others = [it["tendon_force_n"][:2] for it in commands if it["tendon_force_n"][:2] != [3.0, 0.0]]
        assert not others, (len(others), others[:3])
    support.assert_replays(folder)


if __name__ == "__main__":
    support.main(globals())
