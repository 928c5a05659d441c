"""Scenes stepped in this process: no session, no other process, no clock.

    from trabecula.sim import Sim

    sim = Sim("scene.toml", overrides={"drilling.edge_pressure_mpa": 2.0}, drive=True)
    command = trabecula.Command()
    command.tendon_mode = trabecula.TendonMode.SERVO_JF
    command.tendon_force_n[0] = 5.0
    state = sim.step(command, ticks=10)
    here = sim.snapshot()
    sim.step(command, ticks=100)
    sim.restore(here)

A tick is identical to one of `trabecula run --mode lockstep`: the same commands give the same hash.
Everything a simulation returns is a copy that never changes: a state taken before a step keeps its values.
Units are SI; names end in their unit.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any, Iterable, Mapping, Optional, Sequence, Union

import numpy as np
import numpy.typing as npt

from . import _generated as g
from ._calls import whole
from ._errors import ArgumentError
from ._native import native
from ._labels import Labels, Mask
from ._linear import LinearModel, signals
from ._results import Ct, Image, Jacobian, Reading
from ._run import settings

__all__ = ["Batch", "Labels", "LinearModel", "Mask", "Sim", "Snapshot", "identify"]

#: A file, or None for the built-in femur.
SceneFile = Union[str, "os.PathLike[str]", None]
Overrides = Mapping[str, Any]
#: True: every controller; or the names of the built-in controllers that the caller replaces.
Drive = Union[bool, str, Iterable[str]]
#: A command for the only driven controller, or commands by name for several; None requests nothing.
Commands = Union[g.Command, Mapping[str, g.Command], None]
#: The scene's C-arm (None), a C-arm geometry, or the scene's C-arm at a primary and a secondary angle in
#: degrees.
CArm = Union[g.CArmGeometry, tuple[float, float], None]


class Snapshot:
    """The complete state of a simulation at a tick, created by `Sim.snapshot`. Holds the drilled voxels, not
    the volume. Can be pickled as a `Sim` can.
    """

    __slots__ = ("_native",)

    def __init__(self, taken: native.Snapshot) -> None:
        self._native = taken

    @property
    def state(self) -> g.State:
        """The state at its tick."""
        return g.State(self._native.state())

    @property
    def vector(self) -> npt.NDArray[np.float64]:
        """The values of `Sim.state_names`, read-only."""
        return np.frombuffer(self._native.vector(), "<f8")

    def __reduce__(self) -> tuple[Any, ...]:
        return _unpickled_snapshot, (self._native.packed(),)

    def __copy__(self) -> Snapshot:
        return self

    def __deepcopy__(self, memo: Any) -> Snapshot:
        return self

    def __repr__(self) -> str:
        return f"Snapshot(tick={self.state.tick}, hash={_digits(self.state)})"


class Sim:
    """One simulation.

    The caller drives the scene's external controllers and programs: `step` takes their commands. Built-in
    controllers run inside the simulation, as in a run, unless `drive` hands them to the caller.

    A simulation runs on its own thread. It can be used from any thread; concurrent calls wait for each other,
    and the interpreter lock is released meanwhile. In a child of `fork`, its calls raise an Error, but
    returned data stays readable.

    It can be pickled, and continues bit for bit in another process with the same build. The pickle holds scene
    and state; the files that the scene names must be there, with the same volume. A recording is not
    continued. Unpickling anything else than such a state raises an ArgumentError.
    """

    def __init__(
        self,
        scene: SceneFile = None,
        *,
        overrides: Optional[Overrides] = None,
        seed: Optional[int] = None,
        drive: Drive = False,
    ) -> None:
        """Creates a simulation at tick 0.

        Args:
            scene: Scene file; None: the built-in femur. Its mode is ignored: a simulation always runs in
                lockstep.
            overrides: Values for scene keys, by path; a number in a path is an index, from 0, into an array
                of tables.
            seed: Replaces the scene's `run.seed`.
            drive: True: the caller drives every controller; or names of built-in controllers to drive.

        Raises:
            ArgumentError: The scene, an override or a name is refused, with the error text of `trabecula
                scene check`.
        """
        self._take(native.Sim(_loaded(scene, overrides, seed, None), *_driving(drive)))

    @classmethod
    def from_log(
        cls, log: Union[str, "os.PathLike[str]"], tick: Optional[int] = None, *, drive: Drive = False
    ) -> Sim:
        """Creates the simulation of a recorded run at a tick; `reset` returns there.

        The log's commands are stepped through the physics, so this takes time in proportion to the tick; each
        state on the way is compared with the log's. The simulation continues in lockstep, even if the log was
        recorded in real time.

        Args:
            log: Folder of a run, or its `run.mcap`, recorded by this build.
            tick: `State.tick`; None: the log's last tick.
            drive: As in `Sim`. Built-in controllers that are not driven continue as in the run; this requires
                a lockstep log from tick 0 on, and controllers that use no frames.

        Raises:
            ArgumentError: No such log or tick, or a controller that cannot continue.
            Error: The log cannot be read, or this build's physics gives a different result.
        """
        sim = cls.__new__(cls)
        to_tick = None if tick is None else whole("tick", tick)
        sim._take(native.Sim.from_log(os.fspath(log), to_tick, *_driving(drive)))
        return sim

    def _take(self, made: native.Sim) -> None:
        self._native = made
        self._scene = made.scene()
        self._driven = made.driven()
        self._nothing = bytes(g.Command.dtype.itemsize * len(self._driven))

    @property
    def state(self) -> g.State:
        """The current state."""
        return g.State(self._native.state())

    @property
    def tick(self) -> int:
        """Current tick, counted from the start."""
        return self.state.tick

    @property
    def hash(self) -> str:
        """Hash of the simulation so far, 32 hexadecimal digits: h_k in the log of a run with the same
        commands.
        """
        return _digits(self.state)

    @property
    def dt_s(self) -> float:
        """Simulated time of a tick."""
        return self._scene.facts()[1]

    @property
    def scene_toml(self) -> str:
        """The complete scene, including all overrides."""
        return self._scene.toml()

    @property
    def notes(self) -> list[str]:
        """Notes on scene and volume: choices, assumptions and likely mistakes."""
        return self._scene.notes()

    @property
    def controllers(self) -> list[str]:
        """Names of the scene's controllers."""
        return self._scene.controllers()

    @property
    def driven(self) -> list[str]:
        """Names of the controllers that the caller drives."""
        return list(self._driven)

    @property
    def refusals(self) -> list[str]:
        """Parts of valid commands that could not be followed in the last `step`, such as unreachable goals,
        with reasons.
        """
        return self._native.refusals()

    def readings(self) -> list[Reading]:
        """Returns the sensor readings that arrived in the last `step`, at most the newest 1024; before the
        first step and after a jump, those of the current state.
        """
        data = self._native.readings()
        size = g.SensorReading.dtype.itemsize
        return [Reading.of(g.SensorReading(data[at : at + size])) for at in range(0, len(data), size)]

    def tip_jacobian(self) -> Jacobian:
        """Returns Jacobian and compliance of the tip at the current state."""
        return Jacobian.of(g.TipJacobian(self._native.tip_jacobian()))

    def step(self, command: Commands = None, ticks: int = 1) -> g.State:
        """Runs ticks and returns the state after the last one.

        Every driven controller repeats its command at each tick. A controller without a command sends an
        empty one, so tendons, arm and burr continue with the previous request.

        Args:
            command: Command of the driven controller, or commands by name for several. `sequence` and
                `state_tick` are filled in.
            ticks: Number of ticks.

        Raises:
            ArgumentError: A value out of range, a part of the tool that the controller does not drive, or no
                controller to command. Nothing has changed then.
            KeyboardInterrupt: Ctrl-C; likewise for any exception of a signal handler. The simulation stays at
                the tick reached.
        """
        return g.State(self._native.step(self._packed(command), whole("ticks", ticks)))

    def _packed(self, command: Commands) -> bytes:
        if command is None:
            return self._nothing
        if isinstance(command, g.Command):
            if len(self._driven) != 1:
                raise ArgumentError(self._not_one())
            return bytes(command._buffer)
        if not isinstance(command, Mapping):
            text = f"`command` is {command!r}, expected a Command, or Commands by the names of controllers"
            raise ArgumentError(text)
        given = dict(command)
        empty = g.Command()
        packed = b"".join(bytes(_command(name, given.pop(name, empty))._buffer) for name in self._driven)
        if given:
            names = ", ".join(map(repr, given))
            raise ArgumentError(f"no driven controller {names}; driven: {self._driven or 'none'}")
        return packed

    def _not_one(self) -> str:
        if not self._driven:
            return (
                f"there is no controller to command: the scene's {self.controllers} run inside the "
                "simulation; create it with drive=True, or with the name of one"
            )
        return f"several controllers are driven, {self._driven}: give their commands by name"

    def snapshot(self) -> Snapshot:
        """Takes a snapshot to return to. Time and memory depend on the drilled voxels, not on the volume."""
        return Snapshot(self._native.snapshot())

    def restore(self, snapshot: Snapshot) -> None:
        """Returns to the state of a snapshot, from this or another simulation of the same scene, and
        continues bit for bit. A snapshot of a scene that differs only in `[truth]` gives its state and its
        drilled bone; the parameters stay those of this scene.

        Raises:
            ArgumentError: The snapshot is from another scene, has other driven controllers, or its
                `[truth]` differs in a key that determines what the state means.
            Error: A recording is open.
        """
        self._native.restore(_taken(snapshot))

    @property
    def state_names(self) -> list[str]:
        """Names of the entries of a state vector, which depend on the scene alone."""
        return [name for name, _ in self._native.state_entries()]

    @property
    def state_units(self) -> list[str]:
        """Unit of each entry; `1` for a plain number, `sqrt(J)` for the amplitude of a moment mode."""
        return [unit for _, unit in self._native.state_entries()]

    def restore_vector(self, snapshot: Snapshot, vector: npt.ArrayLike) -> None:
        """Moves to the state of a snapshot, but with these values of `state_names`. What a vector does not
        hold (bone, free bodies, motions in progress, sensors' delays, controllers) is the snapshot's.

        The hash becomes one that no run has, unless the vector is the snapshot's own.

        Raises:
            ArgumentError: As in `restore`; or the vector has the wrong length, a value is out of range, or
                joints of the arm differ although it follows a path.
            Error: A recording is open.
        """
        values = np.ascontiguousarray(vector, "<f8")
        if values.ndim != 1:
            raise ArgumentError(f"`vector` has shape {values.shape}, expected one dimension")
        self._native.restore_vector(_taken(snapshot), values.tobytes())

    def linearize(
        self,
        command: Commands = None,
        *,
        inputs: Union[str, Sequence[str]] = (),
        outputs: Union[str, Sequence[str]] = (),
    ) -> LinearModel:
        """Returns the next tick, with these commands, as a linear model about the current state, by central
        differences. The bone stays as it is; contacts take part. The simulation is unchanged.

            model = sim.linearize(command, inputs="tendon_force_n", outputs=["t_world_burr.position_m"])

        Args:
            command: As in `step`.
            inputs: Fields of a Command; an array stands for the elements that the scene uses.
            outputs: Fields of a State. Those that follow from the state vector (poses, angles, rates) are
                those of the current state, so their rows of D are 0; forces, tensions and energies are
                those of the tick.

        Raises:
            ArgumentError: As in `step`; or there is no such field, it is no float64, or no controller drives
                what an input belongs to.
        """
        given = self._packed(command)
        return LinearModel.of(
            self._native.linearize(given, signals("inputs", inputs), signals("outputs", outputs))
        )

    def reset(self) -> None:
        """Returns to tick 0, or to the tick at which `from_log` started.

        Raises:
            Error: A recording is open.
        """
        self._native.reset()

    def branch(self) -> Sim:
        """Creates another simulation in the same state, as `copy.copy` and `copy.deepcopy` do. Scene and
        volume are shared.
        """
        sim = type(self).__new__(type(self))
        sim._take(self._native.branch())
        return sim

    def __copy__(self) -> Sim:
        return self.branch()

    def __deepcopy__(self, memo: Any) -> Sim:
        return self.branch()

    def __reduce__(self) -> tuple[Any, ...]:
        return _unpickled_sim, (type(self), self._native.packed())

    def render(self, c_arm: CArm = None) -> Image:
        """Renders the X-ray of the current state; later ticks are unaffected. With the scene's C-arm, the
        pixels are those of a run's frame at this tick.

        Args:
            c_arm: None: the scene's; a CArmGeometry; or (primary, secondary) DICOM angles in degrees.

        Raises:
            ArgumentError: The C-arm is refused.
            Error: The scene has no X-ray.
        """
        frame_bytes, pixels = self._native.render(*_seen_from(c_arm))
        return _image(frame_bytes, pixels)

    def render_many(self, c_arms: Sequence[CArm]) -> list[Image]:
        """Renders the X-rays of the current state from several C-arms; same pixels as `render` for each, but
        faster than one after the other.

            images = sim.render_many([(angle, 0.0) for angle in range(-90, 90)])

        Args:
            c_arms: Each as in `render`. All images are held in memory: 2 bytes per pixel.

        Raises:
            ArgumentError: A C-arm is refused (the text gives its index); nothing is rendered.
            Error: The scene has no X-ray.
            KeyboardInterrupt: Ctrl-C; likewise for any exception of a signal handler. No image is returned
                then.
        """
        rendered = self._native.render_many([_seen_from(c_arm) for c_arm in c_arms])
        return [_image(frame_bytes, pixels) for frame_bytes, pixels in rendered]

    def labels(self, c_arm: CArm = None, *, bone_from_hu: Optional[int] = None) -> Labels:
        """Renders the X-ray of the current state like `render`, with labels: masks, separate line integrals,
        lengths, depths, keypoints and markers.

        Labels have neither noise nor blur. They trace a ray through the voxels for every pixel, which costs a
        hundred times as much as a frame.

        Args:
            c_arm: As in `render`.
            bone_from_hu: Voxels at or above this value are bone; None: the scene's `drr.labels.bone_from_hu`,
                or else its `volume.bone_threshold_hu`.

        Raises:
            ArgumentError: The C-arm or `bone_from_hu` is refused.
            Error: The scene has no X-ray.
        """
        threshold = None if bone_from_hu is None else _hounsfield("bone_from_hu", bone_from_hu)
        parts, names = self._native.labels(*_seen_from(c_arm), threshold)
        frame_bytes, pixels, mask, images, points, markers = parts
        return Labels.of(_image(frame_bytes, pixels), mask, images, points, names, markers)

    def volume(self) -> Optional[Ct]:
        """Returns a copy of the CT before any drilling; None if the scene has none."""
        volume = self._scene.volume()
        if volume is None:
            return None
        header = g.Volume(volume[0])
        columns, rows, slices = (int(n) for n in header.dimensions)
        return Ct(header, np.frombuffer(volume[1], "<i2").reshape(slices, rows, columns))

    def drilled(self) -> npt.NDArray[np.uint32]:
        """Returns flat indices of the voxels drilled since tick 0, in order of removal, x fastest:
        `volume().hu.reshape(-1)[drilled()]`.
        """
        return np.frombuffer(self._native.drilled(), "<u4")

    def record(self, folder: Union[str, "os.PathLike[str]"]) -> Recording:
        """Records from tick 0 on to `run.mcap` in a folder, which is created; frames are not recorded.

            with sim.record("out/mine"):
                sim.step(command, ticks=1000)

        The file gets its name when the recording is closed. `trabecula replay --verify` accepts it.

        Raises:
            ArgumentError, Error: The simulation is past tick 0; or the folder contains a `run.mcap` or cannot
                be written.
        """
        self._native.record(os.fspath(folder))
        return Recording(self._native, Path(folder) / "run.mcap")

    def __repr__(self) -> str:
        return f"Sim({self._scene.facts()[0]!r}, tick={self.tick}, hash={self.hash})"


