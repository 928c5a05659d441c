"""Plans the rest of a drilling from branches of one state: the cross-entropy method over tension and feed.

The burr's edges need a higher pressure to cut than the plan assumed. From the state at which the ramp begins,
many branches drill the rest, each with its own tensions and feed; the best of them define where to search
next. The same seed finds the same plan.

    python3 clients/python/examples/04_plan_by_branches.py [--branches N] [--rounds N]
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
import numpy.typing as npt

import trabecula
from trabecula.sim import Batch, Sim

Floats = npt.NDArray[np.float64]

TARGET_MM = np.array([-98.6, 2.3, 8.4])
#: Pressure below which the burr's edges plough instead of cutting.
BONE = {"drilling.edge_pressure_mpa": 2.0}
BURR_RAD_PER_S = 8000.0 * 2.0 * np.pi / 60.0
STRAIGHT_MM, WHOLE_MM = 3.0, 28.0
TICKS = 50
#: Tensions at the quarters of the rest, N, and the feed, mm/s: start of the search, its spread, and its
#: limits.
NOMINAL = np.array([2.0, 4.0, 6.0, 8.0, 1.5])
SPREAD = np.array([2.0, 2.0, 2.0, 2.0, 0.5])
LOW, HIGH = np.array([0.0, 0.0, 0.0, 0.0, 0.8]), np.array([20.0, 20.0, 20.0, 20.0, 3.0])


def axis_of(state: trabecula.State) -> Floats:
    """Returns the axis of the tool."""
    return trabecula.rotation_matrix(state.t_world_base.orientation_xyzw)[:, 2]


def fill(commands: npt.NDArray[np.void], axis: Floats, tension_n: Any, feed_mm_per_s: Any) -> None:
    """Fills in commands that continue drilling with these tensions and feeds."""
    commands["tendon_mode"] = trabecula.TendonMode.SERVO_JF
    commands["tendon_force_n"][..., 0] = tension_n
    commands["arm_mode"] = trabecula.ArmMode.INSERT
    commands["arm_axis"] = axis
    commands["arm_depth_m"] = WHOLE_MM * 1e-3
    commands["arm_speed_m_per_s"] = np.asarray(feed_mm_per_s) * 1e-3
    commands["burr_mode"] = trabecula.BurrMode.SPEED
    commands["burr_speed_rad_per_s"] = BURR_RAD_PER_S


def misses_mm(batch: Batch, start: Any, axis: Floats, flange_m: Floats, plans: Floats) -> Floats:
    """Returns the smallest distance of the burr from the target for each plan."""
    batch.restore(start)
    states, commands = batch.states, batch.commands()
    nearest = np.full(len(plans), np.inf)
    begin_mm = (states["t_world_flange"]["position_m"][0] - flange_m) @ axis * 1e3
    for _ in range(int((WHOLE_MM - begin_mm) / plans[:, 4].min() / (TICKS * 1e-3)) + 10):
        inserted_mm = (states["t_world_flange"]["position_m"] - flange_m) @ axis * 1e3
        share = np.clip((inserted_mm - begin_mm) / (WHOLE_MM - begin_mm), 0.0, 1.0)
        knots = (0.0, 0.25, 0.5, 0.75, 1.0)
        tension_n = [np.interp(s, knots, (0.0, *plan[:4])) for s, plan in zip(share, plans)]
        fill(commands[:, 0], axis, tension_n, plans[:, 4])
        states = batch.step(commands, ticks=TICKS)
        burr_mm = states["t_world_burr"]["position_m"] * 1e3
        nearest = np.minimum(nearest, np.linalg.norm(burr_mm - TARGET_MM, axis=1))
    return nearest


def main() -> None:
    arguments = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    arguments.add_argument("--branches", type=int, default=32)
    arguments.add_argument("--rounds", type=int, default=5)
    given = arguments.parse_args()
    sim = Sim(overrides=BONE, drive=True)
    axis, flange_m = axis_of(sim.state), np.array(sim.state.t_world_flange.position_m)
    command = trabecula.Command()
    fill(command.array, axis, 0.0, 1.5)
    while (sim.state.t_world_flange.position_m - flange_m) @ axis < STRAIGHT_MM * 1e-3:
        sim.step(command, ticks=TICKS)
    start = sim.snapshot()
    batch = Batch(n=given.branches, overrides=BONE, drive=True)
    random = np.random.default_rng(1)
    mean, spread = NOMINAL.copy(), SPREAD.copy()
    print(f"branches from tick {sim.tick}, {sim.state.removed_total} voxels drilled")
    best, found = NOMINAL, np.inf
    for number in range(given.rounds):
        plans = np.clip(mean + spread * random.standard_normal((given.branches, 5)), LOW, HIGH)
        # The first plan is the mean itself; in the first round that is the nominal plan.
        plans[0] = mean
        misses = misses_mm(batch, start, axis, flange_m, plans)
        order = np.argsort(misses, kind="stable")
        elite = plans[order[: max(2, given.branches // 6)]]
        if misses[order[0]] < found:
            best, found = plans[order[0]], float(misses[order[0]])
        print(
            f"round {number}: mean plan misses by {misses[0]:6.3f} mm, best {misses[order[0]]:6.3f} mm, "
            f"{batch.states['tick'].sum()} ticks"
        )
        mean, spread = elite.mean(axis=0), elite.std(axis=0) + 0.02
    print(
        f"best plan: tensions {np.round(best[:4], 2).tolist()} N, feed {best[4]:.2f} mm/s, "
        f"misses by {found:.3f} mm"
    )


if __name__ == "__main__":
    main()
