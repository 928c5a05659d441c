"""Cases of tests of `trabecula.sim`, against runs and replays of the program: `sim.py CASE FOLDER`, where FOLDER is empty.

The program is `TRABECULA_PROGRAM`. Prints `done` at the end.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any, Callable

import numpy as np
import trabecula
from trabecula.sim import Batch, Mask, Sim

#: Longest time that a program of a case may take.
LIMIT_S = 300.0

#: A block 3.25 mm in front of the burr; the controller follows.
DRILL = """
name = "drill"
[run]
mode = "lockstep"
duration_s = 0.7
seed = 7
controller_limit_ms = 60000.0
[volume]
phantom = "block"
spacing_mm = 1.0
[tool]
burr_start_mm = [0.0, 0.0, -34.0]
direction = [0.0, 0.0, 1.0]
bend_toward = [1.0, 0.0, 0.0]
[drr]
rate_hz = 10.0
isocentre_mm = [0.0, 0.0, -20.0]
columns = 64
rows = 64
pixel_pitch_mm = 1.5
photons_per_pixel = 5000.0
threads = 1
[[controller]]
name = "mine"
drives = ["tendon", "arm", "burr"]
"""
EXTERNAL = "external = true\n"
#: A built-in controller that sees frames.
GUIDED = """
[controller.curved_drilling]
feed_mm_per_s = 15.0
insertion_mm = 20.0
tension_n = 6.0
ramp_start_mm = 1.0
ramp_end_mm = 15.0
burr_speed_rpm = 8000.0
target_mm = [4.0, 0.0, -16.0]
guidance_gain_n_per_mm = 2.0
feedback = "image"
"""


def scene(folder: Path, name: str, rest: str) -> Path:
    path = folder / name
    path.write_text(DRILL + rest)
    return path


def program(*words: object, code: int = 0) -> str:
    """Runs the program; what it printed."""
    line = [os.environ["TRABECULA_PROGRAM"], *map(str, words)]
    done = subprocess.run(line, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    assert done.returncode == code, f"{line}: {done.returncode}\n{done.stdout}{done.stderr}"
    return done.stdout if code == 0 else done.stderr


def run(scene_file: Path, output: Path) -> Path:
    """A recorded run; its folder."""
    program("run", scene_file, "--mode", "lockstep", "--quiet", "--output", output)
    (folder,) = output.iterdir()
    return folder


def messages(log: Path, topic: str, *fields: str) -> list[Any]:
    words = [word for field in fields for word in ("--field", field)]
    lines = program("log", "cat", log, "--topic", topic, *words).splitlines()
    return [json.loads(line)["message"] for line in lines]


def digits(hash_parts: list[int]) -> str:
    low, high = hash_parts
    return f"{high:016x}{low:016x}"


def hashes_of(log: Path) -> list[str]:
    """The hash of each tick, from tick 0 on."""
    return [digits(state["hash"]) for state in messages(log, "/state", "hash")]


def latched(log: Path) -> list[trabecula.Command]:
    """The first controller's command of each tick."""
    commands = []
    for message in messages(log, "/latched"):
        given, command = message["commands"][0]["command"], trabecula.Command()
        for name, value in given.items():
            if name == "t_world_base":
                command.t_world_base.position_m[:] = value["position_m"]
                command.t_world_base.orientation_xyzw[:] = value["orientation_xyzw"]
            else:
                command.array[name] = value
        commands.append(command)
    return commands


def raises(kind: type, part: str, call: Callable[[], Any]) -> None:
    try:
        call()
    except kind as error:
        assert part in str(error), f"{error} lacks {part}"
        return
    raise AssertionError(f"no {kind.__name__}: {part}")


def pushing(tick: int) -> trabecula.Command:
    """What is asked for at a tick: deeper into the bone, and a rising tension."""
    command = trabecula.Command()
    command.tendon_mode = trabecula.TendonMode.SERVO_JF
    command.tendon_force_n[0] = 0.005 * tick
    command.arm_mode = trabecula.ArmMode.INSERT
    command.arm_axis[:] = (0.0, 0.0, 1.0)
    command.arm_depth_m = 0.012
    command.arm_speed_m_per_s = 0.012
    command.burr_mode = trabecula.BurrMode.SPEED
    command.burr_speed_rad_per_s = 800.0
    return command


