"""What an installed wheel does in an empty folder: `wheel.py SCENE`, by the environment's Python, with nothing but that environment in PATH.
SCENE has one external controller and no bone.

The default scene, its replay, a controller, a simulation, the viewer. Prints `done` at the end.
"""

from __future__ import annotations

import importlib.metadata
import os
import select
import shutil
import subprocess
import sys
import urllib.request
from pathlib import Path

import trabecula
from trabecula.sim import Sim

#: Longest time that a program may take.
LIMIT_S = 300.0


def said(*words: str) -> str:
    """What the program says; by its name, so as a user calls it."""
    done = subprocess.run(["trabecula", *words], capture_output=True, text=True, timeout=LIMIT_S)
    assert done.returncode == 0, f"{words}: {done.returncode}\n{done.stdout}{done.stderr}"
    return done.stdout + done.stderr


def nothing_else_is_there() -> None:
    bin_folder = Path(sys.executable).parent
    assert os.environ["PATH"] == str(bin_folder), os.environ["PATH"]
    assert shutil.which("trabecula") == str(bin_folder / "trabecula")
    assert shutil.which("cargo") is None
    package = Path(trabecula.__file__).resolve()
    assert package.is_relative_to(Path(sys.prefix).resolve()), package


def notices_of_what_is_linked_in_are_there() -> None:
    files = [file for file in importlib.metadata.files("trabecula") or [] if file.parent.name == "licenses"]
    assert {file.name for file in files} == {"LICENSE-APACHE", "LICENSE-MIT", "THIRD_PARTY"}, files
    metadata = importlib.metadata.metadata("trabecula")
    assert set(metadata.get_all("License-File") or []) == {file.name for file in files}
    (notices,) = [file.read_text() for file in files if file.name == "THIRD_PARTY"]
    for crate in ("iceoryx2 ", "mcap ", "nalgebra ", "rapier3d-f64 ", "pyo3 ", "epaint_default_fonts "):
        assert f"\n{crate}" in notices, crate
    # A font's licence, and one text for each of the two that most crates have.
    assert "SIL OPEN FONT LICENSE" in notices and "Apache License" in notices and "Permission is hereby granted" in notices
    assert "\ntrabecula " not in notices and "\nwinapi " not in notices


def the_default_scene_runs_and_replays() -> Path:
    said("run", "--mode", "lockstep", "--duration-s", "0.5")
    (run,) = Path("out").iterdir()
    assert (run / "report.html").exists()
    assert "replayed 500 ticks, all identical" in said("replay", str(run), "--verify")
    return run


def a_simulation_has_the_hash_of_the_run(run: Path) -> None:
    sim = Sim()
    sim.step(ticks=500)
    assert sim.hash in said("replay", str(run)), sim.hash


def a_controller_commands_its_run() -> None:
    # The program of the package, although none is in the PATH.
    path = os.environ.pop("PATH")
    overrides = {"run.duration_s": 0.5, "run.controller_limit_ms": 60000.0}
    with trabecula.run(sys.argv[1], overrides=overrides, output="mine") as client:
        for state in client.states():
            with client.command() as command:
                command.tendon_mode = trabecula.TendonMode.SERVO_JF
                command.tendon_force_n[0] = 5.0
    os.environ["PATH"] = path
    assert state.tick == 500 and state.bend_rad > 0.1, (state.tick, state.bend_rad)
    (run,) = Path("mine").iterdir()
    assert "replayed 500 ticks, all identical" in said("replay", str(run), "--verify")


def the_viewer_shows_a_log(run: Path) -> None:
    view = subprocess.Popen(["trabecula", "view", str(run), "--port", "0", "--no-open"], stdout=subprocess.PIPE, text=True)
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


nothing_else_is_there()
notices_of_what_is_linked_in_are_there()
default_run = the_default_scene_runs_and_replays()
a_simulation_has_the_hash_of_the_run(default_run)
a_controller_commands_its_run()
the_viewer_shows_a_log(default_run)
print("done")
