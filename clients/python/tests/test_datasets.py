"""Data sets of `trabecula log export --dataset`, as pycocotools, OpenCV and NumPy read them.

With `PICTURE=FILE` in the environment, a picture of a frame with its labels is written there.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import support
from scenes import drill

cv2, coco_file, coco_judge = support.needs("cv2", "pycocotools.coco", "pycocotools.cocoeval")

CLASSES = {"bone": 1, "tool": 2, "burr": 4, "tunnel": 8, "object": 16}


def points_of(log: Path) -> dict[int, Any]:
    """Returns base, joints and burr in the world frame by tick, from the log's states."""
    fields = ("tick", "joint_count", "t_world_base", "t_world_link", "t_world_burr")
    found = {}
    for state in support.messages(log, "/state", *fields):
        links = [link["position_m"] for link in state["t_world_link"][: state["joint_count"]]]
        ends = (state["t_world_base"]["position_m"], state["t_world_burr"]["position_m"])
        found[state["tick"]] = np.array([ends[0], *links, ends[1]])
    return found


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns a folder with a recorded run of the block in `run`, and its data sets in folders named after
    their formats.
    """
    folder = tmp_path_factory.mktemp("datasets")
    (folder / "scene.toml").write_text(drill(0.6))
    support.recorded(folder / "scene.toml", folder / "out").rename(folder / "run")
    for name in ("coco", "yolo", "yolo-segment", "npz"):
        support.trabecula("log", "export", folder / "run", "-o", folder / name, "--dataset", name)
    return folder


def arrays(folder: Path) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Returns the npz data set: each frame with its entry; NumPy reads it without pickles."""
    about = json.loads((folder / "dataset.json").read_text())
    assert (
        about["classes"] == CLASSES and about["keypoints"][0] == "base" and about["keypoints"][-1] == "burr"
    )
    frames = []
    for entry in about["frames"]:
        with np.load(folder / entry["file"], allow_pickle=False) as opened:
            frames.append((entry, dict(opened)))
    assert len(frames) == len(list(folder.glob("*.npz"))) > 3
    return frames


def test_keypoints_are_where_opencv_projects_them(folder: Path) -> None:
    """Keypoints are where OpenCV projects the states' points, with the camera of the data set."""
    points = points_of(folder / "run")
    visible = 0
    for entry, frame in arrays(folder / "npz"):
        world = points[int(frame["tick"])]
        rotation, _ = cv2.Rodrigues(frame["rotation"])
        seen, _ = cv2.projectPoints(world, rotation, frame["translation_m"], frame["intrinsics"], None)
        assert np.abs(seen.reshape(-1, 2) - frame["keypoints"][:, :2]).max() < 1e-6
        rows, columns = frame["image"].shape
        x, y = frame["keypoints"][:, 0], frame["keypoints"][:, 1]
        inside = (x >= -0.5) & (x < columns - 0.5) & (y >= -0.5) & (y < rows - 0.5)
        assert np.array_equal(inside, frame["visibility"] > 0)
        visible += int(inside.sum())
        assert np.allclose(world[-1], frame["burr_position_m"]) and np.allclose(
            entry["t_world_burr"]["position_m"], world[-1]
        )
        assert (
            frame["image"].dtype == np.uint16
            and frame["mask"].dtype == np.uint8
            and frame["tick"].shape == ()
        )
    assert visible > 20, visible


def test_pycocotools_finds_the_arrays_masks_and_boxes(folder: Path) -> None:
    """pycocotools loads the data set, its masks and boxes equal those of the arrays, and it scores perfectly
    against itself.
    """
    with contextlib.redirect_stdout(io.StringIO()):
        data = coco_file.COCO(str(folder / "coco/annotations.json"))
    frames = {entry["file"][:-4]: frame for entry, frame in arrays(folder / "npz")}
    assert len(data.imgs) == len(frames)
    for image in data.loadImgs(data.getImgIds()):
        frame = frames[image["file_name"][:-4]]
        pixels = cv2.imread(str(folder / "coco/images" / image["file_name"]), cv2.IMREAD_UNCHANGED)
        assert np.array_equal(pixels, frame["image"]) and (image["height"], image["width"]) == pixels.shape
        assert np.allclose(image["camera"]["intrinsics"], frame["intrinsics"])
        for name, bit in CLASSES.items():
            wanted = frame["mask"] & bit != 0
            (category,) = data.loadCats(data.getCatIds([name]))
            found = data.loadAnns(data.getAnnIds(image["id"], [category["id"]]))
            assert len(found) == int(wanted.any())
            for annotation in found:
                assert np.array_equal(data.annToMask(annotation) != 0, wanted), name
                left, top, width, height = annotation["bbox"]
                (ys, xs), area = np.nonzero(wanted), annotation["area"]
                assert (left, top, left + width, top + height) == (
                    xs.min(),
                    ys.min(),
                    xs.max() + 1,
                    ys.max() + 1,
                )
                assert area == wanted.sum()
                if name == "tool":
                    points = np.array(annotation["keypoints"]).reshape(-1, 3)
                    seen = frame["visibility"] > 0
                    assert (
                        np.array_equal(points[:, 2], frame["visibility"])
                        and annotation["num_keypoints"] == seen.sum()
                    )
                    assert (
                        np.allclose(points[seen, :2], frame["keypoints"][seen, :2])
                        and not points[~seen].any()
                    )
                    assert len(category["skeleton"]) == len(points) - 1 and len(category["keypoints"]) == len(
                        points
                    )
    with contextlib.redirect_stdout(io.StringIO()):
        same = data.loadRes([{**annotation, "score": 1.0} for annotation in data.anns.values()])
        judge = coco_judge.COCOeval(data, same, "segm")
        judge.evaluate()
        judge.accumulate()
        judge.summarize()
    assert judge.stats[0] > 0.999, judge.stats


