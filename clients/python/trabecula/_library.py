"""Finds and loads libtrabecula_client."""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

from . import _generated as g

NAME = "libtrabecula_client.so"
#: Environment variable with the library's path; takes precedence over all other locations.
VARIABLE = "TRABECULA_CLIENT_LIBRARY"


def _candidates() -> list[Path]:
    given = os.environ.get(VARIABLE)
    if given:
        return [Path(given)]
    here = Path(__file__).resolve().parent
    # Next to this file in an installed package; in cargo's target folder when run from the sources.
    return [here / NAME, here.parents[2] / "target" / "release" / NAME]


def load() -> ctypes.CDLL:
    """Loads the library and sets the types of all its functions.

    Raises:
        ImportError: It is not found or cannot be loaded.
    """
    candidates = _candidates()
    path = next((path for path in candidates if path.exists()), None)
    if path is None:
        places = ", ".join(str(path) for path in candidates)
        raise ImportError(
            f"{NAME} was not found in: {places}; build it with `pip install .` in a checkout, "
            f"or set its path in {VARIABLE}"
        )
    try:
        library = ctypes.CDLL(str(path))
    except OSError as cause:
        raise ImportError(f"{path} cannot be loaded: {cause}") from cause
    for name, result, arguments in g.FUNCTIONS:
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library
