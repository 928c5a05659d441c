"""Shared by the tests: the program, runs in the background, and cases that need a separate Python process."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType
from typing import Any, Callable

import pytest

ROOT = Path(__file__).resolve().parents[3]
SCENES = ROOT / "clients/scenes"
#: Time limit of any operation, s; only reached by a hang.
LIMIT_S = 120.0
#: Time limit of a case in a separate Python process, which waits several times, s.
CASE_LIMIT_S = 300.0
#: Environment variables that would select another session or controller.
SESSION, CONTROLLER = "TRABECULA_SESSION", "TRABECULA_CONTROLLER"


def missing(what: str) -> None:
    """Skips a test or a module because a requirement is not installed; fails if `CI` is set."""
    if os.environ.get("CI"):
        pytest.fail(f"{what}; in CI nothing is skipped", pytrace=False)
    pytest.skip(f"*** {what} ***", allow_module_level=True)


def needs(*modules: str) -> list[ModuleType]:
    """Imports modules that are not part of an install of the package, or skips."""
    found = []
    for name in modules:
        try:
            found.append(importlib.import_module(name))
        except ImportError as cause:
            missing(f"no {name} here ({cause}): pip install -r clients/python/tests/requirements.txt")
    return found


def trabecula(*words: object, code: int = 0) -> str:
    """Runs the program and returns what it printed; on standard error, if it is expected to fail."""
    line = [os.environ["TRABECULA_PROGRAM"], *map(str, words)]
    done = subprocess.run(line, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    assert done.returncode == code, f"{line}: {done.returncode}\n{done.stdout}{done.stderr}"
    return done.stdout if code == 0 else done.stderr


def recorded(scene: Path, output: Path) -> Path:
    """Records a run in lockstep; returns its folder."""
    trabecula("run", scene, "--mode", "lockstep", "--quiet", "--output", output)
    (folder,) = output.iterdir()
    return folder


def messages(log: Path, topic: str, *fields: str) -> list[Any]:
    """Returns the messages of a topic, or some of their fields."""
    words = [word for field in fields for word in ("--field", field)]
    lines = trabecula("log", "cat", log, "--topic", topic, *words).splitlines()
    return [json.loads(line)["message"] for line in lines]


def digits(hash_parts: list[int]) -> str:
    """Formats a hash as printed."""
    low, high = hash_parts
    return f"{high:016x}{low:016x}"


def assert_replays(folder: Path) -> None:
    """Checks that a replay finds every tick identical."""
    assert "all identical" in trabecula("replay", folder, "--verify")


def outside(
    case: Callable[..., None], *words: object, session: object = None, controller: object = None
) -> None:
    """Runs a function of a test's module in a separate Python process: a crash or a leftover client fails
    only that test.

    The module ends with `support.main(globals())`.
    """
    environment = {key: value for key, value in os.environ.items() if key not in (SESSION, CONTROLLER)}
    if session is not None:
        environment[SESSION] = str(session)
    if controller is not None:
        environment[CONTROLLER] = str(controller)
    line = [sys.executable, "-X", "faulthandler", case.__code__.co_filename, case.__name__, *map(str, words)]
    done = subprocess.run(
        line, env=environment, capture_output=True, text=True, timeout=CASE_LIMIT_S, check=False
    )
    said = f"{case.__name__}: {done.returncode}\n{done.stdout}{done.stderr}"
    assert done.returncode == 0 and done.stdout.endswith("done\n"), said


def main(module: dict[str, Any]) -> None:
    """Runs the case named on the command line."""
    module[sys.argv[1]](*sys.argv[2:])
    print("done", flush=True)


def wait_for(what: str, found: Callable[[], Any]) -> Any:
    """Waits until a function returns something true, and returns it."""
    deadline = time.monotonic() + LIMIT_S
    while not (value := found()):
        assert time.monotonic() < deadline, f"{what}: not within {LIMIT_S} s"
        time.sleep(0.01)
    return value


class Run:
    """A run of the program in the background of a test."""

    def __init__(self, scene: Path, folder: Path) -> None:
        self._output, self._out, self._err = (folder / name for name in ("out", "stdout", "stderr"))
        words = [os.environ["TRABECULA_PROGRAM"], "run", str(scene), "--json", "--output", str(self._output)]
        with open(self._out, "w") as out, open(self._err, "w") as err:
            self._process = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=out, stderr=err)
        self.session: str = wait_for(f"the session of {scene}", self._announced)

    def _announced(self) -> str:
        assert self._process.poll() is None, self._err.read_text()
        line, end, _ = self._out.read_text().partition("\n")
        return str(json.loads(line)["session"]) if end else ""

    def part(self, name: str) -> int:
        """Returns the process of a part of the run, such as `physics`."""
        words = ["proc", name]

        def found() -> int:
            for file in Path("/proc").glob("[0-9]*/cmdline"):
                try:
                    line = file.read_bytes().decode(errors="replace").split("\0")
                except OSError:  # It has just ended.
                    continue
                if self.session in line and any(line[i : i + 2] == words for i in range(len(line))):
                    return int(file.parent.name)
            return 0

        return int(wait_for(f"the process of {name}", found))

    def end(self) -> Path:
        """Waits for the end of the run, which must succeed and clean up; returns the run's folder."""
        code = self._process.wait(LIMIT_S)
        assert code == 0, f"{code}: {self._err.read_text()}"
        assert not os.path.exists(self.session)
        of_session = Path(self.session).name
        left = [name for name in os.listdir("/dev/shm") if of_session in name]
        assert not left, left
        (folder,) = self._output.iterdir()
        return folder

    def kill(self) -> None:
        """Ends a run left by a failed test; its parts end with it."""
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait(LIMIT_S)
