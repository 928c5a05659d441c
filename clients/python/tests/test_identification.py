"""`trabecula.sim.identify` compared with SciPy's least squares driving `trabecula.sim`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Callable

import numpy as np
import pytest
import support
import trabecula
from trabecula.sim import Sim, identify

(optimize,) = support.needs("scipy.optimize")

SCENE = """
name = "bench"
[run]
mode = "lockstep"
duration_s = 0.4
[tool]
burr_start_mm = [0.0, 0.0, 0.0]
direction = [0.0, 0.0, 1.0]
bend_toward = [1.0, 0.0, 0.0]
[[controller]]
name = "bench"
drives = ["tendon"]
external = true
"""
#: Time, s, and tension, N.
PULLS = ((0.0, 0.0), (0.02, 5.0), (0.1, 9.0), (0.18, 4.0), (0.26, 7.0))
TICKS, TICK_S = 400, 0.001
NOISE_DEG = 0.1

STIFFNESS = ("manipulator.stiffness_scale", 0.5, 2.0)
FRICTION = ("manipulator.tendon_friction", 0.0, 0.4)
DAMPING = ("manipulator.damping_ratio", 0.05, 1.0)
DELAY = ("measured.bend.delay_ms", 0.0, 30.0)
BIAS = ("measured.bend.bias", -3.0, 3.0)
GAIN = ("command.pull.gain", 0.5, 1.5)

Parameter = tuple[str, float, float]


def study(parameters: tuple[Parameter, ...], more: str) -> str:
    tables = "".join(f'[[parameter]]\nkey = "{key}"\nmin = {low}\nmax = {high}\nstep = 1e-5\n' for key, low, high in parameters)
    return f"""{more}
{tables}
[[experiment]]
name = "pull"
scene = "scene.toml"
file = "measured.csv"
time = "t"
commands = {{ file = "commands.csv", column = [
    {{ name = "pull", field = "tendon_force_n[0]", column = "pull", unit = "N" }}] }}
[[experiment.measured]]
name = "bend"
of = "bend"
columns = ["bend"]
unit = "deg"
noise = {NOISE_DEG}
"""


def bend_deg(values: dict[str, float], scene: Path) -> Any:
    """Returns the bend at every tick, by the simulation alone."""
    keys = {key: value for key, value in values.items() if key.startswith("manipulator")}
    sim = Sim(scene, overrides=keys, drive=True)
    command = trabecula.Command()
    command.tendon_mode = trabecula.TendonMode.SERVO_JF
    bends = [sim.state.bend_rad]
    for tick in range(TICKS):
        tension_n = [pull for time, pull in PULLS if time <= tick * TICK_S + 1e-9][-1]
        command.tendon_force_n[0] = values.get("command.pull.gain", 1.0) * tension_n
        bends.append(sim.step(command).bend_rad)
    return np.degrees(bends)


def reported(values: dict[str, float], times: Any, scene: Path) -> Any:
    delay_s = values.get("measured.bend.delay_ms", 0.0) * 1e-3
    at = np.clip(times - delay_s, 0.0, TICKS * TICK_S)
    bends = np.interp(at, np.arange(TICKS + 1) * TICK_S, bend_deg(values, scene))
    return bends + values.get("measured.bend.bias", 0.0)


@pytest.mark.parametrize(
    ("parameters", "truth", "loss"),
    [
        ((STIFFNESS,), (1.2,), "linear"),
        ((STIFFNESS, FRICTION), (0.9, 0.12), "linear"),
        ((STIFFNESS, DAMPING, DELAY), (1.1, 0.3, 8.0), "linear"),
        ((GAIN, BIAS), (0.8, 1.0), "linear"),
        ((STIFFNESS, BIAS), (1.2, -0.5), "huber"),
    ],
)
def test_the_optimum_is_that_of_scipy(
    parameters: tuple[Parameter, ...], truth: tuple[float, ...], loss: str, tmp_path: Path
) -> None:
    """To a millionth of the range. Rows at 3/4 of a tick, so that values between ticks count; with Huber's loss, a
    tenth of the rows are outliers.
    """
    scene = tmp_path / "scene.toml"
    scene.write_text(SCENE)
    times = np.arange(0.03, 0.38, 0.00475)
    random = np.random.default_rng(5)
    names = [key for key, _, _ in parameters]
    measured = reported(dict(zip(names, truth)), times, scene) + NOISE_DEG * random.standard_normal(len(times))
    if loss == "huber":
        measured[::10] += 3.0
    rows = "".join(f"{time!r},{value!r}\n" for time, value in zip(times.tolist(), measured.tolist()))
    (tmp_path / "measured.csv").write_text("t,bend\n" + rows)
    (tmp_path / "commands.csv").write_text("t,pull\n" + "".join(f"{t},{pull}\n" for t, pull in PULLS))
    more = 'loss = "huber"\nhuber_sd = 2.0\n' if loss == "huber" else ""
    (tmp_path / "study.toml").write_text(study(parameters, more))
    result = identify(tmp_path / "study.toml")
    found = np.array([it["value"] for it in result["parameters"]])

    low = np.array([low for _, low, _ in parameters])
    span = np.array([high for _, _, high in parameters]) - low

    def residuals(unit: Any) -> Any:
        values = dict(zip(names, low + unit * span))
        return (reported(values, times, scene) - measured) / NOISE_DEG

    # From beside our optimum; a wrong optimum would not be SciPy's.
    theirs = optimize.least_squares(
        residuals, np.clip((found - low) / span + 0.01, 0.0, 1.0), bounds=(0.0, 1.0), jac="3-point",
        diff_step=1e-4, loss=loss, f_scale=2.0, xtol=1e-12, ftol=1e-14, gtol=1e-12,
    )
    assert np.max(np.abs((found - low) / span - theirs.x)) < 1e-6, (found, low + theirs.x * span)
    assert abs(theirs.cost - result["cost"][1]) < 1e-6 * theirs.cost
    if loss == "linear":
        covariance = np.linalg.inv(theirs.jac.T @ theirs.jac) * np.outer(span, span)
        # The steps of both differ, and the delay's derivative has a kink at each tick.
        assert np.allclose(covariance, result["covariance"], rtol=2e-2)


def refused(part: str, call: Callable[[], Any]) -> None:
    with pytest.raises(trabecula.ArgumentError) as raised:
        call()
    assert part in str(raised.value)


def test_bad_studies_raise_the_text_of_the_command(tmp_path: Path) -> None:
    file = tmp_path / "study.toml"
    refused("study.toml", lambda: identify(file))
    file.write_text(study((STIFFNESS,), "sart = 1"))
    refused("unknown field `sart`", lambda: identify(file))
    refused("expected 'fit', 'check' or 'design'", lambda: identify(file, "guess"))
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "commands.csv").write_text("t,pull\n0,1\n")
    (tmp_path / "measured.csv").write_text("t,bent\n0,1\n")
    file.write_text(study((STIFFNESS,), ""))
    refused("no column `bend` (did you mean `bent`?)", lambda: identify(file))
    (tmp_path / "measured.csv").write_text("t,bend\n0.1,1\n0.2,2\n")
    checked = identify(file, "check")
    assert checked["residual_count"] == 2, json.dumps(checked)


if __name__ == "__main__":
    support.main(globals())