class Recording:
    """An open recording of `Sim.record`; closed at the end of a `with` block or by `close`."""

    def __init__(self, recorded: native.Sim, path: Path) -> None:
        self._native = recorded
        #: The log, once the recording is closed.
        self.path = path

    def close(self) -> None:
        """Completes the log and gives the file its name.

        Raises:
            Error: The log cannot be written; there is no file then.
        """
        self._native.close_recording()

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Batch:
    """Several simulations of one scene, stepped together on several threads while the interpreter lock is
    released.

    They share the volume. Each simulation is stepped by a single thread, so the results do not depend on the
    number of threads.
    """

    def __init__(
        self,
        scene: SceneFile = None,
        n: int = 1,
        *,
        threads: int = 0,
        overrides: Union[Overrides, Sequence[Overrides], None] = None,
        seeds: Union[int, Sequence[int], None] = None,
        drive: Drive = False,
    ) -> None:
        """Creates `n` simulations at tick 0.

        Args:
            scene: Scene file; None: the built-in femur.
            n: Number of simulations, 1 or more.
            threads: Number of threads, at most one per simulation; 0: the machine's number of cores.
            overrides: For all simulations, or a sequence with one mapping each.
            seeds: Replace the scene's `run.seed`: one for all, or a sequence with one each.
            drive: As in `Sim`.

        Raises:
            ArgumentError: As in `Sim`; or the number of overrides or seeds differs from the number of
                simulations.
        """
        count = whole("n", n)
        if count == 0:
            raise ArgumentError("`n` is 0, expected 1 or more")
        of_each = overrides if isinstance(overrides, Sequence) else None
        seed_of_each = seeds if isinstance(seeds, Sequence) else None
        for name, given in (("overrides", of_each), ("seeds", seed_of_each)):
            if given is not None and len(given) != count:
                raise ArgumentError(f"{len(given)} `{name}`, expected {count}: one for each simulation")
        common = None if isinstance(overrides, Sequence) else overrides
        common_seed = None if isinstance(seeds, Sequence) else seeds
        first: Optional[native.Scene] = None
        scenes: list[native.Scene] = []
        for index in range(count):
            if of_each is None and seed_of_each is None and first is not None:
                scenes.append(first)
                continue
            own = common if of_each is None else of_each[index]
            own_seed = common_seed if seed_of_each is None else seed_of_each[index]
            scenes.append(_loaded(scene, own, own_seed, first))
            first = scenes[0]
        self._native = native.Batch(scenes, whole("threads", threads), *_driving(drive))
        self._driven = self._native.driven()
        self._count = count

    def __len__(self) -> int:
        return self._count

    @property
    def threads(self) -> int:
        """Number of threads."""
        return self._native.threads()

    @property
    def driven(self) -> list[str]:
        """Names of the controllers that the caller drives, the same in every simulation."""
        return list(self._driven)

    @property
    def states(self) -> npt.NDArray[np.void]:
        """The current states: an array of shape (n,) with the fields of a State, such as
        `states["t_world_burr"]["position_m"]` of shape (n, 3). Read-only; it never changes. Arrays have their
        full length.
        """
        return np.frombuffer(self._native.states(), g.State.dtype)

    def state(self, index: int) -> g.State:
        """Returns the current state of one simulation."""
        return g.State(self.states[index].tobytes())

    @property
    def hashes(self) -> list[str]:
        """`Sim.hash` of each simulation."""
        return [f"{high:016x}{low:016x}" for low, high in self.states["hash"].tolist()]

    def commands(self) -> npt.NDArray[np.void]:
        """Returns an array of empty commands to fill in: shape (n, number of driven controllers), fields of a
        Command.
        """
        return np.zeros((self._count, len(self._driven)), g.Command.dtype)

    def step(
        self, commands: Union[npt.NDArray[np.void], g.Command, None] = None, ticks: int = 1
    ) -> npt.NDArray[np.void]:
        """Runs ticks in every simulation and returns `states`.

        Args:
            commands: An array as returned by `commands` (or of shape (n,), if one controller is driven), one
                Command for all, or None.
            ticks: Number of ticks.

        Raises:
            ArgumentError: The command of a simulation is refused (the first one is reported). That simulation
                has not advanced, but the others have.
            KeyboardInterrupt: Ctrl-C; likewise for any exception of a signal handler. Each simulation stays
                at the tick reached.
        """
        return np.frombuffer(self._native.step(self._packed(commands), whole("ticks", ticks)), g.State.dtype)

    def linearize(
        self,
        commands: Union[npt.NDArray[np.void], g.Command, None] = None,
        *,
        inputs: Union[str, Sequence[str]] = (),
        outputs: Union[str, Sequence[str]] = (),
    ) -> list[LinearModel]:
        """Linearises each simulation at its current state, on all threads: `Sim.linearize`.

        Args:
            commands: As in `step`.
            inputs: Fields of a Command.
            outputs: Fields of a State.

        Raises:
            ArgumentError: As in `Sim.linearize`.
        """
        models = self._native.linearize(
            self._packed(commands), signals("inputs", inputs), signals("outputs", outputs)
        )
        return [LinearModel.of(model) for model in models]

    def _packed(self, commands: Union[npt.NDArray[np.void], g.Command, None]) -> Optional[bytes]:
        if isinstance(commands, g.Command):
            if len(self._driven) != 1:
                driven = self._driven or "no controllers; see drive"
                raise ArgumentError(f"a single command, expected an array; driven: {driven}")
            return bytes(commands._buffer) * self._count
        if commands is None:
            return None
        array = np.ascontiguousarray(commands)
        expected = (self._count, len(self._driven))
        has_size = array.size == expected[0] * expected[1] and array.shape[:1] == expected[:1]
        if array.dtype != g.Command.dtype or not has_size:
            text = f"`commands` has shape {array.shape} and type {array.dtype.name}"
            raise ArgumentError(f"{text}, expected {expected} of Command.dtype")
        return array.tobytes()

    def snapshot(self, index: int) -> Snapshot:
        """Takes a snapshot of one simulation."""
        return Snapshot(self._native.snapshot(whole("index", index)))

    def restore(self, snapshots: Union[Snapshot, Sequence[Snapshot]]) -> None:
        """Restores one snapshot in all simulations, or one in each.

        Raises:
            ArgumentError: A snapshot is from another scene, or their number differs from the number of
                simulations.
        """
        several = [snapshots] if isinstance(snapshots, Snapshot) else list(snapshots)
        self._native.restore([_taken(snapshot) for snapshot in several])

    def reset(self, which: Optional[Sequence[bool]] = None) -> None:
        """Resets all simulations to tick 0, or those whose flag is true."""
        flags = [True] * self._count if which is None else [bool(flag) for flag in which]
        self._native.reset(flags)

    def drilled(self, index: int) -> npt.NDArray[np.uint32]:
        """`Sim.drilled` of one simulation."""
        return np.frombuffer(self._native.drilled(whole("index", index)), "<u4")

    def __repr__(self) -> str:
        return f"Batch(n={self._count}, threads={self.threads})"


