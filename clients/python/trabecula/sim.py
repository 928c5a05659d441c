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

A tick is that of `trabecula run --mode lockstep`: for the same commands it has the same hash. What a simulation returns lies in memory of
its own and never changes: a state taken before a step shows what was then. Units are SI; each name ends in its unit.
"""

from __future__ import annotations

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
from ._results import Ct, Image, Reading
from ._run import settings

__all__ = ["Batch", "Labels", "Mask", "Sim", "Snapshot"]

#: A file, or None for the built-in femur.
SceneFile = Union[str, "os.PathLike[str]", None]
Overrides = Mapping[str, Any]
#: True: every controller; or the names of those that the caller drives in place of built-in ones.
Drive = Union[bool, str, Iterable[str]]
#: For the only driven controller, or by the names of several; None asks for nothing.
Commands = Union[g.Command, Mapping[str, g.Command], None]
#: The scene's C-arm (None), one by its geometry, or the scene's turned to a primary and a secondary angle in degrees.
CArm = Union[g.CArmGeometry, tuple[float, float], None]


class Snapshot:
    """The state of a simulation at a tick, as `Sim.snapshot` takes it. Holds what has been drilled, not the volume."""

    __slots__ = ("_native",)

    def __init__(self, taken: native.Snapshot) -> None:
        self._native = taken

    @property
    def state(self) -> g.State:
        """The state of its tick."""
        return g.State(self._native.state())

    def __repr__(self) -> str:
        return f"Snapshot(tick={self.state.tick}, hash={_digits(self.state)})"


class Sim:
    """One simulation.

    Controllers of the scene that are external or programs are the caller's to drive: `step` takes their commands. Built-in ones run inside
    the simulation as in a run, unless `drive` gives them to the caller.

    It has a thread of its own. Any thread may use it; they wait for each other, and the interpreter lock is released meanwhile. A child of
    `fork` cannot: its calls raise an Error. What was returned stays readable there.
    """

    def __init__(
        self, scene: SceneFile = None, *, overrides: Optional[Overrides] = None, seed: Optional[int] = None, drive: Drive = False
    ) -> None:
        """A simulation at tick 0.

        Args:
            scene: The scene file; None: the built-in femur. Its mode does not matter: a simulation is always in lockstep.
            overrides: Values for keys of the scene, by their path; a number in a path counts the tables of an array from 0.
            seed: In place of the scene's `run.seed`.
            drive: True: the caller drives every controller; or the names of built-in ones to drive.

        Raises:
            ArgumentError: The scene, an override or a name is refused, in the words of `trabecula scene check`.
        """
        self._take(native.Sim(_loaded(scene, overrides, seed, None), *_driving(drive)))

    @classmethod
    def from_log(cls, log: Union[str, "os.PathLike[str]"], tick: Optional[int] = None, *, drive: Drive = False) -> Sim:
        """The simulation of a recorded run, taken to the state of a tick; `reset` goes back to there.

        The log's commands are stepped through the physics, so this takes time in proportion to the tick; each state on the way is compared
        with the log's. It goes on in lockstep, also from a log of real time.

        Args:
            log: A run's folder, or its `run.mcap`, of this build.
            tick: `State.tick`; None: the log's last.
            drive: As in `Sim`. Built-in controllers that stay with the simulation go on as they would have; that needs a lockstep log from
                tick 0 on, and controllers that see no frames.

        Raises:
            ArgumentError: No such log or tick, or a controller that cannot go on.
            Error: The log cannot be read, or this build's physics leads elsewhere.
        """
        sim = cls.__new__(cls)
        sim._take(native.Sim.from_log(os.fspath(log), None if tick is None else whole("tick", tick), *_driving(drive)))
        return sim

    def _take(self, made: native.Sim) -> None:
        self._native = made
        self._scene = made.scene()
        self._driven = made.driven()
        self._nothing = bytes(g.Command.dtype.itemsize * len(self._driven))

    @property
    def state(self) -> g.State:
        """The present state."""
        return g.State(self._native.state())

    @property
    def tick(self) -> int:
        """Number of ticks since the start."""
        return self.state.tick

    @property
    def hash(self) -> str:
        """Hash of everything up to now, 32 hexadecimal digits: h_k of the log of a run with the same commands."""
        return _digits(self.state)

    @property
    def dt_s(self) -> float:
        """Simulated time of a tick."""
        return self._scene.facts()[1]

    @property
    def scene_toml(self) -> str:
        """The whole scene, with every override."""
        return self._scene.toml()

    @property
    def notes(self) -> list[str]:
        """What is noteworthy about scene and volume: what was chosen or assumed, and what is most likely a mistake."""
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
        """Parts of valid commands that could not be followed in the last `step`, such as unreachable goals, and why."""
        return self._native.refusals()

    def readings(self) -> list[Reading]:
        """Readings of the scene's sensors that arrived in the last `step`, the newest 1024; before the first and after a jump, those of
        the present state.
        """
        data = self._native.readings()
        size = g.SensorReading.dtype.itemsize
        return [Reading.of(g.SensorReading(data[at : at + size])) for at in range(0, len(data), size)]

    def step(self, command: Commands = None, ticks: int = 1) -> g.State:
        """Makes ticks and returns the state after the last.

        Every driven controller sends its command anew at each of the ticks. One without a command sends one that asks for nothing, so
        tendons, arm and burr go on with what they were last asked for.

        Args:
            command: For the driven controller, or by name for several. Its `sequence` and `state_tick` are filled in.
            ticks: How many.

        Raises:
            ArgumentError: A value out of its range, a part of the tool that is not the controller's, or no controller to command.
                Nothing has changed then.
            KeyboardInterrupt: Ctrl-C, or what another signal handler raises. The simulation stands at the tick to which it has come.
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
            raise ArgumentError(f"`command` is {command!r}, expected a Command, or Commands by the names of controllers")
        given = dict(command)
        empty = g.Command()
        packed = b"".join(bytes(_command(name, given.pop(name, empty))._buffer) for name in self._driven)
        if given:
            raise ArgumentError(f"no driven controller {', '.join(map(repr, given))}: driven are {self._driven or 'none'}")
        return packed

    def _not_one(self) -> str:
        if not self._driven:
            return (
                f"there is no controller to command: the scene's {self.controllers} run inside the simulation; "
                "make it with drive=True, or with the name of one"
            )
        return f"several controllers are driven, {self._driven}: give their commands by name"

    def snapshot(self) -> Snapshot:
        """The present state, to come back to. Time and memory follow what has been drilled, not the volume."""
        return Snapshot(self._native.snapshot())

    def restore(self, snapshot: Snapshot) -> None:
        """Goes to the state of a snapshot, of this or another simulation of the same scene, and continues bit for bit.

        Raises:
            ArgumentError: The snapshot is of another scene, or of other driven controllers.
            Error: A recording is open.
        """
        self._native.restore(_taken(snapshot))

    def reset(self) -> None:
        """Goes back to tick 0, or to where `from_log` began.

        Raises:
            Error: A recording is open.
        """
        self._native.reset()

    def branch(self) -> Sim:
        """Another simulation in the same state. Scene and volume are shared."""
        sim = type(self).__new__(type(self))
        sim._take(self._native.branch())
        return sim

    def render(self, c_arm: CArm = None) -> Image:
        """The X-ray of the present state. Changes no later tick. From the scene's C-arm it has the pixels of a run's frame of this tick.

        Args:
            c_arm: None: the scene's; a CArmGeometry; or (primary, secondary) angles in degrees, as DICOM has them.

        Raises:
            ArgumentError: The C-arm is refused.
            Error: The scene has no X-ray.
        """
        frame_bytes, pixels = self._native.render(*_seen_from(c_arm))
        return _image(frame_bytes, pixels)

    def render_many(self, c_arms: Sequence[CArm]) -> list[Image]:
        """The X-rays of the present state from several C-arms, with the pixels of `render` of each, in less time than one after the other.

            images = sim.render_many([(angle, 0.0) for angle in range(-90, 90)])

        Args:
            c_arms: Each as in `render`. All images are in memory at the end: 2 bytes a pixel.

        Raises:
            ArgumentError: A C-arm is refused, and named by its position; nothing is rendered.
            Error: The scene has no X-ray.
            KeyboardInterrupt: Ctrl-C, or what another signal handler raises; then no image is returned.
        """
        rendered = self._native.render_many([_seen_from(c_arm) for c_arm in c_arms])
        return [_image(frame_bytes, pixels) for frame_bytes, pixels in rendered]

    def labels(self, c_arm: CArm = None, *, bone_from_hu: Optional[int] = None) -> Labels:
        """The X-ray of the present state as `render` gives it, and what it shows: masks, line integrals apart, lengths, depths, keypoints.

        Labels have neither noise nor blur. They take a walk through the voxels for every pixel, which costs a hundred times a frame.

        Args:
            c_arm: As in `render`.
            bone_from_hu: Voxels at or above this are bone; None: the scene's `drr.labels.bone_from_hu`, or else its `volume.bone_threshold_hu`.

        Raises:
            ArgumentError: The C-arm or `bone_from_hu` is refused.
            Error: The scene has no X-ray.
        """
        threshold = None if bone_from_hu is None else _hounsfield("bone_from_hu", bone_from_hu)
        frame_bytes, pixels, mask, images, points = self._native.labels(*_seen_from(c_arm), threshold)
        return Labels.of(_image(frame_bytes, pixels), mask, images, points)

    def volume(self) -> Optional[Ct]:
        """The CT before any drilling, copied; None if the scene has none."""
        volume = self._scene.volume()
        if volume is None:
            return None
        header = g.Volume(volume[0])
        columns, rows, slices = (int(n) for n in header.dimensions)
        return Ct(header, np.frombuffer(volume[1], "<i2").reshape(slices, rows, columns))

    def drilled(self) -> npt.NDArray[np.uint32]:
        """Flat indices of the voxels drilled since tick 0 in the order of their removal, x fastest: `volume().hu.reshape(-1)[drilled()]`."""
        return np.frombuffer(self._native.drilled(), "<u4")

    def record(self, folder: Union[str, "os.PathLike[str]"]) -> Recording:
        """Records from tick 0 on into `run.mcap` of a folder, which is created; frames are not recorded.

            with sim.record("out/mine"):
                sim.step(command, ticks=1000)

        The file has its name once the recording is closed. `trabecula replay --verify` accepts it.

        Raises:
            ArgumentError, Error: Ticks have been made; the folder holds a `run.mcap` or cannot be written.
        """
        self._native.record(os.fspath(folder))
        return Recording(self._native, Path(folder) / "run.mcap")

    def __repr__(self) -> str:
        return f"Sim({self._scene.facts()[0]!r}, tick={self.tick}, hash={self.hash})"


