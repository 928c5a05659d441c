"""Features of the package beyond the plain messages, and its refusals."""

from __future__ import annotations

import os
import pickle
import re
import time
from pathlib import Path
from typing import Any, Callable

import numpy as np
import pytest
import support
import trabecula as t
from scenes import imaged, shared
from support import LIMIT_S, SCENES, Run


def refusal(kind: type[t.Error], call: Callable[[], Any]) -> str:
    """Returns the text of the error that a call must raise."""
    try:
        call()
    except t.Error as error:
        assert type(error) is kind, repr(error)
        return str(error)
    raise AssertionError("not refused")


def wrong_values() -> None:
    """Every wrong type, shape or index raises one of the package's own errors with a clear text."""
    client = t.Client()
    state = client.wait_state(LIMIT_S)
    argument, read_only = t.ArgumentError, t.ReadOnlyError
    command = client.loan_command()
    for call, words in [
        (
            lambda: setattr(command, "tendon_force_n", 5.0),
            "`tendon_force_n` of this Command is 5.0, expected 4 numbers",
        ),
        (lambda: setattr(command, "tendon_force_n", "much"), "is 'much', expected 4 numbers"),
        (
            lambda: setattr(command, "tendon_mode", "servo"),
            "expected a TendonMode: NONE, SERVO_JF, SERVO_JP, MOVE_JP, SERVO_JV",
        ),
        (lambda: setattr(command, "burr_speed_rad_per_s", None), "is None, expected a number"),
        (
            lambda: setattr(command, "state_tick", -1),
            "is -1, expected a whole number, 0 to 18446744073709551615",
        ),
        (lambda: setattr(command, "t_world_base", (0, 0, 0)), "is (0, 0, 0), expected a Pose"),
        (lambda: command.tendon_force_n.__setitem__(0, "x"), "'x' does not fit"),
        (lambda: client.run_control("pause"), "expected a ControlAction: 1 PAUSE"),
        (lambda: client.wait_state("long"), "`timeout_s` is 'long', expected 0 or more seconds"),
        (lambda: client.request_frame(0, (1.0, 2.0)), "`position_m` is (1.0, 2.0), expected 3 numbers"),
        (lambda: client.request_frame(-3), "`tick` is -3, expected a whole number"),
        (lambda: client.remark(7), "`text` is 7, expected a text"),
        (lambda: client.step(0), "`ticks` is 0, expected 1 or more"),
        (lambda: t.Client(7), "`session` is 7, expected a text or None"),
        (lambda: t.rotation_matrix((1.0, 1.0, 0.0, 0.0)), "expected one unit quaternion"),
        (lambda: state.contacts["gap_m"], "`.array['gap_m']`"),
    ]:
        text = refusal(argument, call)
        assert words in text, (words, text)
    for call in [
        lambda: setattr(state, "bend_rad", 1.0),
        lambda: setattr(state, "joint_position_rad", np.zeros(state.joint_count)),
        lambda: setattr(state.t_world_tip, "position_m", np.zeros(3)),
        lambda: setattr(state, "t_world_tip", t.Pose()),
        lambda: state.joint_position_rad.__setitem__(0, 1.0),
        lambda: state.t_world_link[0].position_m.__setitem__(0, 1.0),
        lambda: setattr(state, "contacts", []),
    ]:
        assert "cannot be written" in refusal(read_only, call)
    client.send_command()
    assert "it has been sent" in refusal(read_only, lambda: setattr(command, "tendon_mode", 1))
    client.run_control(t.ControlAction.STOP)
    client.close()
    for call in [
        client.wait_state,
        client.loan_command,
        client.events,
        lambda: client.step(),
        lambda: client.info,
    ]:
        text = refusal(t.Error, call)
        assert "this client is closed" in text, text
    assert repr(client) == "Client(closed)"


