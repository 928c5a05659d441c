"""Environments of Gymnasium on `trabecula.sim`: `gymnasium.make("trabecula.gym:trabecula/CurvedDrilling-v0")`.

The part before the colon has Gymnasium import this module, which registers them; after `import trabecula.gym` the name alone will do.
Episodes are a function of the seed and the actions, to the bit.
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

#: Name of each environment, its class, and the actions after which Gymnasium cuts an episode.
ENVIRONMENTS = {
    "trabecula/CurvedDrilling-v0": ("CurvedDrilling", 400),
    "trabecula/Skiving-v0": ("Skiving", 300),
    "trabecula/XRaySteering-v0": ("XRaySteering", 400),
}

#: A block whose far half, at +x, is denser; the tool is fed straight along the boundary, its burr 1.5 mm beside it. The scene of
#: `configs/skiving.toml` without its controller, tendon 0 toward the dense side, with an X-ray.
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
    """Makes the environments known to Gymnasium; importing this module does."""
    for name, (kind, most_actions) in ENVIRONMENTS.items():
        if name not in gymnasium.registry:
            gymnasium.register(name, entry_point=f"trabecula.gym:{kind}", max_episode_steps=most_actions)


class _Feed(gymnasium.Env[Seen, Floats]):
    """What the environments share: a tool whose burr turns at `BURR_RPM` and that the arm inserts along its axis."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}

    BURR_RPM = 8000.0
    #: An insertion has a speed above 0.
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
        """Back to tick 0."""
        self.sim.reset()
        state = self.sim.state
        self._axes = _axes(state)
        self._flange_mm = np.array(state.t_world_flange.position_m) * 1e3
        self._command.arm_axis[:] = self._axes[0]
        return state

    def _feed(self, share: float) -> None:
        """Asks for a share of the greatest feed."""
        feed_mm_per_s = max(share * self.MOST_FEED_MM_PER_S, self.LEAST_FEED_MM_PER_S)
        self._command.arm_speed_m_per_s = feed_mm_per_s * 1e-3

    def _inserted_mm(self, state: g.State) -> float:
        return float((np.asarray(state.t_world_flange.position_m) * 1e3 - self._flange_mm) @ self._axes[0])

    def _is_inserted(self, state: g.State) -> bool:
        return self._inserted_mm(state) >= self.INSERTION_MM - 0.01

    def render(self) -> Any:
        """The scene's X-ray, shape (rows, columns, 3), uint8; None without a render mode."""
        if self.render_mode is None:
            return None
        return np.repeat(_grey(self.sim.render().pixels)[:, :, None], 3, axis=2)


class _ToTarget(_Feed[Seen]):
    """Drill a curve from the end of a pilot hole to a target: what `CurvedDrilling` and `XRaySteering` share."""

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
        """An environment at the start of an episode.

        Args:
            scene: As in `Sim`.
            overrides: As in `Sim`: another bone, another tool.
            target_mm: Where the burr's centre is to arrive, patient frame (LPS); the built-in scene's by default.
            spread_mm: By how much it is moved from episode to episode, in either direction.
            ticks: Ticks of an action.
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
        """The start of an episode: the state of tick 0. Without a target, the scene's is moved along the axis and toward the bend."""
        state = self._start()
        self._target_mm = self._centre_mm + moved_mm @ self._axes[:2] if target_mm is None else target_mm
        self._distance_mm = self._distance(state)
        return state

    def reset(self, *, seed: Optional[int] = None, options: Optional[Info] = None) -> tuple[Seen, Info]:
        """Begins an episode; see the class for `options`."""
        super().reset(seed=seed)
        moved_mm = self.np_random.uniform(-self._spread_mm, self._spread_mm, 2)
        given = (options or {}).get("target_mm")
        state = self._begin(moved_mm, None if given is None else np.asarray(given, np.float64))
        return self._observation(state), self._info(state)

    def step(self, action: Floats) -> tuple[Seen, SupportsFloat, bool, bool, Info]:
        """Makes the ticks of an action."""
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

    observation_space = spaces.Box(-np.inf, np.inf, (9,), np.float32)

    def _observation(self, state: g.State) -> Floats:
        place_mm = self._axes @ (_burr_mm(state) - self._target_mm)
        tendon = (state.tendon_tension_n[0], state.tendon_displacement_m[0] * 1e3)
        forces_n = (state.burr_force_n, float(np.linalg.norm(state.flange_wrench.force_n)))
        return np.asarray([*place_mm, self._inserted_mm(state), state.bend_rad, *tendon, *forces_n], np.float32)


