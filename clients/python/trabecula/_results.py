"""Results returned by a client."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from . import _generated as g
from ._errors import ArgumentError
from ._geometry import Floats, Points, numbers


@dataclass(frozen=True)
class Info:
    """Constant properties of a session."""

    #: Folder of the session.
    folder: str
    #: Name of this client's controller; empty for an observer.
    controller: str
    #: The complete scene as TOML.
    scene_toml: str
    #: Simulated time of a tick.
    dt_s: float
    #: Number of ticks of the complete run.
    tick_count: int
    #: Ticks between two scheduled frames; 0 if there are none.
    frame_period_ticks: int
    #: Index of the controller in the scene; -1 for an observer.
    controller_index: int
    #: Number of controllers in the scene.
    controller_count: int
    #: Whether a tick waits for every controller.
    lockstep: bool
    #: Pixel columns of a frame; 0 without X-ray.
    frame_columns: int
    #: Pixel rows of a frame; 0 without X-ray.
    frame_rows: int
    #: Whether there is a CT volume.
    has_volume: bool


class Image(NamedTuple):
    """An X-ray frame in shared memory."""

    #: Tick, C-arm and size.
    frame: g.Frame
    #: Intensities, shape (rows, columns), row 0 at the top; 0 is black.
    pixels: npt.NDArray[np.uint16]

    def __repr__(self) -> str:
        rows, columns = self.pixels.shape
        return f"Image(frame={self.frame!r}, pixels=[{rows} x {columns}])"


class Ct(NamedTuple):
    """The CT volume in shared memory."""

    #: Geometry.
    volume: g.Volume
    #: Hounsfield units, shape (z, y, x).
    hu: npt.NDArray[np.int16]

    def world_to_voxel(self, point_m: Points) -> Floats:
        """Converts world points to voxel coordinates i, j, k, shape (3,) or (…, 3). Voxel centres are
        integers.
        """
        axes = self.volume.direction.reshape(3, 3)
        offset = numbers("point_m", point_m, 3) - self.volume.origin_m
        return np.asarray(offset @ axes.T / self.volume.spacing_m)

    def voxel_to_world(self, voxel: Points) -> Floats:
        """Converts voxel coordinates i, j, k to world points, shape (3,) or (…, 3)."""
        axes = self.volume.direction.reshape(3, 3)
        return np.asarray(self.volume.origin_m + (numbers("voxel", voxel, 3) * self.volume.spacing_m) @ axes)

    def hu_at(self, point_m: Points) -> npt.NDArray[np.int16]:
        """Returns the Hounsfield units of the voxels that contain world points: one number, shape (), or an
        array, shape (…).

        Raises:
            ArgumentError: A point lies outside the volume.
        """
        index = np.floor(self.world_to_voxel(point_m) + 0.5)
        # Written so that NaN fails the check.
        if not np.all((index >= 0) & (index < self.volume.dimensions)):
            text = f"`point_m` is {point_m!r}: outside the volume, whose corners are {self._corners_m()} m"
            raise ArgumentError(text)
        i, j, k = np.moveaxis(index.astype(np.int64), -1, 0)
        return np.asarray(self.hu[k, j, i])

    def _corners_m(self) -> str:
        ends = self.voxel_to_world(np.stack([np.zeros(3), self.volume.dimensions - 1.0]))
        return " and ".join(str([round(float(x), 4) for x in end]) for end in ends)

    def __repr__(self) -> str:
        return f"Ct(hu=[{' x '.join(str(n) for n in self.hu.shape)}], {self._corners_m()} m)"


class Removal(NamedTuple):
    """Voxels removed at a tick, in shared memory."""

    #: The message.
    removed: g.Removed
    #: Flat indices, x fastest: `ct.hu.reshape(-1)[voxel_index]`.
    voxel_index: npt.NDArray[np.uint32]


class Reading(NamedTuple):
    """A reading of a sensor, copied."""

    #: `State.tick` of the state it arrived with.
    tick: int
    #: `State.tick` of the measured state.
    sample_tick: int
    #: Index of the sensor in the scene.
    sensor_index: int
    #: Kind of sensor.
    kind: g.SensorKind
    #: False if the reading dropped out, or a tracker did not see its marker.
    valid: bool
    #: Measured values; for order and units see docs/sensors.md.
    value: npt.NDArray[np.float64]

    @staticmethod
    def of(message: g.SensorReading) -> Reading:
        """Copies a message."""
        return Reading(
            message.tick,
            message.sample_tick,
            message.sensor_index,
            message.kind,
            message.valid == 1,
            np.array(message.value),
        )


class Jacobian(NamedTuple):
    """Jacobian and compliance of the tip, copied; rows are linear, then angular, world axes."""

    #: `State.tick` of the state.
    tick: int
    #: 6 x 4: twist of the tip per rate of each tendon's tension; 0 without the tendon.
    per_tension: npt.NDArray[np.float64]
    #: 6 x 6: twist of the tip per twist of the tool base.
    per_base: npt.NDArray[np.float64]
    #: 6 x 6: displacement of the tip per force and torque on it, at constant tensions.
    compliance: npt.NDArray[np.float64]

    @staticmethod
    def of(message: g.TipJacobian) -> Jacobian:
        """Copies a message."""
        fields = (message.per_tension, message.per_base, message.compliance)
        return Jacobian(message.tick, *(np.array(field).reshape(6, -1) for field in fields))


class SessionEvent(NamedTuple):
    """An event of the session."""

    #: Tick at which the sender noticed it.
    tick: int
    #: Severity.
    severity: g.Severity
    #: Kind of event.
    code: g.EventCode
    #: Sender: one of the `SENDER_` constants.
    sender: int
    #: What happened.
    text: str

    def is_reset(self) -> bool:
        """Returns whether the simulation was reset."""
        return self.sender == g.SENDER_PHYSICS and self.code == g.EventCode.RESET


def as_array(memory: Any, dtype: str, count: int) -> npt.NDArray[Any]:
    """Returns numbers in read-only memory as an array."""
    return np.frombuffer(memory, dtype) if count else np.empty(0, dtype)
