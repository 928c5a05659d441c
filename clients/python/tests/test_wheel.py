"""An installed wheel in an empty folder, with only its environment in the PATH.

The default scene, its replay, a controller, a simulation, the viewer.
"""

from __future__ import annotations

import importlib.metadata
import os
import re
import select
import shutil
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest
import support
import trabecula
from support import LIMIT_S, SCENES
from trabecula.sim import Sim

BIN = Path(sys.executable).parent


@pytest.fixture(autouse=True)
def alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty folder, and an environment with only the user's folders of the machine."""
    if not Path(trabecula.__file__).resolve().is_relative_to(Path(sys.prefix).resolve()):
        support.missing("the package is not installed: these tests need the wheel")
    for variable in list(os.environ):
        if variable not in ("HOME", "XDG_RUNTIME_DIR") and not variable.startswith("PYTEST"):
            monkeypatch.delenv(variable)
    monkeypatch.setenv("PATH", str(BIN))
    monkeypatch.chdir(tmp_path)


def said(*words: str) -> str:
    """Returns the program's output; called by name, as a user would."""
    done = subprocess.run(["trabecula", *words], capture_output=True, text=True, timeout=LIMIT_S)
    assert done.returncode == 0, f"{words}: {done.returncode}\n{done.stdout}{done.stderr}"
    return done.stdout + done.stderr


def test_nothing_else_is_there() -> None:
    assert shutil.which("trabecula") == str(BIN / "trabecula")
    assert shutil.which("cargo") is None


def test_notices_of_what_is_linked_in_are_there() -> None:
    files = [file for file in importlib.metadata.files("trabecula") or [] if file.parent.name == "licenses"]
    assert {file.name for file in files} == {"LICENSE-APACHE", "LICENSE-MIT", "THIRD_PARTY"}, files
    metadata = importlib.metadata.metadata("trabecula")
    assert set(metadata.get_all("License-File") or []) == {file.name for file in files}
    (notices,) = [file.read_text() for file in files if file.name == "THIRD_PARTY"]
    for crate in ("iceoryx2 ", "mcap ", "nalgebra ", "rapier3d-f64 ", "pyo3 ", "epaint_default_fonts "):
        assert f"\n{crate}" in notices, crate
    # A font's licence, and one text for each of the two most common licences.
    assert (
        "SIL OPEN FONT LICENSE" in notices
        and "Apache License" in notices
        and "Permission is hereby granted" in notices
    )
    assert "\ntrabecula " not in notices and "\nwinapi " not in notices


def printed(*words: str) -> Path:
    line = [sys.executable, "-m", "trabecula", *words]
    return Path(subprocess.run(line, capture_output=True, text=True, check=True, timeout=LIMIT_S).stdout.strip())


def test_scenes_examples_headers_and_documentation_are_there_under_the_paths_of_a_checkout() -> None:
    """Regression: the wheel had none of them, and the README's commands failed."""
    files = printed()
    shutil.copytree(files, "files")
    said("scene", "check", "files/configs/free_space.toml")
    readme = Path("files/README.md").read_text()
    links = {link for link in re.findall(r"\]\(([^)#]+)", readme) if not link.startswith("https:")}
    # The Rust client and what only developers need are in the sources.
    left_out = {"clients/rust/README.md", "ARCHITECTURE.md", ".github/CONTRIBUTING.md"}
    missing = {link for link in links if not Path("files", link).exists()}
    assert len(links) > 20 and missing <= left_out, missing - left_out
    assert "stress" in said("stress", "--help")
    include, library = Path("files/clients/c/include"), printed("library")
    compiler = shutil.which("cc", path="/usr/bin:/usr/local/bin")
    if compiler is None:
        support.missing("no C compiler")
        return
    source = "files/clients/c/examples/01_hold_tension.c"
    link = ["-L", str(library), "-ltrabecula_client", "-lm"]
    line = [compiler, "-I", str(include), source, "-o", "hold", *link]
    subprocess.run(line, check=True, timeout=LIMIT_S, env={"PATH": "/usr/bin:/bin"})


def the_default_scene_runs_and_replays() -> Path:
    said("run", "--mode", "lockstep", "--duration-s", "0.5")
    (run,) = Path("out").iterdir()
    assert (run / "report.html").exists()
    assert "replayed 500 ticks, all identical" in said("replay", str(run), "--verify")
    return run


def test_the_default_scene_runs_replays_simulates_and_is_shown() -> None:
    run = the_default_scene_runs_and_replays()
    a_simulation_has_the_hash_of_the_run(run)
    the_viewer_shows_a_log(run)


def a_simulation_has_the_hash_of_the_run(run: Path) -> None:
    sim = Sim()
    sim.step(ticks=500)
    assert sim.hash in said("replay", str(run)), sim.hash


def test_a_controller_commands_its_run(monkeypatch: pytest.MonkeyPatch) -> None:
    # Uses the program of the package, although none is in the PATH.
    monkeypatch.delenv("PATH")
    overrides = {"run.duration_s": 0.5, "run.controller_limit_ms": 60000.0}
    with trabecula.run(SCENES / "free_space.toml", overrides=overrides, output="mine") as client:
        for state in client.states():
            with client.command() as command:
                command.tendon_mode = trabecula.TendonMode.SERVO_JF
                command.tendon_force_n[0] = 5.0
    monkeypatch.setenv("PATH", str(BIN))
    assert state.tick == 500 and state.bend_rad > 0.1, (state.tick, state.bend_rad)
    (run,) = Path("mine").iterdir()
    assert "replayed 500 ticks, all identical" in said("replay", str(run), "--verify")


def the_viewer_shows_a_log(run: Path) -> None:
    view = subprocess.Popen(
        ["trabecula", "view", str(run), "--port", "0", "--no-open"], stdout=subprocess.PIPE, text=True
    )
    try:
        assert view.stdout is not None  # a pipe
        ready, _, _ = select.select([view.stdout], [], [], LIMIT_S)
        assert ready, f"trabecula view printed no address within {LIMIT_S} s"
        address = view.stdout.readline().split("#")[0].strip()
        with urllib.request.urlopen(address, timeout=LIMIT_S) as page:
            assert "<title>" in page.read().decode(), address
    finally:
        view.terminate()
        view.wait(LIMIT_S)