class Recording:
    """An open recording of `Sim.record`; closed by the end of a `with` block or by `close`."""

    def __init__(self, recorded: native.Sim, path: Path) -> None:
        self._native = recorded
        #: The log, once the recording is closed.
        self.path = path

    def close(self) -> None:
        """Writes the rest of the log and names the file.

        Raises:
            Error: It cannot be written; there is no file then.
        """
        self._native.close_recording()

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Batch:
    """Simulations of one scene, stepped together on several threads while the interpreter lock is released.

    They share the volume. Each is stepped whole by one thread, so no number of threads changes a bit.
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
        """`n` simulations at tick 0.

        Args:
            scene: The scene file; None: the built-in femur.
            n: How many, 1 or more.
            threads: How many threads step them, at most one for each; 0: as many as the machine has cores.
            overrides: For all, or a sequence with those of each.
            seeds: In place of the scene's `run.seed`: for all, or of each.
            drive: As in `Sim`.

        Raises:
            ArgumentError: As `Sim`; or not as many overrides or seeds as simulations.
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
        """The present states: an array of shape (n,) with the fields of a State, such as `states["t_world_burr"]["position_m"]` of shape
        (n, 3). For reading; it never changes. Arrays are at their full length.
        """
        return np.frombuffer(self._native.states(), g.State.dtype)

    def state(self, index: int) -> g.State:
        """The present state of one simulation."""
        return g.State(self.states[index].tobytes())

    @property
    def hashes(self) -> list[str]:
        """As `Sim.hash`, of each."""
        return [f"{high:016x}{low:016x}" for low, high in self.states["hash"].tolist()]

    def commands(self) -> npt.NDArray[np.void]:
        """An array of commands that ask for nothing, to be filled in: shape (n, number of driven controllers), fields of a Command."""
        return np.zeros((self._count, len(self._driven)), g.Command.dtype)

    def step(self, commands: Union[npt.NDArray[np.void], g.Command, None] = None, ticks: int = 1) -> npt.NDArray[np.void]:
        """Makes ticks with every simulation and returns `states`.

        Args:
            commands: An array as `commands` returns it (of shape (n,) too, if one controller is driven), a Command for all, or None.
            ticks: How many.

        Raises:
            ArgumentError: Of the first simulation whose command is refused; that one has made no tick, and the others have.
            KeyboardInterrupt: Ctrl-C, or what another signal handler raises. Each simulation stands at the tick to which it has come.
        """
        given: Optional[bytes] = None
        if isinstance(commands, g.Command):
            if len(self._driven) != 1:
                raise ArgumentError(f"a single command, expected an array: driven are {self._driven or 'no controllers; see drive'}")
            given = bytes(commands._buffer) * self._count
        elif commands is not None:
            array = np.ascontiguousarray(commands)
            expected = (self._count, len(self._driven))
            if array.dtype != g.Command.dtype or array.size != expected[0] * expected[1] or array.shape[:1] != expected[:1]:
                raise ArgumentError(f"`commands` has shape {array.shape} and type {array.dtype.name}, expected {expected} of Command.dtype")
            given = array.tobytes()
        return np.frombuffer(self._native.step(given, whole("ticks", ticks)), g.State.dtype)

    def snapshot(self, index: int) -> Snapshot:
        """The present state of one simulation."""
        return Snapshot(self._native.snapshot(whole("index", index)))

    def restore(self, snapshots: Union[Snapshot, Sequence[Snapshot]]) -> None:
        """Takes all simulations to one snapshot, or each to its own.

        Raises:
            ArgumentError: Of another scene, or not as many as simulations.
        """
        several = [snapshots] if isinstance(snapshots, Snapshot) else list(snapshots)
        self._native.restore([_taken(snapshot) for snapshot in several])

    def reset(self, which: Optional[Sequence[bool]] = None) -> None:
        """Takes all simulations back to tick 0, or those whose flag is true."""
        flags = [True] * self._count if which is None else [bool(flag) for flag in which]
        self._native.reset(flags)

    def drilled(self, index: int) -> npt.NDArray[np.uint32]:
        """As `Sim.drilled`, of one simulation."""
        return np.frombuffer(self._native.drilled(whole("index", index)), "<u4")

    def __repr__(self) -> str:
        return f"Batch(n={self._count}, threads={self.threads})"