def identify(study: Union[str, "os.PathLike[str]"], task: str = "fit") -> dict[str, Any]:
    """Fits parameters of scenes to measured files, as `trabecula identify` does.

    Ctrl-C ends it. The simulations run on all cores, and the interpreter lock is released meanwhile.

    Args:
        study: Study file (docs/identify.md).
        task: "fit"; "check": compare once at the starting point; "design": rank the candidate experiments.

    Returns:
        The result that the command prints with `--json`: `parameters` with `value`, `sd` and `interval`,
        `covariance`, `correlation`, `undetermined`, `cautions`, `experiments`, and `toml` for a scene.

    Raises:
        ArgumentError: The study, a scene or a measured file is refused, with the error text of the command.
    """
    if task not in ("fit", "check", "design"):
        raise ArgumentError(f"`task` is {task!r}, expected 'fit', 'check' or 'design'")
    result: dict[str, Any] = json.loads(native.identify(os.fspath(study), task))
    return result


def _unpickled_snapshot(packed: Any) -> Snapshot:
    return Snapshot(native.Snapshot.of_packed(_packed_bytes(packed)))


def _unpickled_sim(kind: Any, packed: Any) -> Sim:
    if not (isinstance(kind, type) and issubclass(kind, Sim)):
        raise ArgumentError(f"the pickle is of {kind!r}, expected a Sim")
    sim = kind.__new__(kind)
    sim._take(native.Sim.of_packed(_packed_bytes(packed)))
    return sim


