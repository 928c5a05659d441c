"""Gymnasium environments based on `trabecula.sim`:
`gymnasium.make("trabecula.gym:trabecula/CurvedDrilling-v0")`.

The part before the colon makes Gymnasium import this module, which registers the environments; after `import
trabecula.gym`, the name alone is sufficient. Episodes depend only on the seed and the actions, bit for bit.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any, Dict, Optional, Sequence, SupportsFloat, TypeVar

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from . import _generated as g
from ._errors import ArgumentError
from ._geometry import rotation_matrix, world_to_pixel
from .sim import Overrides, SceneFile, Sim

__all__ = ["CurvedDrilling", "Skiving", "XRaySteering", "register_envs"]

Floats = npt.NDArray[np.float32]
Vector = npt.NDArray[np.float64]
Info = dict[str, Any]
Seen = TypeVar("Seen")

#: Name of each environment, its class, and the number of actions after which Gymnasium truncates an episode.
ENVIRONMENTS = {
    "trabecula/CurvedDrilling-v0": ("CurvedDrilling", 400),
    "trabecula/Skiving-v0": ("Skiving", 300),
    "trabecula/XRaySteering-v0": ("XRaySteering", 400),
}

#: A block whose half at +x is denser; the tool is fed straight along the boundary, with its burr 1.5 mm from
#: it. Like `configs/skiving.toml`, but without its controller, with tendon 0 toward the dense side, and with
#: an X-ray.
SKIVING_SCENE = """
name = "skiving"
[run]
mode = "lockstep"
duration_s = 60.0
[volume]
phantom = "block"
block_density_ratio = 10.0
[tool]
burr_start_mm = [-1.5, 0.0, -32.0]
direction = [0.0, 0.0, 1.0]
bend_toward = [1.0, 0.0, 0.0]
[drr]
rate_hz = 1.0
isocentre_mm = [0.0, 0.0, -25.0]
primary_angle_deg = 90.0
columns = 128
rows = 128
pixel_pitch_mm = 0.8
[[controller]]
name = "agent"
drives = ["tendon", "arm", "burr"]
external = true
"""


def register_envs() -> None:
    """Registers the environments with Gymnasium. Importing this module does the same."""
    for name, (kind, most_actions) in ENVIRONMENTS.items():
        if name not in gymnasium.registry:
            gymnasium.register(name, entry_point=f"trabecula.gym:{kind}", max_episode_steps=most_actions)


class _Feed(gymnasium.Env[Seen, Floats]):
    """Base of the environments: a tool whose burr spins at `BURR_RPM` and that the arm inserts along its
    axis.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}

    BURR_RPM = 8000.0
    #: An insertion needs a speed above 0.
    LEAST_FEED_MM_PER_S = 0.01
    MOST_FEED_MM_PER_S: float
    INSERTION_MM: float

    def __init__(self, sim: Sim, ticks: int, render_mode: Optional[str]) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ArgumentError(f"`render_mode` is {render_mode!r}, expected None or 'rgb_array'")
        self.render_mode = render_mode
        self.sim = sim
        self._ticks = ticks
        self._command = g.Command()
        self._command.tendon_mode = g.TendonMode.SERVO_JF
        self._command.arm_mode = g.ArmMode.INSERT
        self._command.burr_mode = g.BurrMode.SPEED
        self._command.burr_speed_rad_per_s = self.BURR_RPM * 2.0 * np.pi / 60.0
        self._command.arm_depth_m = self.INSERTION_MM * 1e-3

    def _start(self) -> g.State:
        """Returns to tick 0."""
        self.sim.reset()
        state = self.sim.state
        self._axes = _axes(state)
        self._flange_mm = np.array(state.t_world_flange.position_m) * 1e3
        self._command.arm_axis[:] = self._axes[0]
        return state

    def _feed(self, share: float) -> None:
        """Requests a fraction of the maximum feed."""
        feed_mm_per_s = max(share * self.MOST_FEED_MM_PER_S, self.LEAST_FEED_MM_PER_S)
        self._command.arm_speed_m_per_s = feed_mm_per_s * 1e-3

    def _inserted_mm(self, state: g.State) -> float:
        return float((np.asarray(state.t_world_flange.position_m) * 1e3 - self._flange_mm) @ self._axes[0])

    def _is_inserted(self, state: g.State) -> bool:
        return self._inserted_mm(state) >= self.INSERTION_MM - 0.01

    def render(self) -> Any:
        """Returns the scene's X-ray, shape (rows, columns, 3), uint8; None without a render mode."""
        if self.render_mode is None:
            return None
        return np.repeat(_grey(self.sim.render().pixels)[:, :, None], 3, axis=2)