def true_lengths_and_names() -> None:
    """Arrays have their used length, elements have attributes like the message, and codes are enum members.
    """
    client = t.Client()
    state = client.wait_state(LIMIT_S)
    assert 0 < state.joint_count < t.MAX_JOINTS
    assert len(state.joint_position_rad) == len(state.t_world_link) == state.joint_count
    assert (
        len(state.tendon_tension_n) == state.tendon_count and len(state.t_world_body) == state.body_count == 0
    )
    assert len(state.applied) == state.controller_count == 0
    assert len(state.array["joint_position_rad"]) == t.MAX_JOINTS
    last = state.t_world_link[-1]
    whole = state.array["t_world_link"][state.joint_count - 1]
    assert np.array_equal(last.position_m, whole["position_m"])
    assert np.array_equal(state.t_world_link.array["position_m"][-1], last.position_m)
    assert [link.position_m[2] for link in state.t_world_link] == list(
        state.t_world_link.array["position_m"][:, 2]
    )
    try:
        state.t_world_link[state.joint_count]
        raise AssertionError("beyond the end")
    except IndexError:
        pass
    stepped = client.step(2, LIMIT_S)
    assert [one.controller_index for one in stepped.applied] == [0, 1] and stepped.applied[
        -1
    ].source is t.CommandSource.NONE
    assert isinstance(stepped.arm_mode, t.ArmMode) and stepped.applied[0].source is t.CommandSource.FRESH
    state = stepped
    assert t.TENDON_SERVO_JF is t.TendonMode.SERVO_JF and t.TendonMode.SERVO_JF == 1
    # Results of computations are ordinary arrays, and survive pickling.
    assert type(state.joint_position_rad * 2.0) is np.ndarray
    assert np.array_equal(
        pickle.loads(pickle.dumps(np.array(state.joint_position_rad))), state.joint_position_rad
    )
    for shown in (
        state,
        state.t_world_tip,
        client.volume(LIMIT_S),
        client,
        client.loan_command(),
        state.contacts,
    ):
        assert len(repr(shown)) < 400 and "\n" not in repr(shown), repr(shown)
    client.run_control(t.ControlAction.STOP)


def steps_and_resets() -> None:
    """`step` ends at the requested tick, running and paused; an event and a count show a reset."""
    client = t.Client()
    observer = t.Client(controller="")
    assert observer.reset_count == client.reset_count == 0
    first = client.wait_state(LIMIT_S).copy()
    command = client.loan_command()
    command.tendon_mode, command.tendon_force_n[0] = t.TendonMode.SERVO_JF, 4.0
    bent = client.step(50, LIMIT_S).copy()
    assert bent.tick == first.tick + 50 and bent.applied[0].sequence == 50
    # The first command stays in effect: those sent by `step` change nothing.
    assert bent.tendon_tension_n[0] > 3.0, bent
    # A command that answers the newest state is not replaced by one of `step`.
    with client.command() as command:
        command.tendon_mode, command.tendon_force_n[0] = t.TendonMode.SERVO_JF, 1.0
    assert client.step(60, LIMIT_S).tick == bent.tick + 60
    assert client.step().tendon_tension_n[0] < 2.0
    # Rates: from the pulled length of that moment on, and held.
    slack = client.step().copy()
    with client.command() as command:
        command.tendon_mode, command.tendon_velocity_m_per_s[:2] = t.TendonMode.SERVO_JV, (2e-3, -1e-3)
    pulled = client.step(40, LIMIT_S)
    moved_m = pulled.tendon_displacement_m - slack.tendon_displacement_m
    assert np.allclose(moved_m, [80e-6, -40e-6], rtol=0.0, atol=1e-12), moved_m
    with client.command() as command:
        command.tendon_mode, command.tendon_force_n[0] = t.TendonMode.SERVO_JF, 1.0
    client.step(27, LIMIT_S)
    client.run_control(t.ControlAction.PAUSE)
    at = client.step(7, LIMIT_S).tick
    assert at == bent.tick + 136
    status = client.status
    assert status is not None and status.phase is t.Phase.PAUSED
    client.run_control(t.ControlAction.RESUME)
    client.run_control(t.ControlAction.RESET)
    after = client.step(1, LIMIT_S)
    assert after.tick == at + 1 and abs(after.bend_rad - first.bend_rad) < 1e-3, (after, first)
    for one in (client, observer):
        deadline = time.monotonic() + LIMIT_S
        while one.reset_count == 0:
            assert time.monotonic() < deadline
        assert one.reset_count == 1
        resets = [event for event in one.events() if event.is_reset()]
        assert (
            len(resets) == 1 and resets[0].severity is t.Severity.INFO and resets[0].code is t.EventCode.RESET
        ), resets
        assert not one.events() and one.reset_count == 1
    client.run_control(t.ControlAction.STOP)


