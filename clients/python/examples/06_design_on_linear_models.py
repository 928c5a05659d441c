"""Places the burr with controllers designed on the nominal tool, and tries them on tools that differ.

A linear-quadratic regulator with a Kalman observer (python-control) is designed on `Sim.linearize`; a
model-predictive controller plans on branches of a nominal simulation.
Both read the burr's deflection every 5 ms with a noise of 0.05 mm. The built-in `hold` pulls with the tension
that is right for the nominal tool. The tools are up to 20 % softer or stiffer, and their tendons rub.

    pip install control==0.10.2
    python3 clients/python/examples/06_design_on_linear_models.py
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import control  # type: ignore
import numpy as np

import trabecula
from trabecula.sim import Batch, Sim

SCENE = Path(__file__).parents[3] / "configs/free_space.toml"
#: Ticks in a control period, and periods in a trial: 1 s.
TICKS, PERIODS = 5, 200
START_N, GOAL_N, MOST_N = 5.0, 6.5, 20.0
NOISE_M = 5e-5
TOOLS = [
    {"truth.manipulator.stiffness_scale": stiffness, "truth.manipulator.tendon_friction": friction}
    for stiffness in (0.8, 0.9, 1.0, 1.1, 1.2)
    for friction in (0.0, 0.3)
]


def pull(tension_n: float) -> trabecula.Command:
    """Returns the command of a tension."""
    command = trabecula.Command()
    command.tendon_mode = trabecula.TendonMode.SERVO_JF
    command.tendon_force_n[0] = tension_n
    return command


def deflection_m(sim: Sim) -> float:
    """Returns the burr's place along the bend."""
    return float(sim.state.t_world_burr.position_m[2])


def settled(tension_n: float, **overrides: Any) -> Sim:
    """Returns a simulation at rest under a tension."""
    sim = Sim(SCENE, overrides=overrides or None, drive=True)
    sim.step(pull(tension_n), ticks=1000)
    return sim


class Regulator:
    """A linear-quadratic regulator around the tension that removes the offset of the real burr from the
    model's, and a Kalman filter for the tool's state and this offset.
    """

    def __init__(self, nominal: Sim) -> None:
        model = nominal.linearize(
            pull(START_N), inputs="tendon_force_n[0]", outputs="t_world_burr.position_m[2]"
        )
        tool = model.select("mount.*", "flexure_*")
        powers = [np.linalg.matrix_power(tool.A, tick) for tick in range(TICKS + 1)]
        self.a, self.b = powers[TICKS], sum(powers[:TICKS]) @ tool.B
        n = len(self.a)
        weight = tool.C.T @ tool.C / 1e-4**2 + 1e-12 * np.eye(n)
        self.feedback = control.dlqr(self.a, self.b, weight, [[1.0 / 0.5**2]])[0][0]
        self.steady = np.linalg.solve(np.eye(n) - self.a, self.b)[:, 0]
        self.m_per_n = float((tool.C @ self.steady)[0])
        # The offset is a random walk.
        whole = np.block([[self.a, np.zeros((n, 1))], [np.zeros((1, n)), np.eye(1)]])
        spread = np.zeros((n + 1, 2))
        spread[:n, 0], spread[n, 1] = self.b[:, 0], 1.0
        self.seen = np.append(tool.C[0], 1.0)
        noise = np.diag([0.1**2, 2e-5**2])
        self.gain = control.dlqe(whole, spread, self.seen[None], noise, [[NOISE_M**2]])[0][:, 0]
        self.state = np.zeros(n + 1)

    def choose(self, measured_m: float, goal_m: float) -> float:
        """Returns the tension above that of the start."""
        self.state = self.state + self.gain * (measured_m - self.seen @ self.state)
        x, offset_m = self.state[:-1], self.state[-1]
        steady_n = (goal_m - offset_m) / self.m_per_n
        more_n = within(steady_n - self.feedback @ (x - self.steady * steady_n))
        self.state[:-1] = self.a @ x + self.b[:, 0] * more_n
        return more_n


class Predictor:
    """Chooses the best of many tensions, each tried for 20 ms on a branch of the nominal simulation."""

    def __init__(self, nominal: Sim) -> None:
        self.nominal, self.batch = nominal, Batch(SCENE, n=15, drive=True)
        self.start_m, self.offset_m, self.more_n = deflection_m(nominal), 0.0, 0.0

    def choose(self, measured_m: float, goal_m: float) -> float:
        """Returns the tension above that of the start."""
        self.offset_m += 0.1 * (measured_m - (deflection_m(self.nominal) - self.start_m) - self.offset_m)
        steps_n = np.concatenate([[0.0], *([-s, s] for s in np.geomspace(0.01, 1.0, 7))])
        tried_n = np.array([within(self.more_n + step_n) for step_n in steps_n])
        self.batch.restore(self.nominal.snapshot())
        commands = self.batch.commands()
        commands["tendon_mode"] = trabecula.TendonMode.SERVO_JF
        commands["tendon_force_n"][:, 0, 0] = START_N + tried_n
        cost = (0.1 * (tried_n - self.more_n)) ** 2
        for _ in range(4):
            states = self.batch.step(commands, ticks=TICKS)
            burr_m = states["t_world_burr"]["position_m"][:, 2] - self.start_m + self.offset_m
            cost = cost + ((burr_m - goal_m) / 1e-3) ** 2
        self.more_n = float(tried_n[np.argmin(cost)])
        self.nominal.step(pull(START_N + self.more_n), ticks=TICKS)
        return self.more_n


class Hold:
    """The tension that is right for the nominal tool, as the built-in `hold` pulls."""

    def __init__(self, _: Sim) -> None:
        pass

    def choose(self, _measured_m: float, _goal_m: float) -> float:
        """Returns the tension above that of the start."""
        return GOAL_N - START_N


def within(more_n: float) -> float:
    """Limits the tension to 0 to `MOST_N`."""
    return float(np.clip(more_n, -START_N, MOST_N - START_N))


def main() -> None:
    nominal = settled(START_N)
    here, start_m = nominal.snapshot(), deflection_m(nominal)
    goal_m = deflection_m(settled(GOAL_N)) - start_m
    kinds: dict[str, type[Hold] | type[Regulator] | type[Predictor]] = {
        "hold": Hold,
        "LQR and Kalman": Regulator,
        "branches": Predictor,
    }
    errors_mm: dict[str, list[float]] = {name: [] for name in kinds}
    for index, tool in enumerate(TOOLS):
        plant = settled(START_N, **tool)
        begin = plant.snapshot()
        for name, kind in kinds.items():
            nominal.restore(here)
            plant.restore(begin)
            controller, random, missed_m = kind(nominal), np.random.default_rng(index), []
            for _ in range(PERIODS):
                measured_m = deflection_m(plant) - start_m + random.normal(0.0, NOISE_M)
                plant.step(pull(START_N + controller.choose(measured_m, goal_m)), ticks=TICKS)
                missed_m.append(deflection_m(plant) - start_m - goal_m)
            errors_mm[name].append(1e3 * float(np.sqrt(np.mean(np.square(missed_m[PERIODS // 2 :])))))
    print(f"goal {1e3 * goal_m:.2f} mm from the start; error in the last half second, {len(TOOLS)} tools, mm")
    for name, errors in errors_mm.items():
        print(f"{name}: lowest {min(errors):.3f}, median {np.median(errors):.3f}, highest {max(errors):.3f}")


if __name__ == "__main__":
    main()
