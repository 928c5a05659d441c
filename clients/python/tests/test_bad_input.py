"""Faulty clients: each defect is refused by name, and the run continues."""

from __future__ import annotations

import ctypes
import math
import os
import signal
import subprocess
import sys
import time
from typing import Any, Callable

import numpy as np
import support
import trabecula as t
from scenes import shared
from support import LIMIT_S, Run
from trabecula import _client, _generated


def refusal(call: Callable[[], Any]) -> t.Error:
    """Returns the error that a call must raise."""
    try:
        call()
    except t.Error as error:
        return error
    raise AssertionError("not refused")


def wait_for_events(client: t.Client, *words: str) -> list[str]:
    """Waits until each of the words has occurred in the text of an event; returns the texts."""
    texts: list[str] = []
    deadline = time.monotonic() + LIMIT_S
    while not all(any(word in text for text in texts) for word in words):
        assert time.monotonic() < deadline, (words, texts)
        texts += [event.text for event in client.events()]
        time.sleep(0.01)
    return texts


def answer(client: t.Client, change: Callable[[Any], Any] = lambda command: None) -> None:
    """Answers the newest state with a valid command, optionally modified."""
    client.wait_state(LIMIT_S)
    with client.command() as command:
        command.tendon_mode = t.TENDON_SERVO_JF
        command.tendon_force_n[0] = 4.0
        change(command)


def applied(client: t.Client, wanted: Callable[[t.State], Any]) -> t.State:
    """Answers until a state meets a condition."""
    deadline = time.monotonic() + LIMIT_S
    while True:
        state = client.wait_state(LIMIT_S)
        if wanted(state):
            return state.copy()
        assert time.monotonic() < deadline, state
        answer(client)


def die_with_a_command_begun() -> None:
    client = t.Client(controller="pilot")
    client.wait_state(LIMIT_S)
    client.loan_command()
    print("begun", flush=True)
    os.kill(os.getpid(), signal.SIGKILL)


def layouts_and_names_and_handles() -> None:
    """Layouts, names and handles of another version are refused by name; needs a run."""
    # Another layout, and a missing one.
    handle = ctypes.c_uint64()
    state_layout = next(pair for pair in _generated.LAYOUTS.split(";") if pair.startswith("State="))
    for layouts, words in [
        (_generated.LAYOUTS.replace(state_layout, "State=0123456789abcdef"), ["State", "0123456789abcdef"]),
        ("", ["no such message"]),
        # All messages match, but the library has other functions.
        (_generated.LAYOUTS.rsplit(";", 1)[0], ["Abi"]),
    ]:
        status = _client._library.trb_connect(layouts.encode(), None, b"pilot", 1.0, ctypes.byref(handle))
        text = _client._library.trb_last_error().decode()
        assert status == t.ERROR_VERSION and all(word in text for word in words), (status, text)

    # Every code has a name, and nothing else is exported.
    assert (t.ARM_SERVO_JV, t.ARM_INSERT, t.ARM_RCM, t.ARM_FAULT, t.MAX_DEPTH_M) == (6, 7, 8, 2, 0.5)
    assert not {"np", "ctypes", "field", "nested"} & set(t.__all__) and {"Client", "ARM_INSERT"} <= set(
        t.__all__
    )

    # Null pointers and invalid handles.
    assert _client._library.trb_connect(_generated.LAYOUTS.encode(), None, None, 1.0, None) == t.ERROR_NULL
    assert _client._library.trb_send_command(0) == t.ERROR_HANDLE
    assert _client._library.trb_send_command(12345) == t.ERROR_HANDLE
    assert _client._library.trb_wait_state(1, math.nan, ctypes.byref(handle)) == t.ERROR_ARGUMENT


