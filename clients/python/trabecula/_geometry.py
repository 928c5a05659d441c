"""Conversion of poses, pixels and voxels between frames. All in metres, in the world frame (the patient's,
LPS), unless stated otherwise.
"""

from __future__ import annotations

from typing import Any, Optional, Sequence, Union

import numpy as np
import numpy.typing as npt

from ._errors import ArgumentError
from ._generated import CArmGeometry, Pose

Floats = npt.NDArray[np.float64]
#: One or several points: shape (3,) or (…, 3).
Points = Union[Sequence[float], Sequence[Sequence[float]], npt.NDArray[Any]]


def numbers(name: str, value: Any, last: int) -> Floats:
    """Converts an argument to an array whose last axis has length `last`."""
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.ndim == 0 or array.shape[-1] != last:
        raise ArgumentError(f"`{name}` is {value!r}, expected {last} numbers, or rows of {last}")
    return array


def rotation_matrix(orientation_xyzw: Union[Sequence[float], npt.NDArray[Any]]) -> Floats:
    """Converts a unit quaternion x, y, z, w to a rotation matrix, shape (3, 3); its columns are the child's
    axes in the parent frame.
    """
    quaternion = numbers("orientation_xyzw", orientation_xyzw, 4)
    if quaternion.shape != (4,) or not abs(float(quaternion @ quaternion) - 1.0) <= 1e-6:
        text = f"`orientation_xyzw` is {orientation_xyzw!r}, expected one unit quaternion x, y, z, w"
        raise ArgumentError(text)
    x, y, z, w = (float(part) for part in quaternion)
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def pose_matrix(pose: Pose) -> Floats:
    """Converts a pose `T_parent_child` to a homogeneous matrix, shape (4, 4), which maps points of the child
    frame to the parent frame.
    """
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrix(pose.orientation_xyzw)
    matrix[:3, 3] = pose.position_m
    return matrix


def _normal(geometry: CArmGeometry) -> Floats:
    """Returns the unit normal of the detector, pointing away from the source."""
    normal = np.cross(geometry.row_axis, geometry.column_axis)
    away = float(normal @ (geometry.detector_centre_m - geometry.source_m))
    return np.asarray(normal if away > 0.0 else -normal)


def _depth_of_detector_m(geometry: CArmGeometry) -> float:
    return float(_normal(geometry) @ (geometry.detector_centre_m - geometry.source_m))


def _axes_and_middle(geometry: CArmGeometry) -> tuple[Floats, Floats]:
    """Returns unit vectors along a row and a column, shape (2, 3), and the pixel at the detector's centre."""
    middle = 0.5 * (np.array([geometry.columns, geometry.rows]) - 1.0)
    return np.stack([geometry.row_axis, geometry.column_axis]), middle


def world_to_pixel(geometry: CArmGeometry, point_m: Points) -> Floats:
    """Projects world points into a frame: column and row, shape (2,) or (…, 2). Pixel centres are integers; a
    point outside the detector has a column or row beyond the image.

    Args:
        geometry: `image.frame.geometry`.
        point_m: World points.

    Raises:
        ArgumentError: A point lies in or behind the plane of the source and cannot be projected.
    """
    points = numbers("point_m", point_m, 3)
    ray = points - geometry.source_m
    depth = ray @ _normal(geometry)
    if not np.all(depth > 0.0):
        text = f"`point_m` is {point_m!r}: a point that is not in front of the source has no pixel"
        raise ArgumentError(text)
    on_detector = geometry.source_m + ray * (_depth_of_detector_m(geometry) / depth)[..., np.newaxis]
    offset = on_detector - geometry.detector_centre_m
    axes, middle = _axes_and_middle(geometry)
    return np.asarray(offset @ axes.T / geometry.pixel_pitch_m + middle)


def pixel_to_world(geometry: CArmGeometry, pixel: Points, depth_m: Optional[float] = None) -> Floats:
    """Returns the world points seen at pixels, shape (3,) or (…, 3).

    Args:
        geometry: `image.frame.geometry`.
        pixel: Column and row.
        depth_m: Distance of the points from the source along the detector's normal, above 0; None for points
            on the detector.
    """
    pixels = numbers("pixel", pixel, 2)
    axes, middle = _axes_and_middle(geometry)
    on_detector = geometry.detector_centre_m + ((pixels - middle) * geometry.pixel_pitch_m) @ axes
    if depth_m is None:
        return np.asarray(on_detector)
    if not depth_m > 0.0:
        raise ArgumentError(f"`depth_m` is {depth_m!r}, expected a distance above 0")
    share = depth_m / _depth_of_detector_m(geometry)
    return np.asarray(geometry.source_m + (on_detector - geometry.source_m) * share)