def _packed_bytes(packed: Any) -> bytes:
    if not isinstance(packed, bytes):
        raise ArgumentError(f"the pickle holds a {type(packed).__name__}, expected bytes")
    return packed


def _loaded(
    scene: SceneFile, overrides: Optional[Overrides], seed: Optional[int], beside: Optional[native.Scene]
) -> native.Scene:
    if overrides is not None and not isinstance(overrides, Mapping):
        raise ArgumentError(f"`overrides` is {overrides!r}, expected values by scene key")
    file = None if scene is None else os.fspath(scene)
    return native.Scene.load(file, settings(overrides), None if seed is None else whole("seed", seed), beside)


def _driving(drive: Drive) -> tuple[bool, list[str]]:
    if isinstance(drive, bool):
        return drive, []
    names = [drive] if isinstance(drive, str) else list(drive)
    if not all(isinstance(name, str) for name in names):
        raise ArgumentError(f"`drive` is {drive!r}, expected True, or names of controllers")
    return False, names


def _taken(snapshot: Snapshot) -> native.Snapshot:
    if not isinstance(snapshot, Snapshot):
        raise ArgumentError(f"`snapshot` is {snapshot!r}, expected a Snapshot")
    return snapshot._native


def _command(name: str, command: Any) -> g.Command:
    if not isinstance(command, g.Command):
        raise ArgumentError(f"the command for {name!r} is {command!r}, expected a Command")
    return command


def _image(frame_bytes: bytes, pixels: bytes) -> Image:
    frame = g.Frame(frame_bytes)
    return Image(frame, np.frombuffer(pixels, "<u2").reshape(frame.geometry.rows, frame.geometry.columns))


def _seen_from(c_arm: CArm) -> tuple[Optional[bytes], Optional[tuple[float, float]]]:
    """Returns the bytes of a C-arm or its angles; neither for the scene's."""
    if isinstance(c_arm, g.CArmGeometry):
        return bytes(c_arm._buffer), None
    return None, None if c_arm is None else _angles(c_arm)


def _angles(c_arm: Any) -> tuple[float, float]:
    try:
        primary_deg, secondary_deg = c_arm
        return float(primary_deg), float(secondary_deg)
    except (TypeError, ValueError):
        text = f"`c_arm` is {c_arm!r}, expected a CArmGeometry or two angles in degrees"
        raise ArgumentError(text) from None


def _hounsfield(name: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not -1000 <= value <= 32767:
        raise ArgumentError(f"`{name}` is {value!r}, expected a whole number from -1000 to 32767")
    return int(value)


def _digits(state: g.State) -> str:
    low, high = state.hash
    return f"{int(high):016x}{int(low):016x}"