class _ToTarget(_Feed[Seen]):
    """Drilling a curve from the end of a pilot hole to a target: base of `CurvedDrilling` and `XRaySteering`.
    """

    MOST_TENSION_N = 12.0
    MOST_FEED_MM_PER_S = 3.0
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
        """Creates an environment at the start of an episode.

        Args:
            scene: As in `Sim`.
            overrides: As in `Sim`: for another bone or another tool.
            target_mm: Target of the burr's centre, patient frame (LPS); by default that of the built-in
                scene.
            spread_mm: Maximum random offset of the target per episode, in either direction.
            ticks: Ticks per action.
            render_mode: None, or "rgb_array": the scene's X-ray.
        """
        super().__init__(Sim(scene, overrides=overrides, drive=True), ticks, render_mode)
        self._spread_mm = spread_mm
        self._centre_mm = np.asarray(target_mm, np.float64)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self._begin(np.zeros(2), None)

    def _observation(self, state: g.State) -> Seen:
        raise NotImplementedError

    def _begin(self, moved_mm: Vector, target_mm: Optional[Vector]) -> g.State:
        """Starts an episode; returns the state at tick 0. Without a target, the scene's target is moved along
        the axis and toward the bend.
        """
        state = self._start()
        self._target_mm = self._centre_mm + moved_mm @ self._axes[:2] if target_mm is None else target_mm
        self._distance_mm = self._distance(state)
        return state

    def reset(self, *, seed: Optional[int] = None, options: Optional[Info] = None) -> tuple[Seen, Info]:
        """Starts an episode; see the class for `options`."""
        super().reset(seed=seed)
        moved_mm = self.np_random.uniform(-self._spread_mm, self._spread_mm, 2)
        given = (options or {}).get("target_mm")
        state = self._begin(moved_mm, None if given is None else np.asarray(given, np.float64))
        return self._observation(state), self._info(state)

    def step(self, action: Floats) -> tuple[Seen, SupportsFloat, bool, bool, Info]:
        """Runs the ticks of an action."""
        share = (np.clip(np.asarray(action, np.float64), -1.0, 1.0) + 1.0) * 0.5
        self._command.tendon_force_n[0] = share[0] * self.MOST_TENSION_N
        self._feed(share[1])
        state = self.sim.step(self._command, self._ticks)
        before_mm, self._distance_mm = self._distance_mm, self._distance(state)
        force_n = float(np.linalg.norm(state.flange_wrench.force_n))
        reward = before_mm - self._distance_mm - self.FORCE_COST * max(0.0, force_n - self.GENTLE_FORCE_N)
        info = self._info(state)
        passed = bool((_burr_mm(state) - self._target_mm) @ self._axes[0] > 3.0)
        if info["reached"]:
            reward += self.BONUS
        ended = bool(info["reached"] or self._is_inserted(state) or passed)
        return self._observation(state), float(reward), ended, False, info

    def _distance(self, state: g.State) -> float:
        return float(np.linalg.norm(_burr_mm(state) - self._target_mm))

    def _info(self, state: g.State) -> Info:
        return {
            "distance_mm": self._distance_mm,
            "reached": self._distance_mm < self.REACHED_MM,
            "target_mm": tuple(float(x) for x in self._target_mm),
            "tick": state.tick,
            "removed_voxels": state.removed_total,
        }