def drives_a_run() -> None:
    """The controller of a run."""
    with trabecula.Client() as client:
        for state in client.states():
            wanted = pushing(state.tick)
            with client.command() as command:
                for name in wanted.dtype.names:
                    if name not in ("sequence", "state_tick"):
                        command.array[name] = wanted.array[name]


def follows(folder: Path) -> None:
    """The commands of a run lead to the hash of the run at every tick, from the start and from the middle of its log."""
    words = ", ".join(json.dumps(word) for word in (sys.executable, os.path.abspath(__file__), "drives_a_run"))
    log = run(scene(folder, "run.toml", f"command = [{words}]\n"), folder / "out")
    expected, commands = hashes_of(log), latched(log)
    assert len(expected) == 701 and len(commands) == 700
    sim = Sim(scene(folder, "scene.toml", EXTERNAL), drive=True)
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


def runs(folder: Path) -> None:
    """A scene's own controllers lead to the hash of its run; the frames that they see are those of the run."""
    guided = scene(folder, "guided.toml", GUIDED)
    log = run(guided, folder / "out")
    expected = hashes_of(log)
    sim = Sim(guided)
    assert sim.driven == [] and sim.controllers == ["mine"]
    frames = []
    while sim.tick < 700:
        low, high = sim.render().frame.pixel_hash
        frames.append((sim.tick, digits([int(low), int(high)])))
        sim.step(ticks=100)
        assert sim.hash == expected[sim.tick], sim.tick
    recorded = [(frame["tick"], digits(frame["pixel_hash"])) for frame in messages(log, "/drr/frame", "tick", "pixel_hash")]
    assert recorded[: len(frames)] == frames and len(frames) == 7, (recorded, frames)
    blind = Sim(guided, overrides={"controller.0.curved_drilling.feedback": "none"})
    blind.step(ticks=700)
    assert blind.hash != expected[700]
    raises(trabecula.ArgumentError, "it sees frames", lambda: Sim.from_log(log, 300))
    image = sim.render((30.0, -10.0))
    assert image.pixels.shape == (64, 64) and image.pixels.dtype == np.uint16 and not image.pixels.flags.writeable
    assert np.array_equal(sim.render(image.frame.geometry).pixels, image.pixels)
    assert not np.array_equal(sim.render().pixels, image.pixels)
    c_arms = [(30.0, -10.0), None, image.frame.geometry, (-60.0, 20.0)]
    for c_arm, one in zip(c_arms, sim.render_many(c_arms)):
        assert np.array_equal(one.pixels, sim.render(c_arm).pixels), c_arm
    assert sim.render_many([]) == []
    raises(trabecula.ArgumentError, "frame 1 of the batch", lambda: sim.render_many([None, (float("nan"), 0.0)]))
    raises(trabecula.ArgumentError, "expected a CArmGeometry", lambda: sim.render("ap"))  # type: ignore[arg-type]
    raises(trabecula.ArgumentError, "X-ray", lambda: sim.render((float("nan"), 0.0)))


def records(folder: Path) -> None:
    """What a simulation records, a replay steps to the same states."""
    sim = Sim(scene(folder, "scene.toml", EXTERNAL), drive=True, seed=11)
    with sim.record(folder / "made" / "here") as recording:
        assert not recording.path.exists()
        raises(trabecula.Error, "close it before", sim.reset)
        for tick in range(700):
            sim.step(pushing(tick))
    assert recording.path.exists()
    assert len(sim.drilled()) == sim.state.removed_total > 20, sim.state.removed_total
    told = program("replay", recording.path.parent, "--verify")
    assert "700 ticks" in told and "all identical" in told, told
    expected = hashes_of(recording.path)
    assert expected[700] == sim.hash and len(expected) == 701
    sequences = [message["commands"][0]["command"]["sequence"] for message in messages(recording.path, "/latched")]
    assert sequences == list(range(1, 701))
    assert "drill" in program("log", "info", recording.path)
    sim.reset()
    raises(trabecula.Error, "run.mcap", lambda: sim.record(folder / "made" / "here"))
    own = Sim(scene(folder, "own.toml", GUIDED.replace("image", "none")))
    with own.record(folder / "own"):
        own.step(ticks=300)
    assert "all identical" in program("replay", folder / "own", "--verify")
    branch = Sim.from_log(folder / "own", 100)
    branch.step(ticks=200)
    assert branch.hash == own.hash


