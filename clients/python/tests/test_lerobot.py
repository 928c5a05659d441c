"""`trabecula log export --dataset lerobot`, as pyarrow and pandas read it; and as LeRobot itself does where it is
installed.
"""

from __future__ import annotations

import hashlib
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import support
from scenes import drill

pandas, _, image = support.needs("pandas", "pyarrow", "PIL.Image")

#: Frames per second of the recorded scene.
RATE = 10
DURATION_S = 0.6
#: Where the burr should end, patient frame.
TARGET_MM = (2.0, 0.0, -20.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns a folder with a recorded run of the block in `run`, and a data set of it, twice, in `set`."""
    folder = tmp_path_factory.mktemp("lerobot")
    (folder / "scene.toml").write_text(f"{drill(DURATION_S)}target_mm = {list(TARGET_MM)}\n")
    support.recorded(folder / "scene.toml", folder / "out").rename(folder / "run")
    export(folder, "set", "run", "run")
    return folder


def export(folder: Path, name: str, *logs: str) -> None:
    flags = ("--dataset", "lerobot", "--task", "Drill the block.", "--observation", "t_world_burr.position_m")
    flags += ("--observation", "bend_rad", "--action", "tendon_force_n", "--action", "burr_speed_rad_per_s")
    support.trabecula("log", "export", *(folder / log for log in logs), "-o", folder / name, *flags)


def rows(folder: Path) -> Any:
    files = sorted((folder / "data").glob("*/*.parquet"))
    return pandas.concat([pandas.read_parquet(file) for file in files], ignore_index=True)


def test_rows_hold_what_the_log_holds(folder: Path) -> None:
    info = json.loads((folder / "set" / "meta" / "info.json").read_text())
    assert info["codebase_version"] == "v3.0" and info["fps"] == RATE
    table = rows(folder / "set")
    count = info["total_frames"] // 2
    assert info["total_episodes"] == 2 and len(table) == 2 * count and count == int(DURATION_S * RATE)
    assert set(table.columns) == set(info["features"])
    states = {s["tick"]: s for s in support.messages(folder / "run", "/state", "tick", "t_world_burr", "bend_rad")}
    latched = {u["tick"]: u for u in support.messages(folder / "run", "/latched", "tick", "commands")}
    for number, row in table.iterrows():
        tick = (number % count) * 1000 // RATE
        state, command = states[tick], latched[tick]["commands"][0]["command"]
        seen = [*state["t_world_burr"]["position_m"], state["bend_rad"]]
        assert np.array_equal(row["observation.state"], np.float32(seen))
        given = [*command["tendon_force_n"], command["burr_speed_rad_per_s"]]
        assert np.array_equal(row["action"], np.float32(given))
        assert row["timestamp"] == np.float32((number % count) / RATE) and row["index"] == number
        assert row["next.done"] == (number % count == count - 1)
    burr_m = [np.asarray(states[tick]["t_world_burr"]["position_m"]) for tick in (0, max(states))]
    first_mm, last_mm = (np.linalg.norm(place * 1e3 - TARGET_MM) for place in burr_m)
    np.testing.assert_allclose(table["next.reward"][:count].sum(), first_mm - last_mm, atol=1e-5)
    assert not table["next.success"].any() and last_mm > 2.0
    assert list(table["episode_index"]) == [0] * count + [1] * count


def test_pictures_are_the_recorded_frames(folder: Path) -> None:
    support.trabecula("log", "export", folder / "run", "-o", folder / "frames", "--frames")
    frames = [np.asarray(image.open(file)) for file in sorted((folder / "frames").glob("*.png"))]
    table = rows(folder / "set")
    for number, frame in enumerate(frames[: len(table) // 2]):
        cell = table["observation.images.xray"][number]
        assert cell["path"] is None
        picture = np.asarray(image.open(io.BytesIO(cell["bytes"])))
        assert np.array_equal(picture, np.repeat(np.round(frame / 257.0)[:, :, None], 3, axis=2))
    shape = json.loads((folder / "set" / "meta" / "info.json").read_text())["features"]["observation.images.xray"]
    assert tuple(shape["shape"]) == picture.shape and shape["dtype"] == "image"


def test_statistics_and_episodes_describe_the_rows(folder: Path) -> None:
    table = rows(folder / "set")
    statistics = json.loads((folder / "set" / "meta" / "stats.json").read_text())
    for name in ("observation.state", "action", "timestamp", "next.done"):
        values = np.stack(table[name].to_numpy()).astype(np.float64)
        for key, expected in (("min", values.min(0)), ("max", values.max(0)), ("mean", values.mean(0))):
            np.testing.assert_allclose(statistics[name][key], np.atleast_1d(expected), rtol=1e-6, atol=1e-12)
        np.testing.assert_allclose(statistics[name]["std"], np.atleast_1d(values.std(0)), rtol=1e-5, atol=1e-9)
        assert statistics[name]["count"] == [len(table)]
    episodes = pandas.read_parquet(folder / "set" / "meta" / "episodes" / "chunk-000" / "file-000.parquet")
    count = len(table) // 2
    assert list(episodes["length"]) == [count, count]
    assert list(episodes["dataset_from_index"]) == [0, count]
    assert [list(tasks) for tasks in episodes["tasks"]] == [["Drill the block."]] * 2
    first = np.stack(table["action"].to_numpy()[:count]).astype(np.float64)
    np.testing.assert_allclose(episodes["stats/action/q10"][0], np.quantile(first, 0.1, axis=0), rtol=1e-6, atol=1e-9)
    tasks = pandas.read_parquet(folder / "set" / "meta" / "tasks.parquet")
    assert list(tasks.index) == ["Drill the block."] and list(tasks["task_index"]) == [0]


def test_the_same_logs_give_the_same_bytes(folder: Path) -> None:
    export(folder, "again", "run", "run")

    def digests(of: Path) -> dict[str, str]:
        files = sorted(file for file in of.rglob("*") if file.is_file())
        return {str(file.relative_to(of)): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}

    assert digests(folder / "again") == digests(folder / "set") and len(digests(folder / "set")) == 6


def test_lerobot_reads_the_set(folder: Path) -> None:
    datasets = pytest.importorskip("lerobot.datasets.lerobot_dataset", reason="lerobot is not installed")
    found = datasets.LeRobotDataset("local/set", root=folder / "set")
    table = rows(folder / "set")
    assert len(found) == len(table) and found.num_episodes == 2
    for number in range(len(found)):
        item = found[number]
        assert np.array_equal(item["observation.state"], table["observation.state"][number])
        assert np.array_equal(item["action"], table["action"][number])
        assert item["task"] == "Drill the block."
        picture = np.asarray(image.open(io.BytesIO(table["observation.images.xray"][number]["bytes"])))
        assert np.allclose(item["observation.images.xray"].permute(1, 2, 0).numpy() * 255.0, picture, atol=1e-4)
