"""Requests an X-ray frame every 0.1 s, finds the tip in it, and steers the tip sideways to a target.

The tip is the end of the tool's metal: the dark pixel farthest along the tool, refined to the mean of the
dark pixels of the last 3 mm. Projected back to the plane of the tool, it gives the sideways error, which
drives the tension.
"""

from __future__ import annotations

from contextlib import suppress
from typing import Any, Optional, Sequence

import numpy as np
import numpy.typing as npt

import trabecula

#: NumPy numbers of any type.
Numbers = npt.NDArray[Any]
TICKS_BETWEEN_FRAMES = 100
#: Pixels darker than this show metal (full scale: 65535).
DARK = 8000
#: Target of the burr: sideways offset from its start (world x).
TARGET_M = 0.006
GAIN_N_PER_M = 350.0
END_LENGTH_M = 0.003


def dot(a: Sequence[float] | Numbers, b: Sequence[float] | Numbers) -> float:
    """Dot product, summed in the same order as in the other languages; NumPy's order may differ."""
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def find_tip(image: trabecula.Image) -> Optional[tuple[float, float]]:
    """Returns column and row of the tool's end; None if there is no metal in the image."""
    geometry = image.frame.geometry
    # +z of the burr in the image: last column of the rotation matrix, projected on rows and columns.
    x, y, z, w = image.frame.t_world_burr.orientation_xyzw
    axis = (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y))
    right, down = dot(geometry.row_axis, axis), dot(geometry.column_axis, axis)
    rows, columns = np.nonzero(image.pixels < DARK)
    if len(rows) == 0:
        return None
    along = columns * right + rows * down
    at_end = along >= along.max() - END_LENGTH_M / geometry.pixel_pitch_m[0]
    return float(columns[at_end].mean()), float(rows[at_end].mean())


def sideways_m(geometry: trabecula.CArmGeometry, column: float) -> float:
    """Returns the world x of a column, in the plane of the isocentre: the image is magnified by the ratio of
    source-detector to source-isocentre distance, 1000 to 700 mm.
    """
    return float((column - 0.5 * (geometry.columns - 1.0)) * geometry.pixel_pitch_m[0] * 0.7)


tension_n = 0.0
# The run may end while waiting for a frame.
with trabecula.Client() as client, suppress(trabecula.Ended):
    last_tick = client.info.tick_count
    for state in client.states():
        if state.tick % TICKS_BETWEEN_FRAMES == 0 and state.tick < last_tick:
            image = client.wait_frame(client.request_frame(state.tick))
            tip = find_tip(image)
            if tip is not None:
                column, row = tip
                error_m = TARGET_M - sideways_m(image.frame.geometry, column)
                tension_n = max(tension_n + GAIN_N_PER_M * error_m, 0.0)
                print(
                    f"tick {state.tick:4}  tip at column {column:6.2f} row {row:6.2f}  "
                    f"error {error_m * 1e3:6.3f} mm  tension {tension_n:6.3f} N"
                )
        with client.command() as command:
            command.tendon_mode = trabecula.TendonMode.SERVO_JF
            command.tendon_force_n[0] = tension_n