def several_sessions(*folders: str) -> None:
    """With several sessions and none named, connecting fails at once and lists them."""
    # Retrying would never end.
    try:
        t.Client(timeout_s=float("inf"))
    except t.Error as error:
        assert error.status == t.ERROR_SEVERAL_SESSIONS, error
        assert all(folder in str(error) for folder in folders) and "select one" in str(error), error
        return
    raise AssertionError("not refused")


def places() -> None:
    """Poses, pixels and voxels compared with plain NumPy arithmetic, and with the metadata of renderer and
    volume.
    """
    client = t.Client()
    image = client.wait_frame(client.request_frame(), LIMIT_S)
    frame, geometry, camera = image.frame, image.frame.geometry, image.frame.projection
    pose = frame.t_world_burr
    matrix = t.pose_matrix(pose)
    # A quaternion turns v to q v q*, written out with NumPy.
    x, y, z, w = pose.orientation_xyzw
    vector = np.array([0.3, -0.2, 0.9])
    turned = (
        vector
        + 2.0 * w * np.cross([x, y, z], vector)
        + 2.0 * np.cross([x, y, z], np.cross([x, y, z], vector))
    )
    assert np.allclose(matrix @ [*vector, 1.0], [*(turned + pose.position_m), 1.0], rtol=0, atol=1e-15)
    assert np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-15) and np.linalg.det(matrix) > 0
    # The renderer's own camera matrix: s (u, v, 1) = K (R x + t).
    points = np.random.default_rng(1).uniform(-0.02, 0.02, (50, 3)) + pose.position_m
    seen = points @ camera.rotation.reshape(3, 3).T + camera.translation_m
    uv = seen @ camera.intrinsics.reshape(3, 3).T
    pixels = t.world_to_pixel(geometry, points)
    assert np.allclose(pixels, uv[:, :2] / uv[:, 2:], rtol=0, atol=1e-6), np.abs(
        pixels - uv[:, :2] / uv[:, 2:]
    ).max()
    assert t.world_to_pixel(geometry, points[0]).shape == (2,)
    for point, pixel, depth in zip(points, pixels, seen[:, 2]):
        assert np.allclose(t.pixel_to_world(geometry, pixel, float(depth)), point, rtol=0, atol=1e-9)
    assert np.allclose(
        t.pixel_to_world(geometry, [0.5 * (geometry.columns - 1), 0.5 * (geometry.rows - 1)]),
        geometry.detector_centre_m,
    )
    text = refusal(
        t.ArgumentError,
        lambda: t.world_to_pixel(geometry, 2.0 * geometry.source_m - geometry.detector_centre_m),
    )
    assert "not in front of the source" in text
    # Voxels: the two halves of the scene's block have known positions.
    ct = client.volume(LIMIT_S)
    corner = ct.voxel_to_world([0, 0, 0])
    assert np.array_equal(corner, ct.volume.origin_m) and ct.hu_at(corner) == ct.hu[0, 0, 0]
    for index in np.random.default_rng(2).integers(0, ct.volume.dimensions, (50, 3)):
        point = ct.voxel_to_world(index)
        assert np.allclose(ct.world_to_voxel(point), index, atol=1e-9)
        axes = ct.volume.direction.reshape(3, 3)
        by_hand = ct.volume.origin_m + sum(index[a] * ct.volume.spacing_m[a] * axes[a] for a in range(3))
        assert np.allclose(point, by_hand, rtol=0, atol=1e-15)
        assert ct.hu_at(point + 0.4 * ct.volume.spacing_m[0] * axes[0]) == ct.hu[index[2], index[1], index[0]]
        flat = index[0] + ct.volume.dimensions[0] * (index[1] + ct.volume.dimensions[1] * index[2])
        assert ct.hu_at(point) == ct.hu.reshape(-1)[flat]
    # The block is 35 x 35 x 55 mm of bone, 2.5 mm of air around it, about the world's origin.
    assert np.allclose(ct.voxel_to_world([19.5, 19.5, 29.5]), 0.0, rtol=0, atol=1e-12)
    for axis, half_m in enumerate((0.0175, 0.0175, 0.0275)):
        for side in (-1.0, 1.0):
            inside, outside = np.zeros(3), np.zeros(3)
            inside[axis], outside[axis] = side * (half_m - 1e-3), side * (half_m + 1e-3)
            assert ct.hu_at(inside) > 150 > -500 > ct.hu_at(outside), (axis, side)
    many = ct.hu_at(ct.voxel_to_world([[0, 0, 0], [1, 2, 3]]))
    assert list(many) == [ct.hu[0, 0, 0], ct.hu[3, 2, 1]]
    far = corner - 1.0
    assert "outside the volume" in refusal(t.ArgumentError, lambda: ct.hu_at(far))
    assert "outside the volume" in refusal(t.ArgumentError, lambda: ct.hu_at([np.nan, 0.0, 0.0]))
    client.run_control(t.ControlAction.STOP)


