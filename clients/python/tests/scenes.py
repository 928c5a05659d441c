"""Scenes of the tests."""

from __future__ import annotations

from pathlib import Path

import trabecula
from support import SCENES

_RUN = 'name = "{}"\n[run]\nmode = "{}"\nduration_s = {!r}\nseed = 7\n'

#: 3.25 mm in front of the block.
_TOOL = """
[tool]
burr_start_mm = [0.0, 0.0, -34.0]
direction = [0.0, 0.0, 1.0]
bend_toward = [1.0, 0.0, 0.0]
"""

_BLOCK = """
[volume]
phantom = "block"
spacing_mm = 1.0
"""

_X_RAY = """
[drr]
rate_hz = 10.0
isocentre_mm = [0.0, 0.0, -20.0]
columns = 64
rows = 64
pixel_pitch_mm = 1.5
photons_per_pixel = 5000.0
threads = 1
"""

_OTHER = '\n[[controller]]\nname = "other"\ndrives = []\nexternal = true\noptional = true\n'


def free_space() -> str:
    """Lockstep for 1000 ticks in free space, driven by an external `mine`."""
    return (SCENES / "free_space.toml").read_text()


def imaged() -> str:
    """The block in front of the burr, seen by a C-arm, driven by an external `mine`; an external `other` may
    join.
    """
    text = (SCENES / "image_guided.toml").read_text()
    text = text.replace("burr_start_mm = [0.0, 0.0, -45.0]", "burr_start_mm = [0.0, 0.0, -34.0]")
    return text.replace('mode = "lockstep"', 'mode = "lockstep"\ncontroller_limit_ms = 60000') + _OTHER


def with_frames() -> str:
    """Lockstep with X-ray; `mine` and `other` may request frames."""
    return (SCENES / "image_guided.toml").read_text() + _OTHER


def hold(mode: str, duration_s: float) -> str:
    """A built-in controller holds a tension in free space."""
    controller = (
        '[[controller]]\nname = "holder"\ndrives = ["tendon", "arm", "burr"]\nhold = { tension_n = 2.0 }\n'
    )
    return _RUN.format("hold", mode, duration_s) + _TOOL + controller


def shared(mode: str, duration_s: float, holder: str = "hold = { tension_n = 0.0 }") -> str:
    """Free space: an external `pilot` drives tendons and arm; `holder`, built-in by default, drives the burr.
    """
    controllers = f"""
[[controller]]
name = "pilot"
drives = ["tendon", "arm"]
external = true

[[controller]]
name = "holder"
drives = ["burr"]
{holder}
"""
    return _RUN.format("shared", mode, duration_s) + _TOOL + controllers


def drill(duration_s: float) -> str:
    """A built-in controller drills a curve into the block, seen by a C-arm."""
    controller = """
[[controller]]
name = "reference"
drives = ["tendon", "arm", "burr"]

[controller.curved_drilling]
feed_mm_per_s = 8.0
insertion_mm = 20.0
tension_n = 6.0
ramp_start_mm = 1.0
ramp_end_mm = 15.0
burr_speed_rpm = 8000.0
"""
    return _RUN.format("drill", "lockstep", duration_s) + _BLOCK + _TOOL + _X_RAY + controller


#: The block, for simulations, to be completed by a controller `mine`.
DRILL = f"""
name = "drill"
[run]
mode = "lockstep"
duration_s = 0.7
seed = 7
controller_limit_ms = 60000.0
{_BLOCK}{_TOOL}{_X_RAY}
[[controller]]
name = "mine"
drives = ["tendon", "arm", "burr"]
"""
#: External controller.
EXTERNAL = "external = true\n"
#: Built-in controller that uses frames.
GUIDED = """
[controller.curved_drilling]
feed_mm_per_s = 15.0
insertion_mm = 20.0
tension_n = 6.0
ramp_start_mm = 1.0
ramp_end_mm = 15.0
burr_speed_rpm = 8000.0
target_mm = [4.0, 0.0, -16.0]
guidance_gain_n_per_mm = 2.0
feedback = "image"
"""


def written(folder: Path, name: str, rest: str) -> Path:
    """Writes the block's scene, completed by `rest`."""
    path = folder / name
    path.write_text(DRILL + rest)
    return path


def pushing(tick: int) -> trabecula.Command:
    """Returns the command of a tick: deeper into the bone, with a rising tension."""
    command = trabecula.Command()
    command.tendon_mode = trabecula.TendonMode.SERVO_JF
    command.tendon_force_n[0] = 0.005 * tick
    command.arm_mode = trabecula.ArmMode.INSERT
    command.arm_axis[:] = (0.0, 0.0, 1.0)
    command.arm_depth_m = 0.012
    command.arm_speed_m_per_s = 0.012
    command.burr_mode = trabecula.BurrMode.SPEED
    command.burr_speed_rad_per_s = 800.0
    return command
