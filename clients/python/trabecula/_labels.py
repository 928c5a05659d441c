"""Labels of an X-ray frame."""

from __future__ import annotations

from enum import IntFlag
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ._results import Image

__all__ = ["Labels", "Mask"]


class Mask(IntFlag):
    """Bits of `Labels.mask`. A pixel can have several, because an X-ray has no foreground."""

    #: The ray crosses bone that has not been drilled.
    BONE = 1
    #: The ray crosses metal of the shaft, the links or the drive cable.
    TOOL = 2
    #: The ray crosses the burr.
    BURR = 4
    #: The ray crosses drilled voxels.
    TUNNEL = 8
    #: The ray crosses an object of the scene: a wire, a screw, a marker, a rigid body.
    OBJECT = 16


class Labels(NamedTuple):
    """An X-ray frame with labels. Images have shape (rows, columns), row 0 at the top, and refer to the rays
    to the pixel centres.
    """

    #: The frame. Its `frame.projection` projects the keypoints; `frame.t_world_burr` is the burr's pose.
    image: Image
    #: Bits of `Mask`.
    mask: npt.NDArray[np.uint8]
    #: Attenuation (-ln of the transmission) of the anatomy without the part displaced by tool and objects.
    anatomy: npt.NDArray[np.float32]
    #: Attenuation added by the tool's metal and by objects.
    metal: npt.NDArray[np.float32]
    #: Length of the ray in bone, m; not reduced by the tool.
    bone_m: npt.NDArray[np.float32]
    #: Length of the ray in drilled voxels, m.
    tunnel_m: npt.NDArray[np.float32]
    #: Depth at which the ray first enters the tool or burr, m from the source along the detector's normal;
    #: NaN without metal.
    tool_depth_m: npt.NDArray[np.float32]
    #: Depth at which the ray first enters bone, m; NaN without bone.
    bone_depth_m: npt.NDArray[np.float32]
    #: Column and row (pixel centres at integers) and depth, m, of the base, the joints from base to tip, and
    #: the burr; shape (joints + 2, 3). NaN for a point level with or behind the source.
    keypoints: npt.NDArray[np.float64]
    #: 0: outside the image; 1: the ray also crosses another part of the tool; 2: it crosses no other part.
    #: Shape (joints + 2,).
    visibility: npt.NDArray[np.uint8]
    #: Names of the marker balls: those of the scene's objects, numbered from 1 where an object has several.
    marker_names: list[str]
    #: Column, row and depth, m, of their centres, as of `keypoints`; shape (markers, 3).
    markers: npt.NDArray[np.float64]
    #: Their centres in the world, m; shape (markers, 3).
    marker_positions_m: npt.NDArray[np.float64]

    @staticmethod
    def of(
        image: Image, mask: bytes, images: bytes, points: bytes, marker_names: list[str], markers: bytes
    ) -> Labels:
        """Creates labels from their bytes."""
        shape = image.pixels.shape
        places = np.frombuffer(points, "<f8").reshape(-1, 4)
        centres = np.frombuffer(markers, "<f8").reshape(-1, 6)
        layers = np.frombuffer(images, "<f4").reshape(6, *shape)
        anatomy, metal, bone_m, tunnel_m, tool_depth_m, bone_depth_m = layers
        return Labels(
            image,
            np.frombuffer(mask, np.uint8).reshape(shape),
            anatomy,
            metal,
            bone_m,
            tunnel_m,
            tool_depth_m,
            bone_depth_m,
            places[:, :3],
            places[:, 3].astype(np.uint8),
            marker_names,
            centres[:, :3],
            centres[:, 3:],
        )

    @property
    def keypoint_names(self) -> list[str]:
        """`base`, `joint_1`, …, `burr`."""
        return ["base", *(f"joint_{number}" for number in range(1, len(self.visibility) - 1)), "burr"]

    def where(self, classes: Mask) -> npt.NDArray[np.bool_]:
        """Returns the pixels that have at least one of these classes."""
        return np.asarray(self.mask & int(classes) != 0)

    def __repr__(self) -> str:
        rows, columns = self.mask.shape
        keypoints = f"[{len(self.visibility)} x 3]"
        return f"Labels(image={self.image!r}, mask=[{rows} x {columns}], keypoints={keypoints})"