def every_defect() -> None:
    """Runs as the controllers `pilot` and `holder` of a run in real time; ends the run."""
    layouts_and_names_and_handles()
    client = t.Client(controller="pilot")
    client.events()
    assert client.info.controller == "pilot" and not client.info.lockstep

    # Connecting twice, without a name, without a command.
    error = refusal(lambda: t.Client(controller="pilot"))
    assert error.status == t.ERROR_TAKEN and "`pilot` is already connected" in str(error), error
    error = refusal(lambda: t.Client(controller="nobody"))
    assert error.status == t.ERROR_CONTROLLER and "pilot, holder" in str(error), error
    assert refusal(client.send_command).status == t.ERROR_ARGUMENT
    with t.Client(controller="") as observer:
        assert refusal(observer.loan_command).status == t.ERROR_ABSENT
        assert refusal(lambda: observer.request_frame()).status == t.ERROR_ABSENT
        assert refusal(lambda: observer.volume()).status == t.ERROR_ABSENT

    # Read-only memory cannot be written, and an unknown field cannot be set.
    state = client.wait_state(LIMIT_S)
    for attempt in [
        lambda: state.joint_position_rad.__setitem__(0, 1.0),
        lambda: setattr(state, "bend_rad", 1.0),
        lambda: setattr(t.Command(), "tendon_forces_n", 1.0),
    ]:
        try:
            attempt()
        except (t.ReadOnlyError, AttributeError):
            continue
        raise AssertionError("written")
    assert np.shares_memory(state.joint_position_rad, state.array["joint_position_rad"])

    # Invalid commands. The run begins when both controllers have answered its first state.
    with client.command() as command:
        command.tendon_mode = t.TENDON_SERVO_JF
    with t.Client(controller="holder") as holder:
        holder.wait_state(LIMIT_S)
        with holder.command() as command:
            command.burr_mode = t.BURR_SPEED
        applied(client, lambda state: state.tick > 20 and state.applied[0].source == t.SOURCE_FRESH)
        before = client.status.refused_commands

        def set_force(value: float) -> Callable[[Any], Any]:
            return lambda command: command.tendon_force_n.__setitem__(0, value)

        for change, words in [
            (set_force(math.nan), "`tendon_force_n[0]` is NaN; allowed: 0 to 60"),
            (set_force(61.0), "`tendon_force_n[0]` is 61; allowed: 0 to 60"),
            (lambda command: setattr(command, "tendon_mode", 9), "`tendon_mode` is 9, expected"),
            (
                lambda command: setattr(command, "burr_mode", t.BURR_SPEED),
                "`burr_mode` drives the burr, which the scene does not",
            ),
            (
                lambda command: setattr(command, "state_tick", 10**9),
                "`state_tick` is 1000000000, but the newest state",
            ),
        ]:
            answer(client, change)
            texts = wait_for_events(client, words)
            assert any("controller `pilot`: command" in text for text in texts), texts
        # A sequence number that was already used.
        answer(client, lambda command: setattr(command, "sequence", 2))
        wait_for_events(client, "`sequence` is 2, expected more than")
        # An older state than the last one answered.
        answer(client, lambda command: setattr(command, "state_tick", 1))
        wait_for_events(client, "`state_tick` is 1, but an earlier command of this connection answered")
        # The next number follows the one sent; a valid one is accepted again.
        newest = applied(client, lambda state: True).applied[0].sequence
        answer(client, lambda command: setattr(command, "sequence", int(newest) + 100))
        applied(client, lambda state: state.applied[0].sequence > newest + 100)
        deadline = time.monotonic() + LIMIT_S
        while client.status.refused_commands < before + 7:
            assert time.monotonic() < deadline, client.status
            time.sleep(0.01)

        # Flooding: commands that overflow the queue are counted and reported, and the newest takes effect.
        for _ in range(20_000):
            with client.command() as command:
                command.tendon_mode = t.TENDON_SERVO_JF
                command.tendon_force_n[0] = 3.0
        wait_for_events(client, "commands lost: the queue (512) overflowed")
        applied(client, lambda state: state.tendon_tension_n[0] > 2.0)

        # Not reading: the run does not wait for this client, which learns how many states it missed.
        first, missed = client.wait_state(LIMIT_S).tick, client.states_missed
        with t.Client(controller="") as observer:
            while observer.wait_state(LIMIT_S).tick < first + 700:
                pass
            assert client.wait_state(LIMIT_S).tick >= first + 700
            assert client.states_missed >= missed + 699, client.states_missed

    # Crash with an unsent command: the name becomes free, and the run continues.
    client.close()
    line = [sys.executable, __file__, die_with_a_command_begun.__name__]
    victim = subprocess.run(line, capture_output=True, text=True, timeout=LIMIT_S)
    assert victim.returncode == -signal.SIGKILL and victim.stdout == "begun\n", victim
    with t.Client(controller="pilot") as client:
        before = client.wait_state(LIMIT_S).tick
        applied(client, lambda state: state.tick > before + 50 and state.applied[0].source == t.SOURCE_FRESH)
        assert refusal(lambda: client.run_control(77)).status == t.ERROR_REFUSED
        client.run_control(t.CONTROL_STOP)
        try:
            while True:
                client.wait_state(LIMIT_S)
        except t.Ended:
            pass


def test_every_defect_is_refused_by_name_and_the_run_goes_on(start: Callable[[str], Run]) -> None:
    run = start(shared("realtime", 120.0, holder="external = true"))
    support.outside(every_defect, session=run.session)
    support.assert_replays(run.end())


if __name__ == "__main__":
    support.main(globals())
