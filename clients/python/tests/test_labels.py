"""Labels of X-rays against Siddon's method and the tool's geometry in NumPy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trabecula
from scenes import EXTERNAL, pushing, written
from trabecula.sim import Mask, Sim

#: Radii of the standard tool.
BURR_M, OUTER_M, INNER_M, CABLE_M = 3.25e-3, 3.0e-3, 2.0e-3, 1.0e-3
#: Distance from an edge of the tool within which a ray counts as ambiguous.
DOUBT_M = 2e-5


def siddon(start: Any, end: Any, shape: tuple[int, ...]) -> tuple[Any, Any, Any]:
    """Returns parameters and voxels i, j, k of the segments of a ray in voxel coordinates: all crossings with
    planes, sorted.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        planes = [
            (np.arange(n + 1) - 0.5 - start[axis]) / (end - start)[axis] for axis, n in enumerate(shape)
        ]
    cuts = np.concatenate([*planes, [0.0, 1.0]])
    cuts = np.unique(cuts[(cuts >= 0.0) & (cuts <= 1.0)])
    middles = start + 0.5 * (cuts[:-1] + cuts[1:])[:, None] * (end - start)
    voxels = np.floor(middles + 0.5).astype(int)
    inside = np.all((voxels >= 0) & (voxels < np.array(shape)), axis=1)
    return cuts[:-1][inside], np.diff(cuts)[inside], voxels[inside]


def in_tube(source: Any, ray: Any, nodes: Any) -> Any:
    """Whether a ray crosses a wall or the cable of the tubes from node to node, tested at points on it; None
    if it only grazes one.
    """
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


def test_labels_agree_with_siddon_and_the_tools_geometry_in_numpy(tmp_path: Path) -> None:
    sim = Sim(written(tmp_path, "scene.toml", EXTERNAL), drive=True)
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
    nodes = np.array(
        [state.t_world_base.position_m, *state.array["t_world_link"]["position_m"][: state.joint_count]]
    )
    nodes = np.vstack([nodes, state.t_world_burr.position_m])
    worst, unsure = 0.0, 0
    for row in range(rows):
        for column in range(columns):
            pixel = (
                corner
                + column * geometry.pixel_pitch_m[0] * geometry.row_axis
                + row * geometry.pixel_pitch_m[1] * geometry.column_axis
            )
            at, parts, voxels = siddon(ct.world_to_voxel(source), ct.world_to_voxel(pixel), hu.shape[::-1])
            length, (i, j, k) = float(np.linalg.norm(pixel - source)), voxels.T
            drilled = gone[k, j, i]
            bone = (hu[k, j, i] >= 150) & ~drilled
            here = (row, column)
            bone_m, tunnel_m = length * parts[bone].sum(), length * parts[drilled].sum()
            worst = max(worst, abs(bone_m - found.bone_m[here]), abs(tunnel_m - found.tunnel_m[here]))
            for expected, got, bit in (
                (bone_m, found.bone_m, Mask.BONE),
                (tunnel_m, found.tunnel_m, Mask.TUNNEL),
            ):
                # A ray that grazes a voxel's edge has a segment as short as rounding.
                assert expected < 1e-9 or found.where(bit)[here], (here, bit)
                assert found.where(bit)[here] == (got[here] > 0.0), (here, bit)
            if bone_m > 1e-6:
                assert abs(reach * at[bone & (length * parts > 1e-9)][0] - found.bone_depth_m[here]) < 1e-6, (
                    here
                )
            ray = (pixel - source) / length
            miss = np.linalg.norm(np.cross(nodes[-1] - source, ray))
            assert found.where(Mask.BURR)[here] == (miss < BURR_M), (here, miss)
            metal = in_tube(source, ray, nodes)
            unsure += metal is None
            assert metal is None or found.where(Mask.TOOL)[here] == metal, (here, metal)
    assert worst < 1e-7, worst
    assert unsure < 0.02 * rows * columns, unsure
    pixels_of = {each: int(found.where(each).sum()) for each in Mask}
    assert pixels_of.pop(Mask.OBJECT) == 0 and min(pixels_of.values()) > 10, pixels_of
    seen = (
        np.array(nodes) @ found.image.frame.projection.rotation.reshape(3, 3).T
        + found.image.frame.projection.translation_m
    )
    in_image = seen @ found.image.frame.projection.intrinsics.reshape(3, 3).T
    assert np.allclose(found.keypoints[:, :2], in_image[:, :2] / in_image[:, 2:], atol=1e-9)
    assert np.allclose(found.keypoints[:, 2], seen[:, 2], atol=1e-12)
    # The tool's entry point is in front of its metal; with the lowest threshold everything is bone.
    assert np.array_equal(np.isfinite(found.tool_depth_m), found.where(Mask.TOOL | Mask.BURR))
    everything = sim.labels(bone_from_hu=-1000)
    assert (
        everything.bone_m.sum() > found.bone_m.sum()
        and not sim.labels(bone_from_hu=32767).where(Mask.BONE).any()
    )
    assert not np.array_equal(sim.labels((40.0, 10.0)).mask, found.mask)
    with pytest.raises(trabecula.ArgumentError, match="`bone_from_hu` is 40000"):
        sim.labels(bone_from_hu=40000)
    with pytest.raises(trabecula.ArgumentError, match="expected a CArmGeometry"):
        sim.labels("ap")  # type: ignore[arg-type]


def test_markers_are_the_projections_of_their_centres() -> None:
    """The example's beads, by the camera of the frame, from two sides."""
    sim = Sim(Path(__file__).parents[3] / "configs/examples/drr_objects.toml")
    for pose in (None, (25.0, -10.0)):
        found = sim.labels(pose)
        camera = found.image.frame.projection
        assert found.marker_names == [f"bead_{number}" for number in range(1, 7)]
        seen = found.marker_positions_m @ camera.rotation.reshape(3, 3).T + camera.translation_m
        in_image = seen @ camera.intrinsics.reshape(3, 3).T
        assert np.allclose(found.markers[:, :2], in_image[:, :2] / in_image[:, 2:], atol=1e-9)
        columns, rows = np.rint(found.markers[:, :2]).astype(int).T
        is_inside = (columns >= 0) & (columns < 256) & (rows >= 0) & (rows < 256)
        assert is_inside.sum() >= 5 and found.where(Mask.OBJECT)[rows[is_inside], columns[is_inside]].all()
