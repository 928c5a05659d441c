"""Output of the notebooks in docs/notebooks, executed cell by cell in an empty folder, and of examples."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import support
from support import ROOT

NEEDED = ("scipy", "pandas", "pyarrow", "matplotlib", "nbformat", "nbclient", "traitlets.config", "ipykernel")
#: Time limits of a cell and of a notebook, s: a sweep of eighty runs takes a minute on two idle cores.
CELL_LIMIT_S, NOTEBOOK_LIMIT_S = 600, 900.0


def execute(file: str) -> None:
    """Executes a notebook in the working folder, and prints what its cells print."""
    nbformat, nbclient, config = support.needs("nbformat", "nbclient", "traitlets.config")
    notebook = nbformat.read(file, as_version=4)
    nbformat.validate(notebook)
    # The kernel listens on files of this user, not on ports that every user of the machine can reach.
    settings = config.Config({"KernelManager": {"transport": "ipc"}})
    folder = {"metadata": {"path": "."}}
    client = nbclient.NotebookClient(
        notebook, timeout=CELL_LIMIT_S, kernel_name="python3", resources=folder, config=settings
    )
    client.execute()
    for cell in notebook.cells:
        for output in cell.get("outputs", []):
            if output.output_type == "stream" and output.name == "stdout":
                print(output.text, end="")


def printed(line: list[Any], folder: Path) -> str:
    """Returns the output of a program in a folder, with this Python and the tested program first in the
    PATH.
    """
    first = [Path(sys.executable).parent, Path(os.environ["TRABECULA_PROGRAM"]).parent]
    environment = {
        **os.environ,
        "PATH": os.pathsep.join([*map(str, first), os.environ["PATH"]]),
        "IPYTHONDIR": str(folder / "ipython"),
        "MPLCONFIGDIR": str(folder / "matplotlib"),
        "MPLBACKEND": "agg",
    }
    done = subprocess.run(
        line,
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=NOTEBOOK_LIMIT_S,
        check=False,
    )
    assert done.returncode == 0, f"{line}: {done.returncode}\n{done.stdout}{done.stderr}"
    return done.stdout


def cells(name: str, folder: Path, python: str = sys.executable) -> str:
    """Returns the output of a notebook's cells."""
    support.needs(*NEEDED)
    notebook = ROOT / "docs/notebooks" / f"{name}.ipynb"
    return printed([python, __file__, execute.__name__, notebook], folder)


def numbers(said: str, begin: str) -> list[float]:
    """Returns the numbers of the line that begins with these words."""
    line = next((line for line in said.splitlines() if line.startswith(begin)), None)
    assert line is not None, f"no line begins with {begin!r}:\n{said}"
    found = []
    for word in line.replace(",", " ").split():
        try:
            found.append(float(word.strip("()")))
        except ValueError:
            pass
    return found


def test_a_first_controller_bends_the_tool(tmp_path: Path) -> None:
    said = cells("first_controller", tmp_path)
    assert numbers(said, "2001 states")[1:] == [0.410, 0.5], said


def test_a_log_draws_its_states_and_frames(tmp_path: Path) -> None:
    said = cells("log_to_figures", tmp_path)
    for line in ("replayed 3000 ticks, all identical", "3001 states of", "16 frames"):
        assert line in said, said


def test_branches_find_a_plan_that_is_carried_out_bit_for_bit(tmp_path: Path) -> None:
    said = cells("branch_and_plan", tmp_path)
    assert "the same hash: True" in said and numbers(said, "best:")[1] < 0.5, said


def test_the_planning_example_comes_within_a_third_of_a_millimetre_where_the_nominal_plan_misses(
    tmp_path: Path,
) -> None:
    """Plans in bone in which the burr's edges plough below 2 MPa; at 8 MPa the burr stalls, and no plan gets
    within 6 mm.
    """
    example = ROOT / "clients/python/examples/04_plan_by_branches.py"
    said = printed([sys.executable, example, "--branches", "12", "--rounds", "2"], tmp_path)
    assert numbers(said, "round 0:")[0] > 1.5 and numbers(said, "round 1:")[1] < 0.3, said


