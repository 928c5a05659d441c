"""Locates the package under test and starts runs.

Tested is the installed package, or, if it is not installed, the sources with cargo's newest build. The
environment variables `TRABECULA_CLIENT_LIBRARY`, `TRABECULA_SIM_LIBRARY` and `TRABECULA_PROGRAM` select other
files; builds are searched in target/release and target/quick (`cargo build --release --workspace`).
"""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path
from typing import Callable, Iterator, Union

import pytest

from support import CONTROLLER, ROOT, SESSION, Run

#: Environment variables and the cargo outputs that they override.
BUILT = {
    "TRABECULA_CLIENT_LIBRARY": "libtrabecula_client.so",
    "TRABECULA_SIM_LIBRARY": "libtrabecula_sim.so",
    "TRABECULA_PROGRAM": "trabecula",
}


def _built(name: str) -> Union[Path, None]:
    files = [file for profile in ("release", "quick") if (file := ROOT / "target" / profile / name).exists()]
    return max(files, key=lambda file: file.stat().st_mtime, default=None)


def _use_sources() -> None:
    """Uses the package's sources and cargo's build, in this process and in those started by a test."""
    sources = str(ROOT / "clients/python")
    sys.path.insert(0, sources)
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [sources, os.environ.get("PYTHONPATH")]))
    for variable, name in BUILT.items():
        if variable not in os.environ and (file := _built(name)):
            os.environ[variable] = str(file)
    absent = [name for variable, name in BUILT.items() if not os.path.exists(os.environ.get(variable, ""))]
    if absent:
        hint = (
            "`pip install .` installs the package, `cargo build --release --workspace` builds what it needs"
        )
        pytest.exit(f"neither the package trabecula nor {', '.join(absent)} is here: {hint}", returncode=4)


def pytest_configure() -> None:
    """Runs before any module imports the package."""
    for variable in (SESSION, CONTROLLER):
        os.environ.pop(variable, None)
    if importlib.util.find_spec("trabecula") is None:
        _use_sources()
    if "TRABECULA_PROGRAM" not in os.environ:
        from trabecula._run import _program

        os.environ["TRABECULA_PROGRAM"] = _program()


def pytest_report_header() -> list[str]:
    """Prints what is tested."""
    import trabecula

    return [f"package: {Path(trabecula.__file__).parent}", f"program: {os.environ['TRABECULA_PROGRAM']}"]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[[str], Run]]:
    """Starts a run of a scene; any run still active at the end of the test is killed."""
    runs: list[Run] = []

    def start(scene: str) -> Run:
        folder = tmp_path / f"run_{len(runs)}"
        folder.mkdir()
        (folder / "scene.toml").write_text(scene)
        runs.append(Run(folder / "scene.toml", folder))
        return runs[-1]

    yield start
    for run in runs:
        run.kill()
