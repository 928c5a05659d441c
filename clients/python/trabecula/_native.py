"""Finds the native half of `trabecula.sim`."""

from __future__ import annotations

import os
import sys
from importlib.machinery import ExtensionFileLoader
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import TYPE_CHECKING, Any

__all__ = ["native"]

#: In an installed package.
NAME = "_sim.abi3.so"
#: As cargo builds it.
BUILT = "libtrabecula_sim.so"
#: Environment variable with the library's path; takes precedence over every other place.
VARIABLE = "TRABECULA_SIM_LIBRARY"


def _load() -> Any:
    """The module.

    Raises:
        ImportError: It is in none of its places, or cannot be loaded.
    """
    here = Path(__file__).resolve().parent
    given = os.environ.get(VARIABLE)
    candidates = [Path(given)] if given else [here / NAME, here.parents[2] / "target" / "release" / BUILT]
    path = next((path for path in candidates if path.exists()), None)
    if path is None:
        places = ", ".join(str(path) for path in candidates)
        raise ImportError(
            f"the native half of trabecula.sim is in none of: {places}; `pip install .` in a checkout builds it, or name it in {VARIABLE}"
        )
    name = f"{__package__}._sim"
    spec = spec_from_file_location(name, path, loader=ExtensionFileLoader(name, str(path)))
    assert spec is not None and spec.loader is not None  # given above
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    sys.modules[name] = module
    return module


if TYPE_CHECKING:
    from . import _sim as native
else:
    native = _load()