def test_designed_controllers_place_the_burr_of_tools_that_differ(tmp_path: Path) -> None:
    """The tension that is right for the nominal tool misses with the others by millimetres."""
    support.needs("control")
    example = ROOT / "clients/python/examples/06_design_on_linear_models.py"
    said = printed([sys.executable, example], tmp_path)
    assert numbers(said, "hold:")[1] > 1.0, said
    assert numbers(said, "LQR and Kalman:")[2] < 0.1 and numbers(said, "branches:")[2] < 0.1, said


def test_corrected_drillings_follow_the_curve_that_the_plan_misses(tmp_path: Path) -> None:
    """Drills the first 9 mm with one tool: the drillings of docs/control.md take minutes."""
    support.needs("control")
    example = ROOT / "clients/python/examples/07_drill_with_feedback.py"
    options = ("--points", "1", "--periods", "22", "--tensions", "3")
    said = printed([sys.executable, example, *options], tmp_path)
    assert numbers(said, "none:")[1] > 0.4, said
    assert numbers(said, "LQR and Kalman:")[1] < 0.35 and numbers(said, "branches:")[1] < 0.2, said


def within(said: str, begin: str, allowed: tuple[float, float, float]) -> None:
    missed = numbers(said, begin)[:3]
    assert len(missed) == 3 and all(m < a for m, a in zip(missed, allowed)), said


def test_a_registration_finds_the_c_arm_of_one_frame(tmp_path: Path) -> None:
    """Registration starts 5 degrees and 10 mm off. A single image is least informative along the beam."""
    said = cells("register_c_arm", tmp_path)
    assert abs(numbers(said, "start:")[0] - 5.0) < 1e-3, said
    within(said, "registered:", (0.05, 0.1, 0.02))


def test_the_projector_of_nanodrr_agrees(tmp_path: Path) -> None:
    """`TRABECULA_NANODRR_PYTHON` is a Python with nanodrr, the modules of these tests and the package."""
    python = os.environ.get("TRABECULA_NANODRR_PYTHON")
    if not python:
        # Also in CI: PyTorch is too large for it.
        pytest.skip("*** TRABECULA_NANODRR_PYTHON names no Python with nanodrr ***")
    said = cells("register_c_arm", tmp_path, python)
    assert numbers(said, "both projectors at the same pose:")[0] > 0.99999, said
    within(said, "nanodrr:", (0.15, 0.6, 0.05))


def test_a_sweep_names_the_parameter_that_decides(tmp_path: Path) -> None:
    """For a tool in free space held by one tendon, the tension dominates the bend."""
    said = cells("sweep_and_sensitivities", tmp_path)
    assert "80 runs, 80 completed" in said, said
    # Rank correlation, first order and its interval, total and its interval.
    assert numbers(said, "controller.0.hold.tension_n")[3] > 0.9, said
    assert numbers(said, "manipulator.stiffness_scale")[3] < 0.2, said


def test_an_identified_tool_predicts_a_third_experiment(tmp_path: Path) -> None:
    """The truth lies within the joint region of 99 %, and the held-out error is that of its noise, 0.05 mm. The band,
    which the steps of the voxels widen, is below two standard deviations of the noise.

    The three estimates are nearly uncorrelated, so the squares of their errors over the standard deviations add up
    to a chi-square of three degrees of freedom, whose 99 % quantile is 11.34. The seed of the noise is fixed.
    """
    said = cells("identify_a_tool", tmp_path)
    squares = 0.0
    for key, truth in (("stiffness_scale", 1.2), ("tendon_friction", 0.1), ("cutting_coefficient", 2.0)):
        section = "drilling" if key == "cutting_coefficient" else "manipulator"
        value, low, high = numbers(said, f"truth.{section}.{key}:")[:3]
        squares += ((value - truth) / ((high - low) / (2.0 * 1.96))) ** 2
    assert squares < 11.34, said
    for column in ("x", "z"):
        error, band, inside = numbers(said, f"third {column}:")[:3]
        assert 0.03 < error < 0.08 and band < 0.1 and inside > 0.85, said


if __name__ == "__main__":
    support.main(globals())
