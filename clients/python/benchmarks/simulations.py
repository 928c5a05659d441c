"""Benchmarks `trabecula.sim` in the default scene: steps per second, reset, snapshot, branches, memory.

    python3 clients/python/benchmarks/simulations.py [TICKS]

Times are medians; on a shared machine only their ratios within a run are meaningful. For the speed of the
physics alone, in the same ticks: `cargo run --release -p sim --example step_rate`.
"""

from __future__ import annotations

import statistics
import sys
import time
from pathlib import Path
from typing import Callable

import numpy as np
import trabecula
from trabecula.sim import Batch, Sim

FEED_M_PER_S = 0.0015


def command_at(axis: np.ndarray, tick: int) -> trabecula.Command:
    """Drills the curve like the built-in controller, without its guidance."""
    command = trabecula.Command()
    command.tendon_mode = trabecula.TendonMode.SERVO_JF
    command.tendon_force_n[0] = min(max(8.0 * (tick * 0.0015 - 3.0) / 21.0, 0.0), 8.0)
    command.arm_mode = trabecula.ArmMode.INSERT
    command.arm_axis[:] = axis
    command.arm_depth_m = 0.028
    command.arm_speed_m_per_s = FEED_M_PER_S
    command.burr_mode = trabecula.BurrMode.SPEED
    command.burr_speed_rad_per_s = 8000.0 * 2.0 * np.pi / 60.0
    return command


def axis_of(sim: Sim) -> np.ndarray:
    return trabecula.rotation_matrix(sim.state.t_world_base.orientation_xyzw)[:, 2]


def seconds(work: Callable[[], object]) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def median_ms(work: Callable[[], object], count: int = 51) -> float:
    return 1e3 * statistics.median(seconds(work) for _ in range(count))


def resident_mb() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6


def main() -> None:
    ticks = int(sys.argv[1]) if len(sys.argv) > 1 else 20_000
    before_mb = resident_mb()
    sim = Sim(drive=True)
    print(f"first simulation           {resident_mb() - before_mb:8.0f} MB with the volume")
    axis = axis_of(sim)
    one_by_one: list[float] = []
    by_twenty: list[float] = []
    for begin in range(0, ticks, 1000):
        here = sim.snapshot()
        commands = [command_at(axis, tick) for tick in range(begin, begin + 1000, 20)]
        one_by_one.append(seconds(lambda: [sim.step(command) for command in commands for _ in range(20)]))
        end = sim.hash
        sim.restore(here)
        by_twenty.append(seconds(lambda: [sim.step(command, ticks=20) for command in commands]))
        assert sim.hash == end
    print(f"step(command)              {ticks / sum(one_by_one):8.0f} ticks per second")
    percent = 100 * sum(by_twenty) / sum(one_by_one)
    print(
        f"step(command, ticks=20)    {ticks / sum(by_twenty):8.0f} ticks per second; "
        f"single steps reach {percent:.1f} % of that"
    )
    while sim.state.removed_total < 8000 and sim.tick < 60_000:
        sim.step(command_at(axis, sim.tick), ticks=100)
    drilled = sim.state.removed_total
    print(f"snapshot                   {median_ms(sim.snapshot):8.3f} ms after {drilled} voxels")
    here = sim.snapshot()
    command = command_at(axis, sim.tick)

    def away_and_back() -> float:
        sim.step(command, ticks=10)
        return seconds(lambda: sim.restore(here))

    def away_and_reset() -> float:
        sim.restore(here)
        return seconds(sim.reset)

    restore_s = statistics.median(away_and_back() for _ in range(51))
    print(f"restore                    {1e3 * restore_s:8.3f} ms")
    reset_s = statistics.median(away_and_reset() for _ in range(51))
    print(f"reset                      {1e3 * reset_s:8.3f} ms")
    sim.restore(here)
    before_mb = resident_mb()
    made_s = seconds(lambda: globals().__setitem__("batch", Batch(n=64, drive=True)))
    batch: Batch = globals()["batch"]
    batch_mb = resident_mb() - before_mb
    print(
        f"64 simulations             {batch_mb:8.0f} MB, created in {made_s:.2f} s, "
        f"on {batch.threads} threads"
    )
    print(f"64 branches from one state {1e3 * seconds(lambda: batch.restore(here)):8.1f} ms")
    assert set(batch.hashes) == {sim.hash}
    batch_s = seconds(lambda: batch.step(command, ticks=100))
    batch_mb = resident_mb() - before_mb
    rate = 64 * 100 / batch_s
    print(f"their steps                {rate:8.0f} ticks per second in total; now {batch_mb:.0f} MB")


if __name__ == "__main__":
    main()
