"""Starts runs."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import threading
import time
from contextlib import contextmanager, suppress
from importlib import metadata
from pathlib import Path
from typing import IO, Any, Iterator, Mapping, Optional, Union

from . import _generated as g
from ._client import Client
from ._errors import ArgumentError, Ended, Error

#: Environment variable with the program's path; takes precedence over all other locations.
PROGRAM_VARIABLE = "TRABECULA_PROGRAM"
NAME = "trabecula"
#: Time limit for completing the log after a stop request, and then after each signal.
_END_LIMIT_S = 120.0
_SIGNAL_LIMIT_S = 10.0
_BAD_INPUT = 2


@contextmanager
def run(
    scene: Union[str, Path, None] = None,
    *,
    overrides: Optional[Mapping[str, Any]] = None,
    controller: Optional[str] = None,
    output: Union[str, Path] = "out",
    timeout_s: float = 60.0,
) -> Iterator[Client]:
    """Starts a run, joins it, and stops it at the end of the `with` block if it has not ended by then.

        overrides = {"run.duration_s": 2.0, "controller.0.optional": True}
        with trabecula.run("scene.toml", overrides=overrides) as client:
            state = client.step(100)

    Args:
        scene: Scene file; None: the built-in femur.
        overrides: Values for scene keys, by path; a number in a path is an index, from 0, into an array of
            tables.
        controller: As in `Client`; if None and the scene has no external controller, the client is an
            observer.
        output: Parent of the run's folder.
        timeout_s: Time limit for announcing the session, which includes reading or creating the volume.

    Raises:
        ArgumentError: The scene or an override is refused, with the program's error text.
        Error: The program was not found, the run failed, or its log is incomplete.
        TimeoutError: The session was not announced in time.
    """
    words = [_program(), "run", *([] if scene is None else [str(scene)]), "--json", "--output", str(output)]
    for setting in settings(overrides):
        words += ["--set", setting]
    with _Started(words) as started:
        session = started.session(timeout_s)
        with _joined(session, controller, timeout_s) as client:
            try:
                yield client
            finally:
                with suppress(Error, Ended, TimeoutError):
                    client.run_control(g.ControlAction.STOP)
        started.finish()


def _joined(session: str, controller: Optional[str], timeout_s: float) -> Client:
    if controller is None and not os.environ.get("TRABECULA_CONTROLLER"):
        # An observer knows the scene, and therefore whether there is an external controller.
        with Client(session, "", timeout_s) as observer:
            if "external = true" not in observer.info.scene_toml:
                controller = ""
    return Client(session, controller, timeout_s)


def _program() -> str:
    given = os.environ.get(PROGRAM_VARIABLE)
    built = Path(__file__).resolve().parents[3] / "target" / "release" / NAME
    found = given or (str(built) if built.exists() else _installed() or shutil.which(NAME))
    if found is None or not os.access(found, os.X_OK):
        places = f"{found}" if found else f"{built}, this package and the PATH"
        text = (
            f"program `{NAME}` not found in {places}: install the package by `pip install .` in a checkout, "
            f"or set the program's path in {PROGRAM_VARIABLE}"
        )
        raise Error(g.ERROR_ABSENT, text)
    return found


def _installed() -> Optional[str]:
    """Returns the program installed from this package's wheel: it has the same version, and it is found even
    if the environment is not activated.
    """
    try:
        files = metadata.files("trabecula") or []
    except metadata.PackageNotFoundError:
        return None
    programs = (file.locate() for file in files if file.name == NAME and file.parent.name == "bin")
    return next((str(Path(program).resolve()) for program in programs), None)


def settings(overrides: Optional[Mapping[str, Any]]) -> list[str]:
    """Converts overrides to `KEY=VALUE` arguments of `--set`."""
    return [f"{key}={_toml(key, value)}" for key, value in (overrides or {}).items()]


def _toml(key: str, value: Any) -> str:
    """Formats a value as in a scene file."""
    if isinstance(value, bool):
        return "true" if value else "false"
    # NumPy numbers first: some are also floats, but their repr is not TOML.
    if hasattr(value, "tolist"):
        return _toml(key, value.tolist())
    if isinstance(value, (int, float)):
        return repr(value)
    if isinstance(value, (str, Path)):
        return json.dumps(str(value), ensure_ascii=False)
    if isinstance(value, Mapping):
        entries = (f"{name} = {_toml(f'{key}.{name}', inner)}" for name, inner in value.items())
        return "{" + ", ".join(entries) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_toml(key, inner) for inner in value) + "]"
    expected = "expected a number, a text, a truth value, or a list or table of them"
    raise ArgumentError(f"the override `{key}` is {value!r}, {expected}")


class _Started:
    """The launcher's process, ended on exit from the context."""

    def __init__(self, words: list[str]) -> None:
        self._process = subprocess.Popen(
            words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        self._said: list[str] = []
        self._session: Optional[str] = None
        self._heard = threading.Condition()
        assert self._process.stdout is not None and self._process.stderr is not None  # pipes
        self._listeners = [
            threading.Thread(target=self._hear, args=(self._process.stdout,), daemon=True),
            threading.Thread(target=self._listen, args=(self._process.stderr,), daemon=True),
        ]
        for listener in self._listeners:
            listener.start()

    def _hear(self, figures: IO[str]) -> None:
        """Reads the session from the first line, and drains the rest so that the program never blocks."""
        for line in figures:
            if self._session is None:
                with self._heard:
                    self._session = json.loads(line).get("session")
                    self._heard.notify_all()

    def _listen(self, words: IO[str]) -> None:
        for line in words:
            # What the run waits for, and what it refuses, while it goes on.
            if line.startswith(("caution: ", "waiting for ")):
                print(line, end="", file=sys.stderr, flush=True)
            with self._heard:
                self._said = [*self._said[-19:], line.rstrip()]
                self._heard.notify_all()

    def __enter__(self) -> _Started:
        return self

    def __exit__(self, *_: object) -> None:
        """Ends a process that is still running: by SIGTERM, then SIGKILL."""
        for end in (self._process.terminate, self._process.kill):
            if self._process.poll() is None:
                end()
                with suppress(subprocess.TimeoutExpired):
                    self._process.wait(_SIGNAL_LIMIT_S)
        self._join()

    def _join(self) -> None:
        for listener in self._listeners:
            listener.join(_SIGNAL_LIMIT_S)

    def session(self, timeout_s: float) -> str:
        """Waits until the session is announced and returns its folder."""
        deadline = time.monotonic() + timeout_s
        with self._heard:
            while self._session is None:
                if self._process.poll() is not None and not any(it.is_alive() for it in self._listeners):
                    raise self._failure()
                if time.monotonic() > deadline:
                    text = f"no session within {timeout_s} s; the program's last output: {self._last_words()}"
                    raise TimeoutError(text)
                self._heard.wait(0.1)
            return self._session

    def finish(self) -> None:
        """Waits for the end of the run.

        Raises:
            Error: The run failed.
        """
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_END_LIMIT_S)
        self._join()
        if self._process.poll() != 0:
            raise self._failure()

    def _failure(self) -> Error:
        code = self._process.poll()
        if code == _BAD_INPUT:
            return ArgumentError(self._last_words())
        how = "did not end in time" if code is None else f"ended with exit code {code}"
        return Error(g.ERROR_HUB_GONE, f"the run {how}: {self._last_words()}")

    def _last_words(self) -> str:
        """Returns the program's last error lines; the final result comes last, preceded by its cause."""
        own = "trabecula: "
        complaints = [line[len(own) :] for line in self._said if line.startswith(own)]
        return "; ".join(complaints[-3:]) or (self._said or ["nothing"])[-1]
