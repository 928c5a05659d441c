"""Poses, pixels and voxels: from one frame to another. Everything is in metres, in the world frame (the patient's, LPS), unless it says
otherwise.
"""

from __future__ import annotations

from typing import Any, Optional, Sequence, Union

import numpy as np
import numpy.typing as npt

from ._errors import ArgumentError
from ._generated import CArmGeometry, Pose

Floats = npt.NDArray[np.float64]
#: One point, or many: shape (3,) or (…, 3).
Points = Union[Sequence[float], Sequence[Sequence[float]], npt.NDArray[Any]]


def numbers(name: str, value: Any, last: int) -> Floats:
    """The argument as an array whose last axis has this length."""
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.ndim == 0 or array.shape[-1] != last:
        raise ArgumentError(f"`{name}` is {value!r}, expected {last} numbers, or rows of {last}")
    return array


def rotation_matrix(orientation_xyzw: Union[Sequence[float], npt.NDArray[Any]]) -> Floats:
    """The rotation of a unit quaternion x, y, z, w as a matrix, shape (3, 3): its columns are the child's axes in the parent frame."""
    quaternion = numbers("orientation_xyzw", orientation_xyzw, 4)
    if quaternion.shape != (4,) or not abs(float(quaternion @ quaternion) - 1.0) <= 1e-6:
        raise ArgumentError(f"`orientation_xyzw` is {orientation_xyzw!r}, expected one unit quaternion x, y, z, w")
    x, y, z, w = (float(part) for part in quaternion)
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def pose_matrix(pose: Pose) -> Floats:
    """A pose `T_parent_child` as a homogeneous matrix, shape (4, 4): it takes points of the child frame to the parent frame."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrix(pose.orientation_xyzw)
    matrix[:3, 3] = pose.position_m
    return matrix


def _normal(geometry: CArmGeometry) -> Floats:
    """Unit normal of the detector, from the source to it."""
    normal = np.cross(geometry.row_axis, geometry.column_axis)
    away = float(normal @ (geometry.detector_centre_m - geometry.source_m))
    return np.asarray(normal if away > 0.0 else -normal)


def _depth_of_detector_m(geometry: CArmGeometry) -> float:
    return float(_normal(geometry) @ (geometry.detector_centre_m - geometry.source_m))


def _axes_and_middle(geometry: CArmGeometry) -> tuple[Floats, Floats]:
    """Unit vectors along a row and along a column, shape (2, 3), and the pixel at the detector's centre."""
    middle = 0.5 * (np.array([geometry.columns, geometry.rows]) - 1.0)
    return np.stack([geometry.row_axis, geometry.column_axis]), middle


def world_to_pixel(geometry: CArmGeometry, point_m: Points) -> Floats:
    """Column and row at which points appear in a frame, shape (2,) or (…, 2). Pixel centres are whole numbers; a point beside the detector
    has a column or row beyond the picture.

    Args:
        geometry: `image.frame.geometry`.
        point_m: World points.

    Raises:
        ArgumentError: A point lies in or behind the plane of the source, and so in no picture.
    """
    points = numbers("point_m", point_m, 3)
    ray = points - geometry.source_m
    depth = ray @ _normal(geometry)
    if not np.all(depth > 0.0):
        raise ArgumentError(f"`point_m` is {point_m!r}: a point that is not in front of the source has no pixel")
    on_detector = geometry.source_m + ray * (_depth_of_detector_m(geometry) / depth)[..., np.newaxis]
    offset = on_detector - geometry.detector_centre_m
    axes, middle = _axes_and_middle(geometry)
    return np.asarray(offset @ axes.T / geometry.pixel_pitch_m + middle)


def pixel_to_world(geometry: CArmGeometry, pixel: Points, depth_m: Optional[float] = None) -> Floats:
    """The world points that appear at pixels, shape (3,) or (…, 3).

    Args:
        geometry: `image.frame.geometry`.
        pixel: Column and row.
        depth_m: Distance of the points from the source along the detector's normal, above 0; None: on the detector.
    """
    pixels = numbers("pixel", pixel, 2)
    axes, middle = _axes_and_middle(geometry)
    on_detector = geometry.detector_centre_m + ((pixels - middle) * geometry.pixel_pitch_m) @ axes
    if depth_m is None:
        return np.asarray(on_detector)
    if not depth_m > 0.0:
        raise ArgumentError(f"`depth_m` is {depth_m!r}, expected a distance above 0")
    return np.asarray(geometry.source_m + (on_detector - geometry.source_m) * (depth_m / _depth_of_detector_m(geometry)))
