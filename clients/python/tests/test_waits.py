"""Waits end when they should: on Ctrl-C, and at once if nothing can arrive."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from typing import Callable

import pytest
import support
import trabecula as t
from scenes import hold
from support import LIMIT_S, SESSION, Run

WAITS: dict[str, Callable[[], object]] = {
    "connect": lambda: t.Client(session="NoSuchSessi", timeout_s=1e6),
    "run_control": lambda: t.Client(controller="").run_control(t.CONTROL_PAUSE, timeout_s=1e6),
}


def waits(name: str) -> None:
    """Waits until Ctrl-C."""
    # The tests may have been started with SIGINT ignored (`pytest &`).
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        print("waiting", flush=True)
        WAITS[name]()
    except KeyboardInterrupt:
        return
    raise AssertionError("the wait ended by itself")


@pytest.mark.parametrize("name", WAITS)
def test_ctrl_c_ends_a_wait(name: str, start: Callable[[str], Run]) -> None:
    """Connecting and run control must not wait inside the library until their timeout, ignoring Ctrl-C."""
    run = start(hold("realtime", 120.0))
    physics = run.part("physics")
    os.kill(physics, signal.SIGSTOP)
    line = [sys.executable, __file__, waits.__name__, name]
    environment = {**os.environ, SESSION: run.session}
    with subprocess.Popen(
        line, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as waiting:
        try:
            assert waiting.stdout is not None  # a pipe
            assert waiting.stdout.readline() == "waiting\n"
            # Let the wait begin.
            time.sleep(0.3)
            waiting.send_signal(signal.SIGINT)
            said, error = waiting.communicate(timeout=LIMIT_S)
            assert (waiting.returncode, said) == (0, "done\n"), error
        finally:
            waiting.kill()
            os.kill(physics, signal.SIGCONT)
    support.trabecula("session", "stop", run.session)
    run.end()


def test_a_name_that_can_never_be_a_session_is_refused_at_once() -> None:
    with pytest.raises(t.Error, match="^`/etc` cannot be a session") as refused:
        t.Client(session="/etc", timeout_s=1e5)
    assert refused.value.status == -3


if __name__ == "__main__":
    support.main(globals())
