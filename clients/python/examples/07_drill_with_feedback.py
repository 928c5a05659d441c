"""Drills a curve with tools and bone that differ from the plan, and corrects the tension by three controllers.

The tools, tendons, bone and registration are those of `configs/sweeps/robustness.toml`. The controllers read
the burr's place every 0.2 s with a noise of 0.05 mm and know only the nominal scene, whose own tensions they
correct:

- the built-in controller with shape feedback (without noise), and without feedback;
- a linear-quadratic regulator with a Kalman observer (python-control). A linear model of a tick holds the bone
  as it is, and in a hole its burr hardly moves: the model is the first-order response of the burr to a newton,
  fitted to branches of the nominal drilling. Whatever else moves the burr is an offset that the observer estimates;
- a model-predictive controller: the best of several tensions, each tried for 0.4 s on a branch.

    pip install control==0.10.2
    python3 clients/python/examples/07_drill_with_feedback.py

A short trial: `--points 1`; `--periods 22`, of 62, stops early; with `--tensions 3`, of 7, the branches try fewer.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any, Callable

import control  # type: ignore
import numpy as np
import numpy.typing as npt

import trabecula
from trabecula.sim import Batch, Sim

Floats = npt.NDArray[np.float64]

SCENE = Path(__file__).parents[3] / "configs/examples/truth.toml"
#: The plan of the scene: where the burr starts and the curve begins, and the target, x and z in mm.
START_MM, BEGIN_MM, TARGET_MM = -14.0, -12.0, np.array([5.0, 8.0])
INSERTION_M, FEED_M_PER_S, BURR_RAD_PER_S = 0.023, 0.002, 8000.0 * 2.0 * np.pi / 60.0
#: Ticks in a control period, and periods in a complete drilling.
TICKS, PERIODS = 200, 62
NOISE_MM, MOST_N = 0.05, 5.0
NOMINAL: dict[str, Any] = {
    "truth.manipulator.stiffness_scale": 1.0,
    "truth.registration_error_mm": [0.0, 0.0, 0.0],
    "truth.registration_error_deg": [0.0, 0.0, 0.0],
}


def points(count: int) -> list[dict[str, Any]]:
    """Returns tools and bones, drawn from the ranges of `configs/sweeps/robustness.toml`."""
    random = np.random.default_rng(1)
    return [
        {
            "truth.manipulator.stiffness_scale": random.uniform(0.8, 1.2),
            "truth.manipulator.tendon_friction": random.uniform(0.0, 0.3),
            "truth.registration_error_mm": [random.uniform(-0.5, 0.5), 0.0, 0.0],
            "truth.drilling.cutting_coefficient": float(np.exp(random.uniform(np.log(0.5), np.log(4.0)))),
        }
        for _ in range(count)
    ]


def simulation(overrides: dict[str, Any], **more: Any) -> Sim:
    """Returns a simulation of the scene with the nominal tool, except for some values."""
    return Sim(SCENE, overrides={**NOMINAL, **overrides}, **more)


def burrs_mm(states: npt.NDArray[np.void]) -> Floats:
    """Returns the burrs' places in the plane of the curve, x and z."""
    return 1e3 * states["t_world_burr"]["position_m"][..., [0, 2]]


def burr_mm(sim: Sim) -> Floats:
    """Returns the burr's place in the plane of the curve, x and z."""
    return 1e3 * np.array(sim.state.t_world_burr.position_m)[[0, 2]]


def planned_mm(z_mm: Floats) -> Floats:
    """Returns the curve's x: the arc that is tangent to the axis where it begins and leads to the target."""
    x_mm, ahead_mm = TARGET_MM[0], np.maximum(z_mm - BEGIN_MM, 0.0)
    radius_mm = ((TARGET_MM[1] - BEGIN_MM) ** 2 + x_mm**2) / (2.0 * x_mm)
    curve_mm: Floats = radius_mm - np.sqrt(radius_mm**2 - ahead_mm**2)
    return curve_mm