class XRaySteering(_ToTarget[Dict[str, Any]]):
    """As `CurvedDrilling`, but seen by X-ray: the agent has a frame of the scene's C-arm before each action, and no true place.

    **Action**, **reward**, **target** and the end of an episode are those of `CurvedDrilling`.

    **Observation**, a dictionary: `image`, shape (rows, columns, 1), uint8, the frame of the present tick with its noise, 0 black; `target`,
    shape (2,), float32, column and row of the target in it as a share of its size, 0 to 1 inside; `measured`, shape (2,), float32, what the
    machine knows without an X-ray: inserted length (mm) and tension of tendon 0 (N).

    A frame has 96 by 96 pixels on the scene's detector; `overrides` of `drr.columns`, `drr.rows` and `drr.pixel_pitch_mm` change that.
    """

    #: The detector of the built-in scene with fewer pixels.
    PIXELS = {"drr.columns": 96, "drr.rows": 96, "drr.pixel_pitch_mm": 1.6}

    def __init__(self, scene: SceneFile = None, *, overrides: Optional[Overrides] = None, **others: Any) -> None:
        """An environment at the start of an episode; arguments as in `CurvedDrilling`."""
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
    """Keep the burr on a straight line along the boundary of two densities, against the pull to the softer side.

    A block whose half at +x is ten times denser; the tool is fed along +z, 1.5 mm beside the boundary. Without tension the burr leaves its
    line toward the soft side ("skives"), the more the slower it is fed.

    **Action**, shape (2,), each in [-1, 1]: tension from -`MOST_TENSION_N` to `MOST_TENSION_N`, positive for tendon 0, which bends toward
    the dense side, negative for tendon 1; feed from 0 to `MOST_FEED_MM_PER_S`. It holds for `ticks` ticks.

    **Observation**, shape (7,), float32, the truth without noise: how far the burr is off its line toward the dense side and across (mm);
    inserted length (mm); bend of the tip (rad); tensions of tendons 0 and 1 (N); force on the burr (N).

    **Reward**: length fed during the action (mm), less the distance of the burr from its line at its end (mm) times the length fed. A whole
    episode on the line is worth `INSERTION_MM`.

    The episode **ends** when the insertion is at its end, or the burr is farther than `LOST_MM` from its line (`info["lost"]`). Gymnasium's
    time limit truncates it after 300 actions.

    The **density ratio** is drawn from the seed of `reset` between the two of `ratios`, or `options={"ratio": 5.0}` of `reset`; each ratio
    is a simulation of its own, made once.
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
        """An environment at the start of an episode.

        Args:
            overrides: As in `Sim`, over `SKIVING_SCENE`.
            ratios: The density ratios among which episodes choose, 1 to 20.
            ticks: Ticks of an action.
            render_mode: None, or "rgb_array": the scene's X-ray.
        """
        if not len(ratios):
            raise ArgumentError("`ratios` is empty, expected one density ratio at least")
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
                self._sims[ratio] = Sim(file, overrides={"volume.block_density_ratio": ratio, **self._overrides}, drive=True)
        return self._sims[ratio]

    def _begin(self, ratio: float) -> g.State:
        self.sim, self._ratio = self._of(ratio), ratio
        state = self._start()
        self._line_mm = _burr_mm(state)
        self._fed_mm = 0.0
        return state

    def reset(self, *, seed: Optional[int] = None, options: Optional[Info] = None) -> tuple[Floats, Info]:
        """Begins an episode; see the class for `options`."""
        super().reset(seed=seed)
        drawn = self._ratios[int(self.np_random.integers(len(self._ratios)))]
        state = self._begin(float((options or {}).get("ratio", drawn)))
        return self._observation(state), self._info(state)

    def step(self, action: Floats) -> tuple[Floats, SupportsFloat, bool, bool, Info]:
        """Makes the ticks of an action."""
        tension, feed = np.clip(np.asarray(action, np.float64), -1.0, 1.0)
        tension_n = tension * self.MOST_TENSION_N
        self._command.tendon_force_n[:2] = (max(tension_n, 0.0), max(-tension_n, 0.0))
        self._feed((feed + 1.0) * 0.5)
        state = self.sim.step(self._command, self._ticks)
        before_mm, self._fed_mm = self._fed_mm, self._inserted_mm(state)
        info = self._info(state)
        reward = (self._fed_mm - before_mm) * (1.0 - info["off_line_mm"])
        return self._observation(state), float(reward), bool(info["lost"] or self._is_inserted(state)), False, info

    def _off_mm(self, state: g.State) -> Vector:
        """Off the line: toward the dense side, and across."""
        return np.asarray(self._axes[1:] @ (_burr_mm(state) - self._line_mm))

    def _observation(self, state: g.State) -> Floats:
        tensions_n = state.tendon_tension_n[:2]
        seen = [*self._off_mm(state), self._inserted_mm(state), state.bend_rad, *tensions_n, state.burr_force_n]
        return np.asarray(seen, np.float32)

    def _info(self, state: g.State) -> Info:
        off_mm = float(np.linalg.norm(self._off_mm(state)))
        return {"off_line_mm": off_mm, "lost": off_mm > self.LOST_MM, "ratio": self._ratio, "tick": state.tick}


def _burr_mm(state: g.State) -> Vector:
    return np.asarray(state.t_world_burr.position_m) * 1e3


def _grey(pixels: npt.NDArray[np.uint16]) -> npt.NDArray[np.uint8]:
    return (pixels >> 8).astype(np.uint8)


def _axes(state: g.State) -> Vector:
    """Rows: the tool's axis, the direction of the bend, and across both."""
    bend, across, along = rotation_matrix(state.t_world_base.orientation_xyzw).T
    return np.array([along, bend, across])


register_envs()
