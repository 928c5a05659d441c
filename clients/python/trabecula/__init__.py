"""Controllers and observers of a running Trabecula session.

    import trabecula

    with trabecula.run("scene.toml", overrides={"run.duration_s": 2.0}) as client:
        for state in client.states():
            with client.command() as command:
                command.tendon_mode = trabecula.TendonMode.SERVO_JF
                command.tendon_force_n[0] = 5.0

`Client()` joins a run that is already in progress. States, frames and the CT volume are views of shared
memory: nothing is copied, and they stay readable for as long as they are referenced. Units are SI; names end
in their unit.
"""

from . import _generated
from ._client import Client
from ._errors import ArgumentError, Ended, Error, ReadOnlyError
from ._generated import *  # noqa: F403  messages and constants
from ._generated import VERSION as __version__
from ._geometry import pixel_to_world, pose_matrix, rotation_matrix, world_to_pixel
from ._results import Ct, Image, Info, Jacobian, Reading, Removal, SessionEvent
from ._run import run
from ._view import Elements, View

__all__ = [
    "ArgumentError",
    "Client",
    "Ct",
    "Elements",
    "Ended",
    "Error",
    "Image",
    "Info",
    "Jacobian",
    "ReadOnlyError",
    "Reading",
    "Removal",
    "SessionEvent",
    "View",
    "pixel_to_world",
    "pose_matrix",
    "rotation_matrix",
    "run",
    "world_to_pixel",
]
__all__ += _generated.__all__
