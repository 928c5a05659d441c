"""Data returned by a client stays readable for as long as Python references it.

Each case runs in a separate Python process with a lockstep run with X-ray and a volume, and ends the run. A
case that touches unmapped memory dies by SIGSEGV.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
import time
from typing import Any, Callable

import numpy as np
import pytest
import support
import trabecula as t
from scenes import imaged
from support import LIMIT_S, Run


def sums(*arrays: Any) -> list[int]:
    """Reads every byte."""
    return [int(np.asarray(array).view(np.uint8).astype(np.int64).sum()) for array in arrays]


def answered(client: t.Client) -> t.State:
    """Answers the newest state."""
    state = client.wait_state(LIMIT_S)
    with client.command() as command:
        command.tendon_mode = t.TENDON_SERVO_JF
        command.tendon_force_n[0] = 2.0
    return state


def frame_of(client: t.Client) -> t.Image:
    """Returns a frame of the newest state; needs no further tick."""
    return client.wait_frame(client.request_frame(), LIMIT_S)


def to_the_end(client: t.Client) -> None:
    """Stops the run and waits until the hub and its shared memory are gone."""
    folder = client.info.folder
    client.run_control(t.CONTROL_STOP, timeout_s=LIMIT_S)
    for _ in range(int(LIMIT_S / 0.05)):
        if not os.path.exists(folder):
            return
        time.sleep(0.05)
    raise AssertionError(f"{folder} is still there")


def the_last_frame_after_the_end() -> None:
    """`wait_frame` must not release the last frame before the next one has arrived."""
    client = t.Client()
    state, image = client.wait_state(LIMIT_S), frame_of(client)
    before, number = sums(image.pixels), image.frame.sequence
    to_the_end(client)
    try:
        while True:
            client.wait_frame(timeout_s=LIMIT_S)
    except t.Ended:
        pass
    assert (sums(image.pixels), image.frame.sequence) == (before, number)
    assert state.tick == 0 and np.isfinite(state.joint_position_rad).all()


def the_last_removal_after_a_look_in_vain() -> None:
    client = t.Client()
    removal = client.next_removed()
    # Drives the burr into the bone.
    for _ in range(900):
        state = client.wait_state(LIMIT_S)
        with client.command() as command:
            command.burr_mode, command.burr_speed_rad_per_s = t.BURR_SPEED, 800.0
            command.arm_mode, command.arm_axis, command.arm_depth_m = t.ARM_INSERT, (0.0, 0.0, 1.0), 0.02
            command.arm_speed_m_per_s = 0.05
        removal = client.next_removed() or removal
        if removal is not None:
            break
    assert removal is not None, state
    to_the_end(client)
    while (later := client.next_removed()) is not None:
        removal = later
    before = sums(removal.voxel_index)
    assert client.next_removed() is None
    assert sums(removal.voxel_index) == before and removal.removed.tick > 0


def the_volume_after_its_thread() -> None:
    """A thread's clients end with it; their returned data is still read."""
    found = {}

    def read():
        client = t.Client(controller="")
        found["hu"] = client.volume(LIMIT_S).hu
        found["sum"] = sums(found["hu"])
        found["state"] = client.wait_state(LIMIT_S)

    thread = threading.Thread(target=read)
    thread.start()
    thread.join()
    mine = t.Client()
    answered(mine)
    to_the_end(mine)
    assert sums(found["hu"]) == found["sum"]
    assert found["state"].tick == 0 and found["state"].t_world_tip.position_m.shape == (3,)
    gc.collect()
    found.clear()
    gc.collect()


def everything_after_close_and_in_any_order() -> None:
    client = t.Client(controller="")
    mine = t.Client()
    image, ct, state = frame_of(client), client.volume(LIMIT_S), client.wait_state(LIMIT_S)
    before = sums(image.pixels, ct.hu, state.joint_position_rad)
    client.close()
    client.close()
    for call in (client.wait_state, client.events, lambda: client.volume()):
        try:
            call()
            raise AssertionError("a closed client was used")
        except t.Error as error:
            assert error.status == t.ERROR_HANDLE, error
    assert sums(image.pixels, ct.hu, state.joint_position_rad) == before
    # Other messages must not overwrite the ones held.
    for _ in range(100):
        answered(mine)
    assert sums(image.pixels, ct.hu, state.joint_position_rad) == before and state.tick == 0
    to_the_end(mine)
    pixels, hu = image.pixels[3:9], ct.hu[1:-1, ::2]
    before = sums(pixels.copy(), hu.copy())
    del client, image, ct
    gc.collect()
    assert sums(pixels.copy(), hu.copy()) == before and state.tick == 0
    del state, pixels
    gc.collect()
    assert int(hu.astype(np.int64).sum()) != 1
    del hu
    gc.collect()


def a_client_that_nobody_keeps() -> None:
    """The name is free again at once; the array keeps its memory."""
    pixels = frame_of(t.Client(controller="other")).pixels
    before = sums(pixels)
    with t.Client(controller="other") as other:
        assert other.info.controller == "other"
    mine = t.Client()
    answered(mine)
    to_the_end(mine)
    assert sums(pixels) == before


KEPT: list[Any] = []


def everything_at_exit() -> None:
    """A thread continues to read while the interpreter shuts down."""
    client = t.Client()
    ct, image = client.volume(LIMIT_S), frame_of(client)
    answered(client)
    to_the_end(client)

    def read():
        while True:
            ct.hu.astype(np.float64).sum()
            image.pixels.astype(np.float64).sum()

    threading.Thread(target=read, daemon=True).start()
    KEPT.extend([image, ct, client])
    # A reference that Python drops last, regardless of its shutdown order.
    sys.modules["kept by the interpreter"] = (client, ct.hu)


def a_signal_during_a_wait() -> None:
    """A signal handler calls the client between a wait and the use of its result."""
    client = t.Client()
    client.wait_state(LIMIT_S)
    heard = []

    def handler(*_):
        heard.append(client.loan_command().sequence)
        client.discard_command()

    signal.signal(signal.SIGALRM, handler)
    signal.setitimer(signal.ITIMER_REAL, 0.0005, 0.0005)
    try:
        for _ in range(400):
            try:
                state = client.wait_state(0.002)
                assert len(state.joint_position_rad) == state.joint_count and abs(state.bend_rad) < 10.0, (
                    state
                )
            except TimeoutError:
                pass
            try:
                with client.command() as command:
                    command.tendon_mode = t.TENDON_SERVO_JF
            except (ValueError, t.Error) as error:
                # The handler has discarded the command.
                assert "discarded" in str(error) or "no command to send" in str(error), error
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
    assert heard
    answered(client)
    to_the_end(client)


CASES = [
    # A wait for a frame must not release the previous one at once: its memory would vanish with the DRR
    # process.
    the_last_frame_after_the_end,
    the_last_removal_after_a_look_in_vain,
    # A thread's clients end with it, but the memory of arrays held by others must stay.
    the_volume_after_its_thread,
    everything_after_close_and_in_any_order,
    # An array must not keep its client connected, which would keep its name taken.
    a_client_that_nobody_keeps,
    everything_at_exit,
    a_signal_during_a_wait,
]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__)
def test_what_was_handed_out_stays_readable(case: Callable[[], None], start: Callable[[str], Run]) -> None:
    run = start(imaged())
    support.outside(case, session=run.session, controller="mine")
    run.end()


if __name__ == "__main__":
    support.main(globals())
