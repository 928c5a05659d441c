"""`trabecula.sim` compared with runs and replays of the program."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from pathlib import Path
from typing import Any, Callable

import numpy as np
import pytest
import support
import trabecula
from scenes import DRILL, EXTERNAL, GUIDED, pushing, written
from support import LIMIT_S, digits, messages
from trabecula.sim import Batch, Sim


def raises(kind: type[Exception], part: str, call: Callable[[], Any]) -> None:
    with pytest.raises(kind) as raised:
        call()
    assert part in str(raised.value), f"{raised.value} lacks {part}"


def hashes_of(log: Path) -> list[str]:
    """Returns the hash of each tick, from tick 0 on."""
    return [digits(state["hash"]) for state in messages(log, "/state", "hash")]


def latched(log: Path) -> list[trabecula.Command]:
    """Returns the first controller's command of each tick."""
    commands = []
    for message in messages(log, "/latched"):
        given, command = message["commands"][0]["command"], trabecula.Command()
        for name, value in given.items():
            if isinstance(value, dict):
                for part, numbers in value.items():
                    command.array[name][part] = numbers
            else:
                command.array[name] = value
        commands.append(command)
    return commands


def drives_a_run() -> None:
    """Drives as the controller of a run."""
    with trabecula.Client() as client:
        for state in client.states():
            wanted = pushing(state.tick)
            with client.command() as command:
                for name in wanted.dtype.names:
                    if name not in ("sequence", "state_tick"):
                        command.array[name] = wanted.array[name]


def test_the_commands_of_a_run_lead_to_its_hash_at_every_tick(tmp_path: Path) -> None:
    """The commands of a run give the run's hash at every tick, from the start and from the middle of its log.
    """
    words = ", ".join(
        json.dumps(word) for word in (sys.executable, os.path.abspath(__file__), "drives_a_run")
    )
    log = support.recorded(written(tmp_path, "run.toml", f"command = [{words}]\n"), tmp_path / "out")
    expected, commands = hashes_of(log), latched(log)
    assert len(expected) == 701 and len(commands) == 700
    sim = Sim(written(tmp_path, "scene.toml", EXTERNAL), drive=True)
    found = [sim.hash]
    for command in commands:
        sim.step(command)
        found.append(sim.hash)
    differing = [tick for tick, (mine, theirs) in enumerate(zip(found, expected)) if mine != theirs]
    assert not differing, f"first difference at tick {differing[0]}"
    for tick in (0, 1, 333, 700):
        branch = Sim.from_log(log, tick, drive=True)
        assert branch.hash == expected[tick] and branch.tick == tick
        here = branch.snapshot()
        for _ in range(2):
            for command in commands[tick:]:
                branch.step(command)
            assert branch.hash == expected[700], tick
            branch.restore(here)
    assert Sim.from_log(log / "run.mcap", drive=True).hash == expected[700]
    raises(trabecula.ArgumentError, "0 to 700", lambda: Sim.from_log(log, 701, drive=True))
    raises(trabecula.ArgumentError, "`tick` is -1", lambda: Sim.from_log(log, -1, drive=True))


def test_a_scene_with_its_own_controllers_leads_to_the_hashes_and_frames_of_its_run(tmp_path: Path) -> None:
    """A scene's built-in controllers give the hash of its run, and use the frames of the run."""
    guided = written(tmp_path, "guided.toml", GUIDED)
    log = support.recorded(guided, tmp_path / "out")
    expected = hashes_of(log)
    sim = Sim(guided)
    assert sim.driven == [] and sim.controllers == ["mine"]
    frames = []
    while sim.tick < 700:
        low, high = sim.render().frame.pixel_hash
        frames.append((sim.tick, digits([int(low), int(high)])))
        sim.step(ticks=100)
        assert sim.hash == expected[sim.tick], sim.tick
    recorded = [
        (frame["tick"], digits(frame["pixel_hash"]))
        for frame in messages(log, "/drr/frame", "tick", "pixel_hash")
    ]
    assert recorded[: len(frames)] == frames and len(frames) == 7, (recorded, frames)
    blind = Sim(guided, overrides={"controller.0.curved_drilling.feedback": "none"})
    blind.step(ticks=700)
    assert blind.hash != expected[700]
    raises(trabecula.ArgumentError, "it sees frames", lambda: Sim.from_log(log, 300))
    image = sim.render((30.0, -10.0))
    assert (
        image.pixels.shape == (64, 64)
        and image.pixels.dtype == np.uint16
        and not image.pixels.flags.writeable
    )
    assert np.array_equal(sim.render(image.frame.geometry).pixels, image.pixels)
    assert not np.array_equal(sim.render().pixels, image.pixels)
    c_arms = [(30.0, -10.0), None, image.frame.geometry, (-60.0, 20.0)]
    for c_arm, one in zip(c_arms, sim.render_many(c_arms)):
        assert np.array_equal(one.pixels, sim.render(c_arm).pixels), c_arm
    assert sim.render_many([]) == []
    raises(
        trabecula.ArgumentError, "frame 1 of the batch", lambda: sim.render_many([None, (float("nan"), 0.0)])
    )
    wrong: Any = "ap"
    raises(trabecula.ArgumentError, "expected a CArmGeometry", lambda: sim.render(wrong))
    raises(trabecula.ArgumentError, "X-ray", lambda: sim.render((float("nan"), 0.0)))


