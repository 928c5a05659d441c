"""Trains an agent to drill to a target that varies between episodes, and compares it with the plan of the
built-in scene.

    pip install 'trabecula[gym]' stable-baselines3 matplotlib
    python3 train_to_target.py --minutes 6 --output out/training

Soft actor-critic (stable-baselines3) learns in `trabecula/CurvedDrilling-v0` what to add to the plan's
tension and feed. Both drill to targets of seeds not used in training: the agent observes the target, while
the built-in plan is the scene's own, for the mean target. Prints for both how close the burr came, and writes
`training.csv`, `training.png` and the agent to the folder, which must not exist.
"""

from __future__ import annotations

import argparse
import csv
import time
import tomllib
from pathlib import Path
from typing import Any, Callable

import gymnasium
import numpy as np
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from trabecula.gym import CurvedDrilling

#: Ticks per action: 0.4 s.
TICKS = 400
#: Maximum that the agent can add to the plan's action, whose range is -1 to 1.
MOST_ADDED = 0.4
#: First seed of the evaluation targets; training draws its own from another one.
HELD_OUT = 10_000
#: Scales that observations are divided by: positions, insertion, bend, tension, displacement, forces.
SCALE = np.array([30.0, 10.0, 1.0, 30.0, 1.0, 10.0, 5.0, 5.0, 10.0], np.float32)


def open_loop(scene_toml: str) -> Callable[[Any], Any]:
    """Returns the actions of the scene's own plan: its feed, and tension that rises along its ramp."""
    plan = tomllib.loads(scene_toml)["controller"][0]["curved_drilling"]
    begin_mm, end_mm = plan["ramp_start_mm"], plan["ramp_end_mm"]

    def act(seen: Any) -> Any:
        inserted_mm = float(seen[3])
        tension_n = plan["tension_n"] * np.clip((inserted_mm - begin_mm) / (end_mm - begin_mm), 0.0, 1.0)
        limits = np.array([CurvedDrilling.MOST_TENSION_N, CurvedDrilling.MOST_FEED_MM_PER_S])
        return (2.0 * np.array([tension_n, plan["feed_mm_per_s"]]) / limits - 1.0).astype(np.float32)

    return act


class Corrected(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Actions are added to the plan's, and observations are scaled for learning."""

    def __init__(self, env: CurvedDrilling) -> None:
        super().__init__(gymnasium.wrappers.TimeLimit(env, max_episode_steps=60))
        self._plan = open_loop(env.sim.scene_toml)

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        self._seen, info = super().reset(**options)
        return self._seen / SCALE, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        planned = self._plan(self._seen) + MOST_ADDED * np.asarray(action, np.float32)
        self._seen, *others = super().step(np.clip(planned, -1.0, 1.0))
        return (self._seen / SCALE, *others)


def judged(env: gymnasium.Env[Any, Any], act: Callable[[Any], Any], episodes: int) -> list[float]:
    """Returns the smallest distance from the target in each episode, mm."""
    least = []
    for seed in range(HELD_OUT, HELD_OUT + episodes):
        seen, info = env.reset(seed=seed)
        nearest, ended = info["distance_mm"], False
        while not ended:
            seen, _, over, cut, info = env.step(act(seen))
            nearest, ended = min(nearest, info["distance_mm"]), over or cut
        least.append(nearest)
    return least


class Course(BaseCallback):
    """Ends training when its time is over, and records each episode."""

    def __init__(self, minutes: float) -> None:
        super().__init__()
        self._until = time.monotonic() + 60.0 * minutes
        self.rows: list[tuple[int, float, float]] = []

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "episode" in info:
                self.rows.append((self.num_timesteps, info["episode"]["r"], info["distance_mm"]))
        return time.monotonic() < self._until


def described(name: str, least_mm: list[float]) -> str:
    reached = sum(x < CurvedDrilling.REACHED_MM for x in least_mm)
    return (
        f"{name:<12} median {np.median(least_mm):.2f} mm, worst {max(least_mm):.2f} mm, "
        f"{reached} of {len(least_mm)} within 0.3 mm"
    )


def draw(rows: list[tuple[int, float, float]], baseline: float, file: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    steps, rewards, ends = (np.array(column) for column in zip(*rows))
    figure, (upper, lower) = pyplot.subplots(2, 1, sharex=True, figsize=(8.8, 6.0))
    upper.plot(steps, rewards, ".", color="#0072b2", markersize=3)
    upper.set_ylabel("return of an episode")
    lower.semilogy(steps, ends, ".", color="#0072b2", markersize=3)
    lower.axhline(baseline, color="#d55e00", dashes=(6, 3), label="built-in plan, median of held-out targets")
    lower.set_xlabel("actions of 0.4 s")
    lower.set_ylabel("last distance from the target (mm)")
    lower.legend()
    figure.savefig(file, dpi=150, bbox_inches="tight")


def main() -> None:
    arguments = argparse.ArgumentParser(description="Train an agent to drill to a moving target.")
    arguments.add_argument("--minutes", type=float, default=6.0)
    arguments.add_argument("--episodes", type=int, default=30, help="held-out targets")
    arguments.add_argument("--output", type=Path, default=Path("out/training"))
    given = arguments.parse_args()
    given.output.mkdir(parents=True, exist_ok=False)
    env = Monitor(Corrected(CurvedDrilling(ticks=TICKS)))
    plan = judged(env, lambda _: np.zeros(2, np.float32), given.episodes)
    print(described("built-in plan", plan), flush=True)
    agent = SAC(
        "MlpPolicy",
        env,
        seed=1,
        learning_rate=1e-3,
        learning_starts=300,
        batch_size=256,
        gamma=0.97,
        policy_kwargs={"net_arch": [64, 64]},
        device="cpu",
    )
    course = Course(given.minutes)
    agent.learn(total_timesteps=10**9, callback=course)
    print(f"{len(course.rows)} episodes, {agent.num_timesteps} actions", flush=True)
    trained = judged(env, lambda seen: agent.predict(seen, deterministic=True)[0], given.episodes)
    print(described("agent", trained))
    agent.save(given.output / "agent")
    with open(given.output / "training.csv", "x", newline="") as file:
        csv.writer(file).writerows([("actions", "return", "last_distance_mm"), *course.rows])
    draw(course.rows, float(np.median(plan)), given.output / "training.png")


if __name__ == "__main__":
    main()