def fill(commands: npt.NDArray[np.void], tension_n: Any) -> None:
    """Fills in commands that continue drilling with these tensions."""
    commands["tendon_mode"] = trabecula.TendonMode.SERVO_JF
    commands["tendon_force_n"][..., 0] = tension_n
    commands["arm_mode"] = trabecula.ArmMode.INSERT
    commands["arm_axis"] = [0.0, 0.0, 1.0]
    commands["arm_depth_m"] = INSERTION_M
    commands["arm_speed_m_per_s"] = FEED_M_PER_S
    commands["burr_mode"] = trabecula.BurrMode.SPEED
    commands["burr_speed_rad_per_s"] = BURR_RAD_PER_S


def pull(sim: Sim, tension_n: float) -> None:
    """Drills for a control period with a tension."""
    command = trabecula.Command()
    fill(command.array, tension_n)
    sim.step(command, ticks=TICKS)


class Nominal:
    """The drilling as planned: its tensions, and the burr's response to a newton on branches, from period to
    period response[k + 1] = a response[k] + b.
    """

    def __init__(self, periods: int) -> None:
        plan = simulation({"controller.0.curved_drilling.feedback": "none"})
        self.tension_n = np.array([plan.step(ticks=TICKS).tendon_tension_n[0] for _ in range(periods)])
        self.sim = simulation({}, drive=True)
        self.start = self.sim.snapshot()
        batch = Batch(SCENE, n=2, overrides=NOMINAL, drive=True)
        before_mm, after_mm = [], []
        for period, tension_n in enumerate(self.tension_n):
            if period in (15, 30, 45):
                batch.restore(self.sim.snapshot())
                commands = batch.commands()
                response_mm = [0.0]
                for later in self.tension_n[period : period + 6]:
                    fill(commands[:, 0], later + np.array([0.0, 0.5]))
                    states = batch.step(commands, ticks=TICKS)
                    response_mm.append(float(np.diff(burrs_mm(states)[:, 0])[0]) / 0.5)
                before_mm += response_mm[:-1]
                after_mm += response_mm[1:]
            pull(self.sim, float(tension_n))
        columns = np.stack([before_mm, np.ones(len(before_mm))], axis=1)
        self.a, self.b = np.linalg.lstsq(columns, np.array(after_mm), rcond=None)[0]


class Regulator:
    """A linear-quadratic regulator of the burr's distance from the curve, with a Kalman observer of the response
    to its corrections and of the offset that they do not explain.
    """

    def __init__(self, nominal: Nominal) -> None:
        self.a, self.b = nominal.a, nominal.b
        self.feedback = float(control.dlqr([[self.a]], [[self.b]], [[1.0 / 0.1**2]], [[1.0 / 0.5**2]])[0][0, 0])
        noise = np.diag([0.02**2, 0.03**2])
        whole = np.diag([self.a, 1.0])
        self.gain = control.dlqe(whole, np.eye(2), [[1.0, 1.0]], noise, [[NOISE_MM**2]])[0][:, 0]
        self.response_mm, self.offset_mm = 0.0, 0.0

    def choose(self, seen_mm: Floats, planned_n: float) -> float:
        """Returns the tension for the next period."""
        off_mm = float(seen_mm[0] - planned_mm(seen_mm[1]))
        surprise_mm = off_mm - self.response_mm - self.offset_mm
        self.response_mm += self.gain[0] * surprise_mm
        self.offset_mm += self.gain[1] * surprise_mm
        steady_n = -self.offset_mm * (1.0 - self.a) / self.b
        more_n = steady_n - self.feedback * (self.response_mm + self.offset_mm)
        tension_n = within(planned_n + more_n) if planned_n > 0.0 else 0.0
        self.response_mm = self.a * self.response_mm + self.b * (tension_n - planned_n)
        return tension_n