def test_yolo_lines_follow_the_rules_of_a_pose_data_set(folder: Path) -> None:
    """The data set follows Ultralytics' pose format: five numbers and the keypoints per line, as fractions of
    the image.
    """
    lines = [
        line for line in (folder / "yolo/data.yaml").read_text().splitlines() if not line.startswith("#")
    ]
    about = dict(line.split(": ", 1) for line in lines if ": " in line)
    count = json.loads(about["kpt_shape"])[0]
    assert [about[f"  {number}"] for number in range(len(CLASSES))] == list(CLASSES) and about["train"] == about[
        "val"
    ] == "images"
    assert json.loads(about["flip_idx"]) == list(range(count))
    for entry, frame in arrays(folder / "npz"):
        name = entry["file"][:-4]
        pixels = cv2.imread(str(folder / f"yolo/images/{name}.png"), cv2.IMREAD_UNCHANGED)
        assert pixels.dtype == np.uint8 and np.abs(pixels * 257.0 - frame["image"]).max() <= 128.5
        rows, columns = pixels.shape
        table = np.loadtxt(folder / f"yolo/labels/{name}.txt", ndmin=2)
        assert table.shape[1] == 5 + 3 * count and np.all(table[:, 1:5] <= 1.0) and np.all(table >= 0.0)
        assert sorted(table[:, 0]) == [
            n for n, bit in enumerate(CLASSES.values()) if (frame["mask"] & bit).any()
        ]
        for line in table:
            wanted = frame["mask"] & list(CLASSES.values())[int(line[0])] != 0
            ys, xs = np.nonzero(wanted)
            box = np.array([xs.min(), ys.min(), xs.max() + 1, ys.max() + 1]) / [columns, rows, columns, rows]
            middle, size = line[1:3], line[3:5]
            assert np.allclose(np.concatenate([middle - size / 2, middle + size / 2]), box, atol=2e-6)
            points = line[5:].reshape(-1, 3)
            if int(line[0]) == 1:
                seen = frame["visibility"] > 0
                assert np.array_equal(points[:, 2], frame["visibility"])
                assert np.allclose(
                    points[seen, :2] * [columns, rows] - 0.5, frame["keypoints"][seen, :2], atol=1e-3
                )
            else:
                assert not points.any()


def test_polygons_filled_as_ultralytics_does_are_the_masks(folder: Path) -> None:
    """Polygons filled like `ultralytics.data.utils.polygon2mask` equal the masks; a line with more than six
    columns is a polygon there.
    """
    about = (folder / "yolo-segment/data.yaml").read_text()
    assert "kpt_shape" not in about and "train: images\nval: images\n" in about
    parts, most = 0, 0
    for entry, frame in arrays(folder / "npz"):
        rows, columns = frame["image"].shape
        found = {bit: np.zeros((rows, columns), np.uint8) for bit in CLASSES.values()}
        for line in (folder / f"yolo-segment/labels/{entry['file'][:-4]}.txt").read_text().splitlines():
            number, *numbers = line.split()
            assert len(numbers) >= 6 and len(numbers) % 2 == 0, line
            corners = np.array(numbers, np.float32).reshape(-1, 2)
            assert corners.min() >= 0.0 and corners.max() <= 1.0
            polygon = (corners * np.array([columns, rows], np.float32)).astype(np.int32)
            cv2.fillPoly(one := np.zeros((rows, columns), np.uint8), polygon[None], 1)
            bit = list(CLASSES.values())[int(number)]
            # Parts of a class do not touch.
            assert one.any() and not (found[bit] & one).any()
            found[bit] |= one
            parts, most = parts + 1, max(most, len(corners))
        for name, bit in CLASSES.items():
            assert np.array_equal(found[bit] != 0, frame["mask"] & bit != 0), (name, entry["file"])
    assert parts > 8 and most > 12, (parts, most)


def test_a_picture_of_the_labels_is_drawn(folder: Path) -> None:
    """Writes a frame with the outlines of its masks and its keypoints, next to the attenuation of the
    metal.
    """
    _, frame = arrays(folder / "npz")[-1]
    scale = 6 if frame["image"].shape[0] < 200 else 2
    grow = {"fx": scale, "fy": scale, "interpolation": cv2.INTER_NEAREST}
    grey = cv2.resize((frame["image"] // 257).astype(np.uint8), None, **grow)
    shown = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    colours = {
        "bone": (178, 114, 0),
        "tool": (0, 159, 230),
        "burr": (0, 94, 213),
        "tunnel": (115, 158, 0),
        "object": (167, 121, 204),
    }
    for name, bit in CLASSES.items():
        mask = cv2.resize((frame["mask"] & bit != 0).astype(np.uint8), None, **grow)
        edges, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(shown, edges, -1, colours[name], 2)
    for (x, y, _), seen in zip(frame["keypoints"], frame["visibility"]):
        if seen > 0:
            at = (round((x + 0.5) * scale), round((y + 0.5) * scale))
            cv2.circle(shown, at, 4, (255, 255, 255) if seen == 2 else (120, 120, 120), -1)
            cv2.circle(shown, at, 4, (0, 0, 0), 1)
    metal = cv2.resize(
        (255 * frame["metal"] / max(frame["metal"].max(), 1e-9)).astype(np.uint8), None, **grow
    )
    file = Path(os.environ.get("PICTURE", folder / "labels.png"))
    assert cv2.imwrite(str(file), np.hstack([shown, cv2.cvtColor(metal, cv2.COLOR_GRAY2BGR)]))