class CurvedDrilling(_ToTarget[Floats]):
    """Drill a curve from the end of a pilot hole to a target in the femoral head, with tendon tension and arm
    feed.

    The built-in femur scene, or one of the same kind. The burr always spins at `BURR_RPM`; the arm inserts
    along the tool's axis.

    **Action**, shape (2,), each in [-1, 1]: tension of tendon 0 from 0 to `MOST_TENSION_N`; feed from 0 to
    `MOST_FEED_MM_PER_S`. It is held for `ticks` ticks.

    **Observation**, shape (9,), float32, ground truth without noise: position of the burr's centre relative
    to the target along the axis, toward the bend and across it (mm); inserted length (mm); bend of the tip
    (rad); tension and displacement of tendon 0 (N, mm); force on burr and flange (N).

    **Reward**: decrease of the burr's distance to the target during the action (mm), minus `FORCE_COST` for
    each newton on the flange above `GENTLE_FORCE_N`, plus `BONUS` on arrival. A complete episode is worth the
    distance to the target, about 29 mm, plus the bonus.

    The episode **ends** within `REACHED_MM` of the target, at the end of the insertion, or once the burr has
    passed the target (`info["reached"]` tells whether it was reached). Gymnasium's time limit truncates it
    after 400 actions.

    The **target** is the scene's, moved by up to `spread_mm` along the bend and along the axis, drawn from
    the seed of `reset`; or `options={"target_mm": (x, y, z)}` of `reset`, patient frame (LPS).
    """

    observation_space = spaces.Box(-np.inf, np.inf, (9,), np.float32)

    def _observation(self, state: g.State) -> Floats:
        place_mm = self._axes @ (_burr_mm(state) - self._target_mm)
        tendon = (state.tendon_tension_n[0], state.tendon_displacement_m[0] * 1e3)
        forces_n = (state.burr_force_n, float(np.linalg.norm(state.flange_wrench.force_n)))
        seen = [*place_mm, self._inserted_mm(state), state.bend_rad, *tendon, *forces_n]
        return np.asarray(seen, np.float32)


class XRaySteering(_ToTarget[Dict[str, Any]]):
    """`CurvedDrilling` guided by X-ray: before each action, the agent gets a frame of the scene's C-arm
    instead of the true position.

    **Action**, **reward**, **target** and the end of an episode are those of `CurvedDrilling`.

    **Observation**, a dictionary: `image`, shape (rows, columns, 1), uint8, the frame at the current tick
    with noise, 0 is black; `target`, shape (2,), float32, column and row of the target as a fraction of the
    image size, 0 to 1 inside; `measured`, shape (2,), float32, quantities known without an X-ray: inserted
    length (mm) and tension of tendon 0 (N).

    A frame has 96 by 96 pixels on the scene's detector; change this with `overrides` of `drr.columns`,
    `drr.rows` and `drr.pixel_pitch_mm`.
    """

    #: The detector of the built-in scene with fewer pixels.
    PIXELS = {"drr.columns": 96, "drr.rows": 96, "drr.pixel_pitch_mm": 1.6}

    def __init__(
        self, scene: SceneFile = None, *, overrides: Optional[Overrides] = None, **others: Any
    ) -> None:
        """Creates an environment at the start of an episode; arguments as in `CurvedDrilling`."""
        super().__init__(scene, overrides={**self.PIXELS, **(overrides or {})}, **others)
        rows, columns = self.sim.render().pixels.shape
        self.observation_space = spaces.Dict(
            {
                "image": spaces.Box(0, 255, (rows, columns, 1), np.uint8),
                "target": spaces.Box(-np.inf, np.inf, (2,), np.float32),
                "measured": spaces.Box(-np.inf, np.inf, (2,), np.float32),
            }
        )

    def _observation(self, state: g.State) -> Dict[str, Any]:
        image = self.sim.render()
        rows, columns = image.pixels.shape
        target = world_to_pixel(image.frame.geometry, self._target_mm * 1e-3) / (columns, rows)
        measured = (self._inserted_mm(state), state.tendon_tension_n[0])
        return {
            "image": _grey(image.pixels)[:, :, None],
            "target": target.astype(np.float32),
            "measured": np.asarray(measured, np.float32),
        }


