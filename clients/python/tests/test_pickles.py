"""Pickled simulations continue in another process with the same hashes."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trabecula
from scenes import EXTERNAL, GUIDED, pushing, written
from support import LIMIT_S
from trabecula.sim import Sim, Snapshot

#: Prints where a pickled simulation is, continues it to tick 1000, and prints tick, hash and drilled voxels.
CONTINUES = """
import pickle, sys
from scenes import pushing
sim = pickle.load(sys.stdin.buffer)
print(sim.tick, sim.hash)
while sim.tick < 1000:
    sim.step(pushing(sim.tick) if sim.driven else None)
print(sim.tick, sim.hash, sim.drilled().tolist())
"""


def in_another_process(pickled: bytes) -> str:
    words = [sys.executable, "-c", f"import sys; sys.path[:0] = {sys.path!r}\n{CONTINUES}"]
    done = subprocess.run(words, input=pickled, capture_output=True, timeout=LIMIT_S)
    assert done.returncode == 0, done.stderr.decode()
    return done.stdout.decode().strip()


def continued(sim: Sim) -> str:
    while sim.tick < 1000:
        sim.step(pushing(sim.tick) if sim.driven else None)
    return f"{sim.tick} {sim.hash} {sim.drilled().tolist()}"


@pytest.mark.parametrize("controller", [EXTERNAL, GUIDED])
def test_a_pickle_taken_while_drilling_continues_in_another_process(tmp_path: Path, controller: str) -> None:
    scene = written(tmp_path, "scene.toml", controller)
    changed = {"contact.friction": 0.25, "tool.burr_start_mm": [0.0, 0.0, -31.0]}
    sim = Sim(scene, overrides=changed, seed=3)
    while sim.tick < 700:
        sim.step(pushing(sim.tick) if sim.driven else None)
    assert len(sim.drilled()) > 0
    pickled = pickle.dumps(sim)
    snapshot = pickle.loads(pickle.dumps(sim.snapshot()))
    copies = [copy.copy(sim), copy.deepcopy({"sim": sim})["sim"]]
    scene.unlink()
    here = f"{sim.tick} {sim.hash}"
    expected = continued(sim)
    assert in_another_process(pickled) == f"{here}\n{expected}"
    assert [continued(one) for one in copies] == [expected] * 2
    assert pickle.loads(pickled).scene_toml == sim.scene_toml
    assert isinstance(snapshot, Snapshot) and snapshot.state.tick == 700
    sim.restore(copy.deepcopy(snapshot))
    assert np.array_equal(sim.snapshot().vector, snapshot.vector)
    assert continued(sim) == expected


def test_a_pickle_of_something_else_is_an_argument_error(tmp_path: Path) -> None:
    sim = Sim(written(tmp_path, "scene.toml", EXTERNAL))
    for taken in (sim, sim.snapshot()):
        rebuild, arguments = taken.__reduce__()
        packed = arguments[-1]
        changed = packed[:-1] + bytes([packed[-1] ^ 1])
        for other in (b"", packed[:100], changed, "text", 5, None):
            with pytest.raises(trabecula.ArgumentError, match="damaged|expected bytes"):
                rebuild(*arguments[:-1], other)
    with pytest.raises(trabecula.ArgumentError, match="expected a Sim"):
        rebuild, (_, packed) = sim.__reduce__()
        rebuild(dict, packed)
