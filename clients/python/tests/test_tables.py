"""Tables of `trabecula log export`, opened by pandas, Polars and fastparquet."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import support
from scenes import drill

pandas, polars, fastparquet, _ = support.needs("pandas", "polars", "fastparquet", "pyarrow")


def exported(log: Path, topic: str, table: Path) -> bool:
    """Writes a table, unless no message of the topic was recorded."""
    line = [os.environ["TRABECULA_PROGRAM"], "log", "export", str(log), "-o", str(table), "--topic", topic]
    done = subprocess.run(line, capture_output=True, text=True, timeout=support.LIMIT_S, check=False)
    assert done.returncode == 0 or "no topic" in done.stderr, f"{topic}: {done.stderr}"
    return done.returncode == 0


def test_pandas_polars_and_fastparquet_open_the_default_export_of_every_topic(tmp_path: Path) -> None:
    """Regression: two columns were named `tick`, and all three refused the table."""
    (tmp_path / "scene.toml").write_text(drill(0.4))
    folder = support.recorded(tmp_path / "scene.toml", tmp_path / "out")
    count = 0
    for lane in ("run.mcap", "timing.mcap"):
        lines = support.trabecula("log", "cat", folder / lane).splitlines()
        topics = sorted({json.loads(line)["topic"] for line in lines})
        for topic in topics:
            table = tmp_path / f"{topic.replace('/', '_')}.parquet"
            text = table.with_suffix(".csv")
            if not (exported(folder / lane, topic, table) and exported(folder / lane, topic, text)):
                continue
            count += 1
            a, b = pandas.read_parquet(table, engine="pyarrow"), polars.read_parquet(table)
            c, d = fastparquet.ParquetFile(str(table)).to_pandas(), pandas.read_csv(text)
            assert list(a.columns) == b.columns == list(c.columns) == list(d.columns), table
            assert len(a) == len(b) == len(c) == len(d), table
            if len(a):
                times = a["log_time_ns"].tolist()
                assert times == c["log_time_ns"].tolist() == b["log_time_ns"].to_list()
    assert count >= 7, count
    states = pandas.read_parquet(tmp_path / "_state.parquet")
    assert states["tick"].tolist() == list(range(401)) and states["t_world_tip.position_m[2]"].notna().all()
