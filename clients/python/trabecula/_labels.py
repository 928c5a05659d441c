"""What an X-ray frame shows."""

from __future__ import annotations

from enum import IntFlag
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ._results import Image

__all__ = ["Labels", "Mask"]


class Mask(IntFlag):
    """Bits of `Labels.mask`. A pixel may have several: an X-ray has no foreground."""

    #: The ray crosses bone that is still there.
    BONE = 1
    #: The ray crosses metal of the shaft, the links or the drive cable.
    TOOL = 2
    #: The ray crosses the burr.
    BURR = 4
    #: The ray crosses drilled voxels.
    TUNNEL = 8


class Labels(NamedTuple):
    """An X-ray frame and what it shows. Images have shape (rows, columns), row 0 at the top; they are of the rays to the pixels' centres."""

    #: The frame. Its `frame.projection` is the camera of the keypoints, its `frame.t_world_burr` the burr's pose.
    image: Image
    #: Bits of `Mask`.
    mask: npt.NDArray[np.uint8]
    #: Attenuation (-ln of the transmission) of the anatomy without what the tool displaces.
    anatomy: npt.NDArray[np.float32]
    #: Attenuation that the tool's metal adds.
    metal: npt.NDArray[np.float32]
    #: Length of the ray in bone, m. The tool takes none of it away.
    bone_m: npt.NDArray[np.float32]
    #: Length of the ray in drilled voxels, m.
    tunnel_m: npt.NDArray[np.float32]
    #: Depth at which the ray first enters the tool or the burr, m from the source along the detector's normal; NaN without metal.
    tool_depth_m: npt.NDArray[np.float32]
    #: Depth at which the ray first enters bone, m; NaN without bone.
    bone_depth_m: npt.NDArray[np.float32]
    #: Column, row (pixel centres at whole numbers) and depth, m, of base, joints from base to tip, and burr: shape (joints + 2, 3). NaN for
    #: a point level with or behind the source.
    keypoints: npt.NDArray[np.float64]
    #: 0: outside the image; 1: the ray crosses another part of the tool too; 2: alone. Shape (joints + 2,).
    visibility: npt.NDArray[np.uint8]

    @staticmethod
    def of(image: Image, mask: bytes, images: bytes, points: bytes) -> Labels:
        """The labels of their bytes."""
        shape = image.pixels.shape
        places = np.frombuffer(points, "<f8").reshape(-1, 4)
        anatomy, metal, bone_m, tunnel_m, tool_depth_m, bone_depth_m = np.frombuffer(images, "<f4").reshape(6, *shape)
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
        )

    @property
    def keypoint_names(self) -> list[str]:
        """`base`, `joint_1` and so on, `burr`."""
        return ["base", *(f"joint_{number}" for number in range(1, len(self.visibility) - 1)), "burr"]

    def where(self, classes: Mask) -> npt.NDArray[np.bool_]:
        """Pixels of one of these classes."""
        return np.asarray(self.mask & int(classes) != 0)

    def __repr__(self) -> str:
        rows, columns = self.mask.shape
        return f"Labels(image={self.image!r}, mask=[{rows} x {columns}], keypoints=[{len(self.visibility)} x 3])"
