"""Finds the native half of `trabecula.sim`."""

from __future__ import annotations

import os
import sys
from importlib.machinery import ExtensionFileLoader
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import TYPE_CHECKING, Any

__all__ = ["native"]

#: File name in an installed package.
NAME = "_sim.abi3.so"
#: File name of cargo's build.
BUILT = "libtrabecula_sim.so"
#: Environment variable with the library's path; takes precedence over all other locations.
VARIABLE = "TRABECULA_SIM_LIBRARY"


def _load() -> Any:
    """Loads the module.

    Raises:
        ImportError: It is not found or cannot be loaded.
    """
    here = Path(__file__).resolve().parent
    given = os.environ.get(VARIABLE)
    candidates = [Path(given)] if given else [here / NAME, here.parents[2] / "target" / "release" / BUILT]
    path = next((path for path in candidates if path.exists()), None)
    if path is None:
        places = ", ".join(str(path) for path in candidates)
        raise ImportError(
            f"the native half of trabecula.sim was not found in: {places}; "
            f"build it with `pip install .` in a checkout, or set its path in {VARIABLE}"
        )
    name = f"{__package__}._sim"
    spec = spec_from_file_location(name, path, loader=ExtensionFileLoader(name, str(path)))
    assert spec is not None and spec.loader is not None  # from an existing path
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    sys.modules[name] = module
    return module


if TYPE_CHECKING:
    from . import _sim as native
else:
    native = _load()