def test_what_a_simulation_records_replays_identically(tmp_path: Path) -> None:
    """A replay of a simulation's recording gives the same states."""
    sim = Sim(written(tmp_path, "scene.toml", EXTERNAL), drive=True, seed=11)
    with sim.record(tmp_path / "made" / "here") as recording:
        assert not recording.path.exists()
        raises(trabecula.Error, "close the recording before", sim.reset)
        for tick in range(700):
            sim.step(pushing(tick))
    assert recording.path.exists()
    assert len(sim.drilled()) == sim.state.removed_total > 20, sim.state.removed_total
    told = support.trabecula("replay", recording.path.parent, "--verify")
    assert "700 ticks" in told and "all identical" in told, told
    expected = hashes_of(recording.path)
    assert expected[700] == sim.hash and len(expected) == 701
    sequences = [
        message["commands"][0]["command"]["sequence"] for message in messages(recording.path, "/latched")
    ]
    assert sequences == list(range(1, 701))
    assert "drill" in support.trabecula("log", "info", recording.path)
    sim.reset()
    raises(trabecula.Error, "run.mcap", lambda: sim.record(tmp_path / "made" / "here"))
    own = Sim(written(tmp_path, "own.toml", GUIDED.replace("image", "none")))
    with own.record(tmp_path / "own"):
        own.step(ticks=300)
    assert "all identical" in support.trabecula("replay", tmp_path / "own", "--verify")
    branch = Sim.from_log(tmp_path / "own", 100)
    branch.step(ticks=200)
    assert branch.hash == own.hash


def test_no_number_of_threads_changes_a_hash(tmp_path: Path) -> None:
    """The number of threads does not change any hash."""
    drill, ends = written(tmp_path, "scene.toml", EXTERNAL), []
    for threads in (1, 2, 5):
        batch = Batch(drill, 5, threads=threads, drive=True)
        assert len(batch) == 5 and batch.threads == threads and batch.driven == ["mine"]
        commands = batch.commands()
        assert commands.shape == (5, 1)
        for tick in range(0, 600, 20):
            commands[:] = pushing(tick).array
            commands["arm_speed_m_per_s"][:, 0] *= 1.0 + 0.1 * np.arange(5)
            states = batch.step(commands, ticks=20)
        assert states["tick"].tolist() == [600] * 5 and states["t_world_burr"]["position_m"].shape == (5, 3)
        assert len(set(batch.hashes)) == 5 and len(batch.drilled(2)) == batch.state(2).removed_total
        ends.append(batch.hashes)
        alone = Sim(drill, drive=True)
        for tick in range(0, 600, 20):
            alone.step(pushing(tick), ticks=20)
        assert alone.hash == batch.hashes[0]
        one = batch.snapshot(3)
        hashes = batch.hashes
        batch.restore(one)
        assert set(batch.hashes) == {hashes[3]} and one.state.tick == 600
        alone.restore(one)
        batch.step(pushing(600), ticks=5)
        alone.step(pushing(600), ticks=5)
        assert set(batch.hashes) == {alone.hash}
        batch.reset([True, False, True, False, False])
        assert batch.states["tick"].tolist() == [0, 605, 0, 605, 605]
    assert ends[0] == ends[1] == ends[2]
    raises(trabecula.ArgumentError, "`n` is 0", lambda: Batch(drill, 0))
    raises(trabecula.ArgumentError, "expected (5, 1) of Command.dtype", lambda: batch.step(np.zeros(5)))
    raises(trabecula.ArgumentError, "2 `seeds`, expected 3", lambda: Batch(drill, 3, seeds=[1, 2]))
    raises(trabecula.ArgumentError, "2 snapshots, expected 5", lambda: batch.restore([one, one]))
    raises(trabecula.ArgumentError, "no simulation 5", lambda: batch.snapshot(5))
    raises(trabecula.ArgumentError, "2 flags, expected 5", lambda: batch.reset([True, False]))
    other = [{"drilling.edge_pressure_mpa": pressure} for pressure in (1.0, 20.0)]
    varied = Batch(drill, 2, overrides=other, seeds=[1, 2], drive=True)
    for tick in range(0, 600, 20):
        varied.step(pushing(tick), ticks=20)
    easy, hard = varied.states["burr_force_n"]
    assert easy != hard, (easy, hard)


