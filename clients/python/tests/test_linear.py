"""State vectors and linear models of `trabecula.sim`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trabecula
from scenes import EXTERNAL, written
from trabecula.sim import Batch, Sim


def pull(tension_n: float) -> trabecula.Command:
    command = trabecula.Command()
    command.tendon_mode = trabecula.TendonMode.SERVO_JF
    command.tendon_force_n[:2] = tension_n, 1.0
    return command


def test_a_vector_goes_out_and_comes_back(tmp_path: Path) -> None:
    sim = Sim(written(tmp_path, "scene.toml", EXTERNAL), drive=True)
    sim.step(pull(3.0), ticks=30)
    here = sim.snapshot()
    assert here.vector.shape == (len(sim.state_names),) == (len(sim.state_units),)
    assert sim.state_names[:4] == ["mount.x", "mount.y", "mount.z", "flexure_0.bend"]
    assert not here.vector.flags.writeable
    before = sim.hash
    sim.restore_vector(here, here.vector)
    assert sim.hash == before
    bent = here.vector.copy()
    bent[3] += 0.01
    sim.restore_vector(here, bent)
    assert sim.state.joint_position_rad[0] == bent[3]
    assert np.array_equal(sim.snapshot().vector, bent)
    for wrong, part in [(bent[1:], "entries, expected"), (np.full_like(bent, np.nan), "NaN"), ([[1.0]], "shape")]:
        with pytest.raises(trabecula.ArgumentError, match=part):
            sim.restore_vector(here, wrong)
    assert np.array_equal(sim.snapshot().vector, bent)


def test_a_model_predicts_the_next_tick(tmp_path: Path) -> None:
    sim = Sim(written(tmp_path, "scene.toml", EXTERNAL), drive=True)
    sim.step(pull(3.0), ticks=30)
    before = sim.hash
    outputs = ["t_world_burr.position_m", "bend_rad"]
    model = sim.linearize(pull(3.0), inputs="tendon_force_n[0]", outputs=outputs)
    assert sim.hash == before
    n = len(model.state_names)
    assert model.A.shape == (n, n) and model.B.shape == (n, 1) and model.C.shape == (4, n)
    assert model.D.shape == (4, 1) and not model.D.any() and model.input == [3.0]
    assert model.output_names[3] == "bend_rad" and model.output_units == ["m", "m", "m", "rad"]
    assert model.input_units == ["N"] and np.array_equal(model.state, sim.snapshot().vector)
    here, moved = sim.snapshot(), model.state.copy()
    place = model.state_names.index("flexure_5.bend.rate")
    moved[place] += 1e-3
    sim.restore_vector(here, moved)
    sim.step(pull(3.01))
    change = sim.snapshot().vector - model.next_state
    expected = model.A[:, place] * 1e-3 + model.B[:, 0] * 0.01
    # The solver stops at 1e-6 m/s; the tool's curvature is far below.
    assert np.abs(change - expected).max() < 1e-3 * np.abs(expected).max()
    bend = model.select("flexure_*", "mount.*")
    assert bend.A.shape == (60, 60) and bend.C.shape == (4, 60) and bend.state_names[0] == "mount.x"
    with pytest.raises(trabecula.ArgumentError, match="no state matches 'link"):
        model.select("link*")
    with pytest.raises(trabecula.ArgumentError, match="input `tension`"):
        sim.linearize(pull(3.0), inputs="tension")


def test_a_batch_gives_a_model_for_each(tmp_path: Path) -> None:
    scene = written(tmp_path, "scene.toml", EXTERNAL)
    batch = Batch(scene, n=2, drive=True)
    commands = batch.commands()
    commands["tendon_mode"] = 1
    commands["tendon_force_n"][1, 0, 0] = 4.0
    batch.step(commands, ticks=20)
    models = batch.linearize(commands, inputs="tendon_force_n", outputs="bend_rad")
    alone = Sim(scene, drive=True)
    command = trabecula.Command()
    command.tendon_mode = trabecula.TendonMode.SERVO_JF
    command.tendon_force_n[0] = 4.0
    alone.step(command, ticks=20)
    expected = alone.linearize(command, inputs="tendon_force_n", outputs="bend_rad")
    assert np.array_equal(models[1].A, expected.A) and np.array_equal(models[1].B, expected.B)
    assert not np.array_equal(models[0].A, expected.A)
