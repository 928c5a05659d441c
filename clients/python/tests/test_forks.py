"""A forked child cannot use its parent's client, and its exit does not disconnect it."""

from __future__ import annotations

import gc
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from typing import Any, Callable

import numpy as np
import support
import trabecula as t
from scenes import imaged
from support import LIMIT_S, Run


def answer(client: t.Client) -> int:
    state = client.wait_state(LIMIT_S)
    with client.command() as command:
        command.tendon_mode = t.TENDON_SERVO_JF
        command.tendon_force_n[0] = 2.0
    return int(state.tick)


def status_of(call: Callable[[], Any]) -> int:
    try:
        call()
    except t.Error as error:
        return error.status
    return 0


def all_calls(client: t.Client) -> list[Callable[[], Any]]:
    """Makes every call of a client that needs no state."""
    return [
        client.wait_state,
        client.next_state,
        client.poll_state,
        client.loan_command,
        client.send_command,
        client.discard_command,
        client.request_frame,
        client.wait_frame,
        client.volume,
        client.events,
        client.next_removed,
        lambda: client.run_control(t.CONTROL_STOP),
        lambda: client.remark("x"),
        lambda: client.status,
        lambda: client.info,
        lambda: client.states_missed,
    ]


def child(client: t.Client, hu: Any, expected: int) -> None:
    """Work of a child: it can read the returned data, and its calls are refused."""
    assert int(hu.astype(np.int64).sum()) == expected
    for call in all_calls(client):
        status = status_of(call)
        assert status == t.ERROR_FORKED, (call, status)
    client.close()
    # The child's own client.
    with t.Client(controller="") as observer:
        assert observer.wait_state(LIMIT_S).tick >= 0
        assert int(observer.volume(LIMIT_S).hu.astype(np.int64).sum()) == expected


def forked(body: Callable[[], Any], leave: Callable[[], Any]) -> int:
    """Returns the exit code of a forked child."""
    pid = os.fork()
    if pid == 0:
        try:
            body()
        except BaseException:
            sys.excepthook(*sys.exc_info())
            os._exit(1)
        leave()
    deadline = time.monotonic() + LIMIT_S
    while (ended := os.waitpid(pid, os.WNOHANG))[0] == 0:
        if time.monotonic() > deadline:
            os.kill(pid, signal.SIGKILL)
        time.sleep(0.002)
    return os.waitstatus_to_exitcode(ended[1])


def held_lock_and_child(client: t.Client) -> None:
    """Forks while other threads hold and release the memory of clients."""
    over = threading.Event()

    def churn() -> None:
        while not over.is_set():
            with t.Client(controller="") as observer:
                state = observer.wait_state(LIMIT_S)
            del state

    thread = threading.Thread(target=churn)
    thread.start()
    for _ in range(20):
        assert forked(gc.collect, lambda: sys.exit(0)) == 0
    over.set()
    thread.join(LIMIT_S)


def forks() -> None:
    """Runs as the controller `mine`; ends the run."""
    client: Any = t.Client()
    hu: Any = client.volume(LIMIT_S).hu
    expected = int(hu.astype(np.int64).sum())
    ticks = [answer(client)]

    # A normal exit, which runs all clean-up; a hard exit; an exec.
    assert forked(lambda: child(client, hu, expected), lambda: sys.exit(0)) == 0
    ticks.append(answer(client))
    assert forked(lambda: child(client, hu, expected), lambda: os._exit(0)) == 0
    assert forked(lambda: None, lambda: os.execv(sys.executable, [sys.executable, "-c", "pass"])) == 0

    def let_go() -> None:
        nonlocal client, hu
        client = hu = None
        gc.collect()

    assert forked(let_go, lambda: sys.exit(0)) == 0
    ticks.append(answer(client))

    workers = multiprocessing.get_context("fork")
    worker = workers.Process(target=child, args=(client, hu, expected))
    worker.start()
    worker.join(LIMIT_S)
    assert worker.exitcode == 0, worker.exitcode
    with workers.Pool(2) as pool:
        assert pool.map_async(abs, [-1, -2, -3]).get(LIMIT_S) == [1, 2, 3]
    ticks.append(answer(client))

    subprocess.run([sys.executable, "-c", "pass"], check=True, timeout=LIMIT_S)
    subprocess.run(["true"], check=True, preexec_fn=gc.collect, timeout=LIMIT_S)
    ticks.append(answer(client))
    # Each answer is for its own tick: the parent was connected the whole time.
    assert ticks == list(range(ticks[0], ticks[0] + len(ticks))), ticks
    held_lock_and_child(client)
    for _ in range(50):
        answer(client)
    frame = client.wait_frame(client.request_frame(), LIMIT_S)
    assert frame.pixels.size
    client.run_control(t.CONTROL_STOP, timeout_s=LIMIT_S)
    try:
        while True:
            client.wait_state(LIMIT_S)
    except t.Ended:
        pass


def test_a_forked_child_that_exits_does_not_disconnect_its_parent(start: Callable[[str], Run]) -> None:
    """The normal exit of a child must not run the clean-up of its parent's client, which would end the
    run.
    """
    run = start(imaged())
    support.outside(forks, session=run.session, controller="mine")
    folder = run.end()
    support.assert_replays(folder)


if __name__ == "__main__":
    support.main(globals())