def batches(folder: Path) -> None:
    """No number of threads changes a hash."""
    drill, ends = scene(folder, "scene.toml", EXTERNAL), []
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


def errors(folder: Path) -> None:
    """A bad scene is refused in the words of the command that checks it, and each misuse with a sentence."""
    drill, bad = scene(folder, "scene.toml", EXTERNAL), folder / "bad.toml"
    bad.write_text(DRILL.replace("seed = 7", "seed = 7\ndt_ms = 1000.0") + EXTERNAL)
    told = program("scene", "check", bad, code=2).strip()
    assert told.startswith("trabecula: ")
    raises(trabecula.ArgumentError, told[len("trabecula: ") :], lambda: Sim(bad))
    raises(trabecula.ArgumentError, "`run.duration_s` is -1, allowed is", lambda: Sim(drill, overrides={"run.duration_s": -1.0}))
    raises(trabecula.ArgumentError, "unknown field `nothing`", lambda: Sim(drill, overrides={"run.nothing": 1}))
    raises(trabecula.ArgumentError, "no controller `nobody`", lambda: Sim(drill, drive="nobody"))
    raises(trabecula.ArgumentError, "`drive` is", lambda: Sim(drill, drive=[3]))
    raises(trabecula.ArgumentError, "`seed` is -1", lambda: Sim(drill, seed=-1))
    raises(trabecula.Error, "nowhere", lambda: Sim("/nowhere/scene.toml"))
    # NumPy 2 writes a number as `np.float64(-1.0)`.
    of_numpy = {"run.duration_s": np.float64(-1.0), "controller.0.drives": np.array(["burr"])}
    raises(trabecula.ArgumentError, "`run.duration_s` is -1, allowed is", lambda: Sim(drill, overrides=of_numpy))
    raises(trabecula.Error, "nowhere", lambda: Sim.from_log("/nowhere"))
    sim = Sim(drill, drive=True)
    command = pushing(0)
    command.tendon_force_n[0] = 61.0
    before = sim.hash
    raises(trabecula.ArgumentError, "controller `mine`: `tendon_force_n[0]` is 61, allowed is 0 to 60", lambda: sim.step(command))
    raises(trabecula.ArgumentError, "`ticks` is 1.5", lambda: sim.step(ticks=1.5))
    raises(trabecula.ArgumentError, "no driven controller 'yours'", lambda: sim.step({"yours": pushing(0)}))
    raises(trabecula.ArgumentError, "expected a Command", lambda: sim.step(3))
    raises(trabecula.ArgumentError, "expected a Command", lambda: sim.step({"mine": 3}))
    raises(trabecula.ArgumentError, "expected what `snapshot()` returns", lambda: sim.restore(b""))
    raises(trabecula.ArgumentError, "primary_angle_deg is 400.0, expected -180 to 180 degrees", lambda: sim.render((400.0, 0.0)))
    raises(trabecula.ArgumentError, "`bone_from_hu` is 200.9, expected a whole number", lambda: sim.labels(bone_from_hu=200.9))
    assert sim.hash == before and sim.tick == 0
    sim.step({"mine": pushing(0)})
    raises(trabecula.Error, "a recording begins at tick 0", lambda: sim.record("/nowhere/out"))
    other = Sim(drill, overrides={"volume.spacing_mm": 1.25}, drive=True)
    raises(trabecula.ArgumentError, "another scene", lambda: other.restore(sim.snapshot()))
    own = Sim(overrides={"controller.0.curved_drilling.feedback": "none", "volume.spacing_mm": 2.0})
    raises(trabecula.ArgumentError, "drive=True", lambda: own.step(pushing(0)))
    assert own.controllers == ["reference"] and own.driven == [] and own.dt_s == 0.001 and "femur" in own.scene_toml
    ct = own.volume()
    assert ct is not None and ct.hu.ndim == 3 and ct.hu.size == ct.volume.hu_length


def interrupted(folder: Path) -> None:
    """Ctrl-C ends a long step at a tick; from there on everything goes on as if it had been asked for that tick."""
    drill = scene(folder, "scene.toml", EXTERNAL)
    long = {"run.duration_s": 86400.0}
    sim, same = (Sim(drill, overrides=long, drive=True) for _ in range(2))

    def ended_early(step: Callable[[], Any]) -> None:
        timer = threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT))
        timer.start()
        try:
            step()
        except KeyboardInterrupt:
            return
        raise AssertionError("no KeyboardInterrupt")

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


