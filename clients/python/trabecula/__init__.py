"""Controllers and observers of a running Trabecula session.

    import trabecula

    with trabecula.Client() as client:
        for state in client.states():
            with client.command() as command:
                command.tendon_mode = trabecula.TENDON_SERVO_JF
                command.tendon_force_n[0] = 5.0

States, frames and the CT volume are views of shared memory: nothing is copied, and they stay readable for as long as they are
referenced. Units are SI; each name ends in its unit.
"""

from . import _generated
from ._client import Client, Ct, Ended, Error, Image, Info, Removal, SessionEvent
from ._generated import *  # noqa: F403  messages and constants
from ._generated import VERSION as __version__
from ._view import View

__all__ = [
    "Client",
    "Ct",
    "Ended",
    "Error",
    "Image",
    "Info",
    "Removal",
    "SessionEvent",
    "View",
    *_generated.__all__,
]