class Predictor:
    """Chooses the best of several tensions, each tried for 0.4 s on a branch of the nominal drilling, moved by
    the observed distance of the burr from it.
    """

    def __init__(self, nominal: Nominal, tensions: int) -> None:
        self.steps_n = np.array([0.0, -0.3, 0.3, -0.1, 0.1, -0.03, 0.03])[:tensions]
        self.sim, self.batch = nominal.sim, Batch(SCENE, n=len(self.steps_n), overrides=NOMINAL, drive=True)
        self.sim.restore(nominal.start)
        self.offset_mm, self.more_n = 0.0, 0.0

    def choose(self, seen_mm: Floats, planned_n: float) -> float:
        """Returns the tension for the next period."""
        model_mm = float(burr_mm(self.sim)[0])
        self.offset_mm += 0.3 * (float(seen_mm[0] - model_mm) - self.offset_mm)
        tried_n = np.array([within(planned_n + self.more_n + step) for step in self.steps_n])
        self.batch.restore(self.sim.snapshot())
        commands = self.batch.commands()
        fill(commands[:, 0], tried_n)
        cost = (0.05 * self.steps_n) ** 2
        for _ in range(2):
            places_mm = burrs_mm(self.batch.step(commands, ticks=TICKS))
            cost = cost + (places_mm[:, 0] + self.offset_mm - planned_mm(places_mm[:, 1])) ** 2
        if planned_n > 0.0:
            self.more_n = float(tried_n[np.argmin(cost)]) - planned_n
        tension_n = planned_n + self.more_n
        pull(self.sim, tension_n)
        return tension_n


def within(tension_n: float) -> float:
    """Limits a tension."""
    return float(np.clip(tension_n, 0.0, MOST_N))


def miss_mm(sim: Sim, point: dict[str, Any], periods: int) -> float:
    """Returns the burr's distance from where the target truly is; after a part of the drilling, from the curve."""
    if periods < PERIODS:
        x_mm, z_mm = burr_mm(sim)
        return abs(float(x_mm - planned_mm(z_mm)))
    target_mm = TARGET_MM + [point["truth.registration_error_mm"][0], 0.0]
    return float(np.linalg.norm(burr_mm(sim) - target_mm))


#: Returns a controller for the nominal drilling.
Kind = Callable[[Nominal], "Regulator | Predictor"]


def drilled_mm(point: dict[str, Any], kind: Kind, nominal: Nominal, seed: int) -> float:
    """Drills with a controller; returns by how much the target is missed."""
    plant, controller, random = simulation(point, drive=True), kind(nominal), np.random.default_rng(seed)
    for planned_n in nominal.tension_n:
        seen_mm = burr_mm(plant) + random.normal(0.0, NOISE_MM, 2)
        pull(plant, controller.choose(seen_mm, float(planned_n)))
    return miss_mm(plant, point, len(nominal.tension_n))


def main() -> None:
    arguments = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    arguments.add_argument("--points", type=int, default=8)
    arguments.add_argument("--periods", type=int, default=PERIODS, choices=range(16, PERIODS + 1), metavar="N")
    arguments.add_argument("--tensions", type=int, default=7, choices=range(1, 8), metavar="N")
    given = arguments.parse_args()
    nominal = Nominal(given.periods)
    kinds: dict[str, Kind] = {
        "LQR and Kalman": Regulator,
        "branches": partial(Predictor, tensions=given.tensions),
    }
    misses_mm: dict[str, list[float]] = {name: [] for name in ("none", "shape", *kinds)}
    for seed, point in enumerate(points(given.points)):
        for feedback in ("none", "shape"):
            plant = simulation({**point, "controller.0.curved_drilling.feedback": feedback})
            plant.step(ticks=TICKS * given.periods)
            misses_mm[feedback].append(miss_mm(plant, point, given.periods))
        for name, kind in kinds.items():
            misses_mm[name].append(drilled_mm(point, kind, nominal, seed))
    print(f"response a {nominal.a:.2f}, b {nominal.b:.2f} mm/N; miss, {given.points} points, mm")
    for name, misses in misses_mm.items():
        print(f"{name}: lowest {min(misses):.2f}, median {np.median(misses):.2f}, highest {max(misses):.2f}")


if __name__ == "__main__":
    main()
