"""Floods in lockstep: each is refused by name, none holds up the run, and its end is reported."""

from __future__ import annotations

import math
import threading
from typing import Callable

import support
import trabecula as t
from scenes import with_frames
from support import LIMIT_S, Run
from trabecula import _client

library = _client._library


def answer(client: t.Client) -> None:
    with client.command() as command:
        command.tendon_mode = t.TENDON_SERVO_JF
        command.tendon_force_n[0] = 2.0


def floods() -> None:
    """Runs as the controller `mine`; ends the run."""
    client = t.Client()
    client.events()
    tick = client.wait_state(LIMIT_S).tick
    answer(client)
    client.wait_state(LIMIT_S)

    # Invalid commands: the tick waits for a valid one.
    for _ in range(5000):
        with client.command() as command:
            command.tendon_mode = t.TENDON_SERVO_JF
            command.tendon_force_n[0] = math.nan
    answer(client)
    assert client.wait_state(LIMIT_S).tick == tick + 2

    # Run control: sends every request without waiting for replies.
    for _ in range(5000):
        assert library.trb_control_run(client._handle, 77, 0, 0.0, None) in (
            t.ERROR_REFUSED,
            _client.g.TIMEOUT,
        )
    answer(client)
    assert client.wait_state(LIMIT_S).tick == tick + 3

    # Frames: past the end of the run, and far ahead.
    try:
        client.wait_frame(client.request_frame(10**9), LIMIT_S)
        raise AssertionError("not refused")
    except t.Error as error:
        assert error.status == t.ERROR_REFUSED, error
    for _ in range(2000):
        client.request_frame(999)
    with t.Client(controller="other") as other:
        # Another program's requests still get through.
        state = other.wait_state(LIMIT_S)
        request = other.request_frame(state.tick)
        assert other.wait_frame(request, LIMIT_S).frame.request_id == request
    answer(client)
    assert client.wait_state(LIMIT_S).tick == tick + 4

    # A client belongs to the thread that created it.
    seen: list[int] = []
    thread = threading.Thread(target=lambda: seen.append(library.trb_send_command(client._handle)))
    thread.start()
    thread.join(LIMIT_S)
    assert seen == [t.ERROR_HANDLE], seen

    # Invalid timeouts: NaN and negative.
    for wait in [
        lambda: client.wait_state(math.nan),
        lambda: client.volume(math.nan),
        lambda: client.run_control(t.CONTROL_PAUSE, timeout_s=math.nan),
        lambda: t.Client(timeout_s=-1.0),
    ]:
        try:
            wait()
            raise AssertionError("not refused")
        except t.Error as error:
            assert error.status == t.ERROR_ARGUMENT and "`timeout_s` is" in str(error), error

    # A pause is not an end; the end stops a wait for a frame that will not arrive.
    client.run_control(t.CONTROL_PAUSE)
    try:
        client.wait_state(0.3)
        raise AssertionError("a tick was computed while paused")
    except TimeoutError:
        pass
    client.run_control(t.CONTROL_STOP)
    try:
        client.wait_frame(2**63, LIMIT_S)
        raise AssertionError("a frame arrived after the run ended")
    except t.Ended:
        pass


def test_floods_hold_nobody_up(start: Callable[[str], Run]) -> None:
    run = start(with_frames())
    support.outside(floods, session=run.session, controller="mine")
    support.assert_replays(run.end())


if __name__ == "__main__":
    support.main(globals())