class Skiving(_Feed[Floats]):
    """Keep the burr on a straight line along the boundary of two densities, against the pull toward the
    softer side.

    A block whose half at +x is ten times denser; the tool is fed along +z, 1.5 mm from the boundary. Without
    tension the burr leaves its line toward the soft side ("skives"); the slower the feed, the more.

    **Action**, shape (2,), each in [-1, 1]: tension from -`MOST_TENSION_N` to `MOST_TENSION_N`, positive for
    tendon 0, which bends toward the dense side, negative for tendon 1; feed from 0 to `MOST_FEED_MM_PER_S`.
    It is held for `ticks` ticks.

    **Observation**, shape (7,), float32, ground truth without noise: deviation of the burr from its line
    toward the dense side and across (mm); inserted length (mm); bend of the tip (rad); tensions of tendons 0
    and 1 (N); force on the burr (N).

    **Reward**: length fed during the action (mm), minus the burr's final distance from its line (mm) times
    the length fed. A complete episode on the line is worth `INSERTION_MM`.

    The episode **ends** at the end of the insertion, or if the burr is farther than `LOST_MM` from its line
    (`info["lost"]`). Gymnasium's time limit truncates it after 300 actions.

    The **density ratio** is drawn from `ratios` with the seed of `reset`, or set by `options={"ratio": 5.0}`
    of `reset`; each ratio has its own simulation, created once.
    """

    MOST_TENSION_N = 6.0
    MOST_FEED_MM_PER_S = 4.0
    INSERTION_MM = 14.0
    LOST_MM = 3.0

    observation_space = spaces.Box(-np.inf, np.inf, (7,), np.float32)

    def __init__(
        self,
        *,
        overrides: Optional[Overrides] = None,
        ratios: Sequence[float] = (2.0, 5.0, 10.0),
        ticks: int = 50,
        render_mode: Optional[str] = None,
    ) -> None:
        """Creates an environment at the start of an episode.

        Args:
            overrides: As in `Sim`, on top of `SKIVING_SCENE`.
            ratios: Density ratios to draw from, 1 to 20.
            ticks: Ticks per action.
            render_mode: None, or "rgb_array": the scene's X-ray.
        """
        if not len(ratios):
            raise ArgumentError("`ratios` is empty, expected at least one density ratio")
        self._ratios = [float(ratio) for ratio in ratios]
        self._overrides = dict(overrides or {})
        self._sims: dict[float, Sim] = {}
        super().__init__(self._of(self._ratios[0]), ticks, render_mode)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self._begin(self._ratios[0])

    def _of(self, ratio: float) -> Sim:
        if ratio not in self._sims:
            with tempfile.TemporaryDirectory() as folder:
                file = Path(folder) / "skiving.toml"
                file.write_text(SKIVING_SCENE)
                overrides = {"volume.block_density_ratio": ratio, **self._overrides}
                self._sims[ratio] = Sim(file, overrides=overrides, drive=True)
        return self._sims[ratio]

    def _begin(self, ratio: float) -> g.State:
        self.sim, self._ratio = self._of(ratio), ratio
        state = self._start()
        self._line_mm = _burr_mm(state)
        self._fed_mm = 0.0
        return state

    def reset(self, *, seed: Optional[int] = None, options: Optional[Info] = None) -> tuple[Floats, Info]:
        """Starts an episode; see the class for `options`."""
        super().reset(seed=seed)
        drawn = self._ratios[int(self.np_random.integers(len(self._ratios)))]
        state = self._begin(float((options or {}).get("ratio", drawn)))
        return self._observation(state), self._info(state)

    def step(self, action: Floats) -> tuple[Floats, SupportsFloat, bool, bool, Info]:
        """Runs the ticks of an action."""
        tension, feed = np.clip(np.asarray(action, np.float64), -1.0, 1.0)
        tension_n = tension * self.MOST_TENSION_N
        self._command.tendon_force_n[:2] = (max(tension_n, 0.0), max(-tension_n, 0.0))
        self._feed((feed + 1.0) * 0.5)
        state = self.sim.step(self._command, self._ticks)
        before_mm, self._fed_mm = self._fed_mm, self._inserted_mm(state)
        info = self._info(state)
        reward = (self._fed_mm - before_mm) * (1.0 - info["off_line_mm"])
        ended = bool(info["lost"] or self._is_inserted(state))
        return self._observation(state), float(reward), ended, False, info

    def _off_mm(self, state: g.State) -> Vector:
        """Returns the deviation from the line: toward the dense side, and across."""
        return np.asarray(self._axes[1:] @ (_burr_mm(state) - self._line_mm))

    def _observation(self, state: g.State) -> Floats:
        tensions_n = state.tendon_tension_n[:2]
        motion = (*self._off_mm(state), self._inserted_mm(state), state.bend_rad)
        seen = [*motion, *tensions_n, state.burr_force_n]
        return np.asarray(seen, np.float32)

    def _info(self, state: g.State) -> Info:
        off_mm = float(np.linalg.norm(self._off_mm(state)))
        return {
            "off_line_mm": off_mm,
            "lost": off_mm > self.LOST_MM,
            "ratio": self._ratio,
            "tick": state.tick,
        }


def _burr_mm(state: g.State) -> Vector:
    return np.asarray(state.t_world_burr.position_m) * 1e3


def _grey(pixels: npt.NDArray[np.uint16]) -> npt.NDArray[np.uint8]:
    return (pixels >> 8).astype(np.uint8)


def _axes(state: g.State) -> Vector:
    """Returns as rows the tool's axis, the direction of the bend, and the direction across both."""
    bend, across, along = rotation_matrix(state.t_world_base.orientation_xyzw).T
    return np.array([along, bend, across])


register_envs()