def test_misuse_is_refused_in_the_words_of_the_command_that_checks_it(tmp_path: Path) -> None:
    """A bad scene is refused with the text of `trabecula scene check`, and each misuse with a clear text."""
    drill, bad = written(tmp_path, "scene.toml", EXTERNAL), tmp_path / "bad.toml"
    bad.write_text(DRILL.replace("seed = 7", "seed = 7\ndt_ms = 1000.0") + EXTERNAL)
    told = support.trabecula("scene", "check", bad, code=2).strip()
    assert told.startswith("trabecula: ")
    raises(trabecula.ArgumentError, told[len("trabecula: ") :], lambda: Sim(bad))
    raises(
        trabecula.ArgumentError,
        "`run.duration_s` is -1; allowed:",
        lambda: Sim(drill, overrides={"run.duration_s": -1.0}),
    )
    raises(
        trabecula.ArgumentError, "unknown field `nothing`", lambda: Sim(drill, overrides={"run.nothing": 1})
    )
    raises(trabecula.ArgumentError, "no controller `nobody`", lambda: Sim(drill, drive="nobody"))
    raises(trabecula.ArgumentError, "`drive` is", lambda: Sim(drill, drive=[3]))
    raises(trabecula.ArgumentError, "`seed` is -1", lambda: Sim(drill, seed=-1))
    raises(trabecula.Error, "nowhere", lambda: Sim("/nowhere/scene.toml"))
    # NumPy 2 writes a number as `np.float64(-1.0)`.
    of_numpy = {"run.duration_s": np.float64(-1.0), "controller.0.drives": np.array(["burr"])}
    raises(
        trabecula.ArgumentError, "`run.duration_s` is -1; allowed:", lambda: Sim(drill, overrides=of_numpy)
    )
    raises(trabecula.Error, "nowhere", lambda: Sim.from_log("/nowhere"))
    sim = Sim(drill, drive=True)
    command = pushing(0)
    command.tendon_force_n[0] = 61.0
    before = sim.hash
    raises(
        trabecula.ArgumentError,
        "controller `mine`: `tendon_force_n[0]` is 61; allowed: 0 to 60",
        lambda: sim.step(command),
    )
    raises(trabecula.ArgumentError, "`ticks` is 1.5", lambda: sim.step(ticks=1.5))
    raises(trabecula.ArgumentError, "no driven controller 'yours'", lambda: sim.step({"yours": pushing(0)}))
    raises(trabecula.ArgumentError, "expected a Command", lambda: sim.step(3))
    raises(trabecula.ArgumentError, "expected a Command", lambda: sim.step({"mine": 3}))
    raises(trabecula.ArgumentError, "expected a Snapshot", lambda: sim.restore(b""))
    raises(
        trabecula.ArgumentError,
        "primary_angle_deg is 400.0, expected -180 to 180 degrees",
        lambda: sim.render((400.0, 0.0)),
    )
    raises(
        trabecula.ArgumentError,
        "`bone_from_hu` is 200.9, expected a whole number",
        lambda: sim.labels(bone_from_hu=200.9),
    )
    assert sim.hash == before and sim.tick == 0
    sim.step({"mine": pushing(0)})
    raises(trabecula.Error, "a recording begins at tick 0", lambda: sim.record("/nowhere/out"))
    other = Sim(drill, overrides={"volume.spacing_mm": 1.25}, drive=True)
    raises(trabecula.ArgumentError, "another scene", lambda: other.restore(sim.snapshot()))
    own = Sim(overrides={"controller.0.curved_drilling.feedback": "none", "volume.spacing_mm": 2.0})
    raises(trabecula.ArgumentError, "drive=True", lambda: own.step(pushing(0)))
    assert (
        own.controllers == ["reference"]
        and own.driven == []
        and own.dt_s == 0.001
        and "femur" in own.scene_toml
    )
    ct = own.volume()
    assert ct is not None and ct.hu.ndim == 3 and ct.hu.size == ct.volume.hu_length