def memory(folder: Path) -> None:
    """What a simulation has returned neither changes nor dangles; threads and a forked child may use it."""
    drill = scene(folder, "scene.toml", EXTERNAL)
    sim = Sim(drill, drive=True)
    state = sim.step(pushing(0))
    joints, hash_then = state.joint_position_rad, sim.hash
    copy = joints.copy()
    sim.step(pushing(1), ticks=300)
    assert np.array_equal(joints, copy) and state.tick == 1 and sim.tick == 301
    try:
        joints[0] = 1.0
        raise AssertionError("a state was written")
    except trabecula.ReadOnlyError:
        pass
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
        thread.join()
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
                raises(trabecula.Error, "belongs to the process that made it", call)
            own = Sim(drill, drive=True)
            own.step(pushing(0), ticks=10)
            os._exit(0 if np.array_equal(picture, before) and own.hash == expected[0] else 1)
        finally:
            os._exit(2)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert batch.hashes == expected


def siddon(start: Any, end: Any, shape: tuple[int, ...]) -> tuple[Any, Any, Any]:
    """Parameters and voxels i, j, k of the pieces of a ray in voxel coordinates: all crossings with planes, sorted."""
    with np.errstate(divide="ignore", invalid="ignore"):
        planes = [(np.arange(n + 1) - 0.5 - start[axis]) / (end - start)[axis] for axis, n in enumerate(shape)]
    cuts = np.concatenate([*planes, [0.0, 1.0]])
    cuts = np.unique(cuts[(cuts >= 0.0) & (cuts <= 1.0)])
    middles = start + 0.5 * (cuts[:-1] + cuts[1:])[:, None] * (end - start)
    voxels = np.floor(middles + 0.5).astype(int)
    inside = np.all((voxels >= 0) & (voxels < np.array(shape)), axis=1)
    return cuts[:-1][inside], np.diff(cuts)[inside], voxels[inside]