def starts_runs(scene: str, out: str) -> None:
    """`run` starts a run with overrides, returns the client, and ends the run."""
    changes: dict[str, Any] = {"run.duration_s": 0.3, "name": "renamed", "controller.0.connect_limit_s": 30.0}
    with t.run(scene, overrides=changes, output=out, timeout_s=LIMIT_S) as client:
        info = client.info
        assert info.tick_count == 300 and info.controller == "mine"
        assert re.search(r'^name = "renamed"$', info.scene_toml, re.M), info.scene_toml
        for state in client.states(LIMIT_S):
            with client.command() as command:
                command.tendon_mode, command.tendon_force_n[0] = t.TendonMode.SERVO_JF, 2.0
    assert len(os.listdir(out)) == 1
    # Left early: the run is stopped and its log is whole.
    with t.run(scene, output=out, timeout_s=LIMIT_S) as client:
        assert client.step(20, LIMIT_S).tick == 20
        folder = client.info.folder
    assert not os.path.exists(folder)
    # An exception in the block propagates, and everything is cleaned up.
    try:
        with t.run(scene, output=out, timeout_s=LIMIT_S) as client:
            folder = client.info.folder
            # A run that has not begun leaves no log.
            assert client.step(1, LIMIT_S).tick == 1
            raise KeyError("mine")
    except KeyError:
        pass
    assert not os.path.exists(folder)
    for overrides, words in [
        ({"run.duration_s": -1}, "`run.duration_s` is -1; allowed: 0.001 to 86400"),
        ({"run.duration_s": object()}, "the override `run.duration_s` is <object"),
        ({"run.durations": 1}, "unknown field `durations`"),
    ]:
        with_them = t.run(scene, overrides=overrides, output=out, timeout_s=LIMIT_S)
        text = refusal(t.ArgumentError, with_them.__enter__)
        assert words in text, text
    os.environ["TRABECULA_PROGRAM"] = "/nowhere/trabecula"
    assert "install the package by `pip install .`" in refusal(t.Error, t.run(scene).__enter__)


CASES = [
    # `tendon_force_n = 5.0` wrote all four tendons, a wrong mode ended in `struct.error`, and misuse in
    # errors of other libraries.
    wrong_values,
    # Arrays must not have their full capacity, and elements of message arrays need attributes instead of
    # keys.
    true_lengths_and_names,
    # A reset must be visible in events and states.
    steps_and_resets,
    places,
]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__)
def test_the_interface(case: Callable[[], None], start: Callable[[str], Run]) -> None:
    run = start(imaged())
    support.outside(case, session=run.session, controller="mine")
    run.end()


def test_a_client_that_names_none_of_several_sessions_is_refused_at_once(start: Callable[[str], Run]) -> None:
    """Several sessions must not be treated like none, which is retried until the timeout."""
    runs = [start(shared("realtime", 600.0)) for _ in range(2)]
    support.outside(several_sessions, *(run.session for run in runs))
    for run in runs:
        support.trabecula("session", "stop", run.session)
        run.end()


def test_a_run_is_started_overridden_and_ended(tmp_path: Path) -> None:
    out = tmp_path / "out"
    support.outside(starts_runs, SCENES / "free_space.toml", out)
    folders = list(out.iterdir())
    assert len(folders) == 3, folders
    for folder in folders:
        support.assert_replays(folder)


if __name__ == "__main__":
    support.main(globals())