def _loaded(scene: SceneFile, overrides: Optional[Overrides], seed: Optional[int], beside: Optional[native.Scene]) -> native.Scene:
    if overrides is not None and not isinstance(overrides, Mapping):
        raise ArgumentError(f"`overrides` is {overrides!r}, expected values by the keys of the scene")
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
        raise ArgumentError(f"`snapshot` is {snapshot!r}, expected what `snapshot()` returns")
    return snapshot._native


def _command(name: str, command: Any) -> g.Command:
    if not isinstance(command, g.Command):
        raise ArgumentError(f"the command for {name!r} is {command!r}, expected a Command")
    return command


def _image(frame_bytes: bytes, pixels: bytes) -> Image:
    frame = g.Frame(frame_bytes)
    return Image(frame, np.frombuffer(pixels, "<u2").reshape(frame.geometry.rows, frame.geometry.columns))


def _seen_from(c_arm: CArm) -> tuple[Optional[bytes], Optional[tuple[float, float]]]:
    """Bytes of a C-arm, or its angles; neither for the scene's."""
    if isinstance(c_arm, g.CArmGeometry):
        return bytes(c_arm._buffer), None
    return None, None if c_arm is None else _angles(c_arm)


def _angles(c_arm: Any) -> tuple[float, float]:
    try:
        primary_deg, secondary_deg = c_arm
        return float(primary_deg), float(secondary_deg)
    except (TypeError, ValueError):
        raise ArgumentError(f"`c_arm` is {c_arm!r}, expected a CArmGeometry or two angles in degrees") from None


def _hounsfield(name: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not -1000 <= value <= 32767:
        raise ArgumentError(f"`{name}` is {value!r}, expected a whole number from -1000 to 32767")
    return int(value)


def _digits(state: g.State) -> str:
    low, high = state.hash
    return f"{int(high):016x}{int(low):016x}"