def labels(folder: Path) -> None:
    """Labels against Siddon's method and the tool's geometry in NumPy."""
    sim = Sim(scene(folder, "scene.toml", EXTERNAL), drive=True)
    for tick in range(700):
        sim.step(pushing(tick))
    assert len(sim.drilled()) > 10
    found, state, ct = sim.labels(), sim.state, sim.volume()
    assert ct is not None and np.array_equal(found.image.pixels, sim.render().pixels)
    geometry, rows, columns = found.image.frame.geometry, *found.mask.shape
    hu = ct.hu.copy()
    gone = np.zeros(hu.shape, bool)
    gone.reshape(-1)[sim.drilled()] = True
    source = geometry.source_m
    corner = geometry.detector_centre_m - 0.5 * (columns - 1) * geometry.pixel_pitch_m[0] * geometry.row_axis
    corner = corner - 0.5 * (rows - 1) * geometry.pixel_pitch_m[1] * geometry.column_axis
    normal = np.cross(geometry.row_axis, geometry.column_axis)
    reach = abs(float(np.dot(geometry.detector_centre_m - source, normal)))
    names = ["joint_1", "joint_27"]
    assert found.keypoint_names[:2] + found.keypoint_names[-2:] == ["base", names[0], names[1], "burr"]
    nodes = np.array([state.t_world_base.position_m, *state.array["t_world_link"]["position_m"][: state.joint_count]])
    nodes = np.vstack([nodes, state.t_world_burr.position_m])
    worst, unsure = 0.0, 0
    for row in range(rows):
        for column in range(columns):
            pixel = corner + column * geometry.pixel_pitch_m[0] * geometry.row_axis + row * geometry.pixel_pitch_m[1] * geometry.column_axis
            at, parts, voxels = siddon(ct.world_to_voxel(source), ct.world_to_voxel(pixel), hu.shape[::-1])
            length, (i, j, k) = float(np.linalg.norm(pixel - source)), voxels.T
            drilled = gone[k, j, i]
            bone = (hu[k, j, i] >= 150) & ~drilled
            here = (row, column)
            bone_m, tunnel_m = length * parts[bone].sum(), length * parts[drilled].sum()
            worst = max(worst, abs(bone_m - found.bone_m[here]), abs(tunnel_m - found.tunnel_m[here]))
            for expected, got, bit in ((bone_m, found.bone_m, Mask.BONE), (tunnel_m, found.tunnel_m, Mask.TUNNEL)):
                # A ray that grazes a voxel's edge has a piece of rounding's length.
                assert expected < 1e-9 or found.where(bit)[here], (here, bit)
                assert found.where(bit)[here] == (got[here] > 0.0), (here, bit)
            if bone_m > 1e-6:
                assert abs(reach * at[bone & (length * parts > 1e-9)][0] - found.bone_depth_m[here]) < 1e-6, here
            ray = (pixel - source) / length
            miss = np.linalg.norm(np.cross(nodes[-1] - source, ray))
            assert found.where(Mask.BURR)[here] == (miss < BURR_M), (here, miss)
            metal = in_tube(source, ray, nodes)
            unsure += metal is None
            assert metal is None or found.where(Mask.TOOL)[here] == metal, (here, metal)
    assert worst < 1e-7, worst
    assert unsure < 0.02 * rows * columns, unsure
    assert all(found.where(each).sum() > 10 for each in Mask), [int(found.where(each).sum()) for each in Mask]
    seen = np.array(nodes) @ found.image.frame.projection.rotation.reshape(3, 3).T + found.image.frame.projection.translation_m
    in_image = seen @ found.image.frame.projection.intrinsics.reshape(3, 3).T
    assert np.allclose(found.keypoints[:, :2], in_image[:, :2] / in_image[:, 2:], atol=1e-9)
    assert np.allclose(found.keypoints[:, 2], seen[:, 2], atol=1e-12)
    # Where the tool begins is above its metal; all bone is there from the lowest threshold on.
    assert np.array_equal(np.isfinite(found.tool_depth_m), found.where(Mask.TOOL | Mask.BURR))
    everything = sim.labels(bone_from_hu=-1000)
    assert everything.bone_m.sum() > found.bone_m.sum() and not sim.labels(bone_from_hu=32767).where(Mask.BONE).any()
    assert not np.array_equal(sim.labels((40.0, 10.0)).mask, found.mask)
    raises(trabecula.ArgumentError, "`bone_from_hu` is 40000", lambda: sim.labels(bone_from_hu=40000))
    raises(trabecula.ArgumentError, "expected a CArmGeometry", lambda: sim.labels("ap"))  # type: ignore[arg-type]


#: Radii of the standard tool.
BURR_M, OUTER_M, INNER_M, CABLE_M = 3.25e-3, 3.0e-3, 2.0e-3, 1.0e-3
#: How near a ray may pass to an edge of the tool to count as doubtful.
DOUBT_M = 2e-5


def in_tube(source: Any, ray: Any, nodes: Any) -> Any:
    """Whether a ray crosses a wall or the cable of the tubes from node to node, by points on it; None where it only grazes one."""
    crossed, grazed = False, False
    for start, end in zip(nodes[:-1], nodes[1:]):
        length = np.linalg.norm(end - start)
        if length < 1e-6:
            continue
        axis = (end - start) / length
        across = np.cross(ray, axis)
        if abs(np.dot(source - start, across)) > (OUTER_M + DOUBT_M) * np.linalg.norm(across):
            continue
        ends = [float(np.dot(point - source, ray)) for point in (start, end)]
        along = np.arange(min(ends) - 0.005, max(ends) + 0.005, DOUBT_M)
        from_start = source - start + along[:, None] * ray
        height = from_start @ axis
        off = np.linalg.norm(from_start - height[:, None] * axis, axis=1)
        for doubt_m in (DOUBT_M, -DOUBT_M):
            metal = (off < OUTER_M + doubt_m) & ((off > INNER_M - doubt_m) | (off < CABLE_M + doubt_m))
            there = bool(np.any(metal & (height > -doubt_m) & (height < length + doubt_m)))
            grazed, crossed = grazed or there, crossed or (there and doubt_m < 0.0)
    return None if grazed and not crossed else crossed