def test_ctrl_c_ends_a_long_step_at_a_tick(tmp_path: Path) -> None:
    """Ctrl-C ends a long step at a tick; from there on everything continues as if that tick had been
    requested.
    """
    drill = written(tmp_path, "scene.toml", EXTERNAL)
    long = {"run.duration_s": 86400.0}
    sim, same = (Sim(drill, overrides=long, drive=True) for _ in range(2))

    def ended_early(step: Callable[[], Any]) -> None:
        # The tests may have been started with SIGINT ignored (`pytest &`).
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        timer = threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT))
        timer.start()
        try:
            with pytest.raises(KeyboardInterrupt):
                step()
        finally:
            timer.join(LIMIT_S)
            signal.signal(signal.SIGINT, before)

    ended_early(lambda: sim.step(pushing(0), ticks=80_000_000))
    assert 0 < sim.tick < 80_000_000, sim.tick
    same.step(pushing(0), ticks=sim.tick)
    assert same.hash == sim.hash
    assert sim.step(pushing(0), ticks=3).hash.tolist() == same.step(pushing(0), ticks=3).hash.tolist()
    batch = Batch(drill, 3, overrides=long, drive=True, threads=2)
    ended_early(lambda: batch.step(pushing(0), ticks=80_000_000))
    assert all(0 <= tick < 80_000_000 for tick in batch.states["tick"]), batch.states["tick"]
    batch.reset()
    assert batch.step(pushing(0), ticks=2)["tick"].tolist() == [2, 2, 2]
    before = sim.render().pixels.tolist()
    ended_early(lambda: sim.render_many([(angle % 180.0, 0.0) for angle in range(20_000)]))
    assert sim.render().pixels.tolist() == before


def test_what_a_simulation_returns_stays_and_threads_and_a_forked_child_may_use_it(tmp_path: Path) -> None:
    """Data returned by a simulation neither changes nor dangles; threads and a forked child can use it."""
    drill = written(tmp_path, "scene.toml", EXTERNAL)
    sim = Sim(drill, drive=True)
    state = sim.step(pushing(0))
    joints, hash_then = state.joint_position_rad, sim.hash
    copy = joints.copy()
    sim.step(pushing(1), ticks=300)
    assert np.array_equal(joints, copy) and state.tick == 1 and sim.tick == 301
    with pytest.raises(trabecula.ReadOnlyError):
        joints[0] = 1.0
    del sim
    assert np.array_equal(joints, copy) and hash_then
    sims = [Sim(drill, drive=True) for _ in range(3)]
    shared = Sim(drill, drive=True)

    def work(own: Sim) -> None:
        for tick in range(200):
            own.step(pushing(tick))
            shared.step(pushing(0))

    threads = [threading.Thread(target=work, args=(own,)) for own in sims]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(LIMIT_S)
    assert len({own.hash for own in sims}) == 1 and shared.tick == 600
    batch = Batch(drill, 3, threads=2, drive=True)
    batch.step(pushing(0), ticks=10)
    picture = shared.render().pixels
    before = picture.copy()
    expected = batch.hashes
    child = os.fork()
    if child == 0:
        try:
            for call in (lambda: batch.hashes, lambda: shared.render(), lambda: shared.step()):
                raises(trabecula.Error, "belongs to the process that created it", call)
            own = Sim(drill, drive=True)
            own.step(pushing(0), ticks=10)
            os._exit(0 if np.array_equal(picture, before) and own.hash == expected[0] else 1)
        finally:
            os._exit(2)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert batch.hashes == expected


if __name__ == "__main__":
    support.main(globals())
