"""Environments of Gymnasium on `trabecula.sim`: `gymnasium.make("trabecula.gym:trabecula/CurvedDrilling-v0")`.

The part before the colon has Gymnasium import this module, which registers them; after `import trabecula.gym` the name alone will do.
Episodes are a function of the seed and the actions, to the bit.
"""

from __future__ import annotations

from typing import Any, Optional, SupportsFloat

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from . import _generated as g
from ._errors import ArgumentError
from ._geometry import rotation_matrix
from .sim import Overrides, SceneFile, Sim

__all__ = ["CurvedDrilling", "register_envs"]

Floats = npt.NDArray[np.float32]
Vector = npt.NDArray[np.float64]


ID = "trabecula/CurvedDrilling-v0"


def register_envs() -> None:
    """Makes the environments known to Gymnasium; importing this module does."""
    if ID not in gymnasium.registry:
        gymnasium.register(ID, entry_point="trabecula.gym:CurvedDrilling", max_episode_steps=400)


class CurvedDrilling(gymnasium.Env[Floats, Floats]):
    """Drill a curve from the end of a pilot hole to a target in the femoral head, by tension of the tendon and feed of the arm.

    The built-in femur scene, or one of the same kind. The burr turns at `BURR_RPM` throughout; the arm inserts along the tool's axis.

    **Action**, shape (2,), each in [-1, 1]: tension of tendon 0 from 0 to `MOST_TENSION_N`; feed from 0 to `MOST_FEED_MM_PER_S`. It holds
    for `ticks` ticks.

    **Observation**, shape (9,), float32, the truth without noise: the burr's centre relative to the target along the axis, toward the bend
    and across it (mm); inserted length (mm); bend of the tip (rad); tension and displacement of tendon 0 (N, mm); force on burr and flange
    (N).

    **Reward**: by how much the burr came nearer to the target during the action (mm), less `FORCE_COST` for each newton on the flange beyond
    `GENTLE_FORCE_N`, and `BONUS` when it arrives. A whole episode is worth the way to the target, about 29 mm, and the bonus.

    The episode **ends** within `REACHED_MM` of the target, or when the insertion is at its end and the burr has passed the target
    (`info["reached"]` says which). Gymnasium's time limit truncates it after 400 actions.

    The **target** is the scene's, moved by up to `spread_mm` along the bend and along the axis, drawn from the seed of `reset`; or
    `options={"target_mm": (x, y, z)}` of `reset`, patient frame (LPS).
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}

    BURR_RPM = 8000.0
    MOST_TENSION_N = 12.0
    MOST_FEED_MM_PER_S = 3.0
    #: An insertion has a speed above 0.
    LEAST_FEED_MM_PER_S = 0.01
    INSERTION_MM = 32.0
    GENTLE_FORCE_N = 10.0
    FORCE_COST = 0.01
    REACHED_MM = 0.3
    BONUS = 10.0

    def __init__(
        self,
        scene: SceneFile = None,
        *,
        overrides: Optional[Overrides] = None,
        target_mm: tuple[float, float, float] = (-98.6, 2.3, 8.4),
        spread_mm: float = 1.5,
        ticks: int = 50,
        render_mode: Optional[str] = None,
    ) -> None:
        """An environment at the start of an episode.

        Args:
            scene: As in `Sim`.
            overrides: As in `Sim`: another bone, another tool.
            target_mm: Where the burr's centre is to arrive, patient frame (LPS); the built-in scene's by default.
            spread_mm: By how much it is moved from episode to episode, in either direction.
            ticks: Ticks of an action.
            render_mode: None, or "rgb_array": the scene's X-ray.
        """
        if render_mode not in (None, "rgb_array"):
            raise ArgumentError(f"`render_mode` is {render_mode!r}, expected None or 'rgb_array'")
        self.render_mode = render_mode
        self.sim = Sim(scene, overrides=overrides, drive=True)
        self._ticks, self._spread_mm = ticks, spread_mm
        self._centre_mm = np.asarray(target_mm, np.float64)
        self._command = g.Command()
        self._command.tendon_mode = g.TendonMode.SERVO_JF
        self._command.arm_mode = g.ArmMode.INSERT
        self._command.burr_mode = g.BurrMode.SPEED
        self._command.burr_speed_rad_per_s = self.BURR_RPM * 2.0 * np.pi / 60.0
        self._command.arm_depth_m = self.INSERTION_MM * 1e-3
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = spaces.Box(-np.inf, np.inf, (9,), np.float32)
        self._begin(np.zeros(2), None)

    def _begin(self, moved_mm: Vector, target_mm: Optional[Vector]) -> g.State:
        """The start of an episode: the state of tick 0. Without a target, the scene's is moved along the axis and toward the bend."""
        self.sim.reset()
        state = self.sim.state
        self._axes = _axes(state)
        self._flange_mm = np.array(state.t_world_flange.position_m) * 1e3
        self._command.arm_axis[:] = self._axes[0]
        self._target_mm = self._centre_mm + moved_mm @ self._axes[:2] if target_mm is None else target_mm
        self._distance_mm = self._distance(state)
        return state

    def reset(
        self, *, seed: Optional[int] = None, options: Optional[dict[str, Any]] = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Begins an episode; see the class for `options`."""
        super().reset(seed=seed)
        moved_mm = self.np_random.uniform(-self._spread_mm, self._spread_mm, 2)
        given = (options or {}).get("target_mm")
        state = self._begin(moved_mm, None if given is None else np.asarray(given, np.float64))
        return self._observation(state), self._info(state)

    def step(self, action: Floats) -> tuple[Floats, SupportsFloat, bool, bool, dict[str, Any]]:
        """Makes the ticks of an action."""
        share = (np.clip(np.asarray(action, np.float64), -1.0, 1.0) + 1.0) * 0.5
        self._command.tendon_force_n[0] = share[0] * self.MOST_TENSION_N
        feed_mm_per_s = max(share[1] * self.MOST_FEED_MM_PER_S, self.LEAST_FEED_MM_PER_S)
        self._command.arm_speed_m_per_s = feed_mm_per_s * 1e-3
        state = self.sim.step(self._command, self._ticks)
        before_mm, self._distance_mm = self._distance_mm, self._distance(state)
        force_n = float(np.linalg.norm(state.flange_wrench.force_n))
        reward = before_mm - self._distance_mm - self.FORCE_COST * max(0.0, force_n - self.GENTLE_FORCE_N)
        info = self._info(state)
        at_the_end = self._inserted_mm(state) >= self.INSERTION_MM - 0.01
        passed = bool((self._burr_mm(state) - self._target_mm) @ self._axes[0] > 3.0)
        if info["reached"]:
            reward += self.BONUS
        return self._observation(state), float(reward), bool(info["reached"] or at_the_end or passed), False, info

    def render(self) -> Any:
        """The scene's X-ray, shape (rows, columns, 3), uint8; None without a render mode."""
        if self.render_mode is None:
            return None
        grey = (self.sim.render().pixels >> 8).astype(np.uint8)
        return np.repeat(grey[:, :, None], 3, axis=2)

    def _burr_mm(self, state: g.State) -> Vector:
        return np.asarray(state.t_world_burr.position_m) * 1e3

    def _distance(self, state: g.State) -> float:
        return float(np.linalg.norm(self._burr_mm(state) - self._target_mm))

    def _inserted_mm(self, state: g.State) -> float:
        return float((np.asarray(state.t_world_flange.position_m) * 1e3 - self._flange_mm) @ self._axes[0])

    def _observation(self, state: g.State) -> Floats:
        place_mm = self._axes @ (self._burr_mm(state) - self._target_mm)
        tendon = (state.tendon_tension_n[0], state.tendon_displacement_m[0] * 1e3)
        forces_n = (state.burr_force_n, float(np.linalg.norm(state.flange_wrench.force_n)))
        return np.asarray([*place_mm, self._inserted_mm(state), state.bend_rad, *tendon, *forces_n], np.float32)

    def _info(self, state: g.State) -> dict[str, Any]:
        return {
            "distance_mm": self._distance_mm,
            "reached": self._distance_mm < self.REACHED_MM,
            "target_mm": tuple(float(x) for x in self._target_mm),
            "tick": state.tick,
            "removed_voxels": state.removed_total,
        }


def _axes(state: g.State) -> Vector:
    """Rows: the tool's axis, the direction of the bend, and across both."""
    bend, across, along = rotation_matrix(state.t_world_base.orientation_xyzw).T
    return np.array([along, bend, across])


register_envs()