def gymnasium(folder: Path) -> None:
    """Gymnasium accepts the environment, and an episode repeats."""
    import gymnasium as gym
    from gymnasium.utils.env_checker import check_env

    coarse = {"volume.spacing_mm": 1.0, "drr.columns": 64, "drr.rows": 64}
    env = gym.make("trabecula.gym:trabecula/CurvedDrilling-v0", overrides=coarse, ticks=100, render_mode="rgb_array")
    check_env(env.unwrapped)
    runs = []
    for _ in range(2):
        observation, info = env.reset(seed=5)
        distance, total = info["distance_mm"], 0.0
        for count in range(60):
            observation, reward, ended, cut, info = env.step(np.array([-0.2, 0.5], np.float32))
            total += reward
        assert not ended and not cut and info["removed_voxels"] > 0
        assert total <= distance - info["distance_mm"] + 1e-6 and info["distance_mm"] < distance - 5.0
        runs.append((observation.tolist(), total))
    assert runs[0] == runs[1], runs
    assert env.render().shape == (64, 64, 3)
    several = gym.make_vec("trabecula.gym:trabecula/CurvedDrilling-v0", num_envs=3, vectorization_mode="sync", overrides=coarse)
    observations, _ = several.reset(seed=5)
    assert observations.shape == (3, 9) and len({tuple(row) for row in observations.tolist()}) == 3
    several.step(several.action_space.sample())


def skiving(folder: Path) -> None:
    """Untouched, the burr leaves its line toward the soft side in 1:10 and not in 1:1; a pull the other way keeps it nearer."""
    import gymnasium as gym
    from gymnasium.utils.env_checker import check_env

    coarse = {"volume.spacing_mm": 1.0}
    env = gym.make("trabecula.gym:trabecula/Skiving-v0", overrides=coarse, ticks=100)
    check_env(env.unwrapped)

    def episode(ratio: float, tension: float) -> tuple[float, float, float]:
        observation, info = env.reset(seed=1, options={"ratio": ratio})
        assert info["ratio"] == ratio and not observation[:2].any()
        total, worst = 0.0, 0.0
        for _ in range(200):
            observation, reward, ended, cut, info = env.step(np.array([tension, -0.5], np.float32))
            total, worst = total + reward, max(worst, info["off_line_mm"])
            if ended or cut:
                break
        assert ended and not info["lost"], (info, observation)
        return total, worst, float(observation[0])

    straight, beside, held = episode(1.0, 0.0), episode(10.0, 0.0), episode(10.0, 0.05)
    # Voxels of 1 mm: the hole that the burr cuts is wider than the burr by up to that.
    assert straight[1] < 0.5 and 13.0 < straight[0] <= 14.0, straight
    assert beside[2] < -1.5 and beside[0] < 0.0, beside
    assert held[2] > beside[2] + 0.1 and episode(10.0, 0.05) == held
    several = gym.make_vec("trabecula.gym:trabecula/Skiving-v0", num_envs=2, vectorization_mode="sync", overrides=coarse)
    assert several.reset(seed=3)[0].shape == (2, 7)


def x_ray_steering(folder: Path) -> None:
    """The frame shows the target where the C-arm projects it, and nothing but the frame and what the machine measures is seen."""
    import gymnasium as gym
    from gymnasium.utils.env_checker import check_env

    coarse = {"volume.spacing_mm": 1.0}
    env = gym.make("trabecula.gym:trabecula/XRaySteering-v0", overrides=coarse, ticks=100)
    check_env(env.unwrapped)
    observation, info = env.reset(seed=5)
    assert observation["image"].shape == (96, 96, 1) and np.ptp(observation["image"]) > 50
    camera = env.unwrapped.sim.render().frame.projection
    k, r = np.array(camera.intrinsics).reshape(3, 3), np.array(camera.rotation).reshape(3, 3)
    seen = k @ (r @ (np.array(info["target_mm"]) * 1e-3) + np.array(camera.translation_m))
    expected = seen[:2] / seen[2] / 96.0
    assert np.allclose(observation["target"], expected, atol=1e-5), (observation["target"], expected)
    first = observation["image"].copy()
    for _ in range(20):
        observation, _, _, _, info = env.step(np.array([-0.2, 0.5], np.float32))
    assert (observation["image"] != first).any() and observation["measured"][0] > 2.0, observation["measured"]


if __name__ == "__main__":
    arguments = [Path(word) for word in sys.argv[2:]]
    globals()[sys.argv[1]](*arguments)
    print("done")
