"""Builds the wheel: cargo builds the client library and the native half of trabecula.sim, which go into the package.

Needs Rust, a C++ compiler and Python, nothing else.
"""

from __future__ import annotations

import base64
import hashlib
import os
import re
import subprocess
import sysconfig
import zipfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
#: Name in the package, name as cargo builds it, package of the workspace, environment variable with the path of one that is built already.
LIBRARIES = [
    ("libtrabecula_client.so", "libtrabecula_client.so", "trabecula_client", "TRABECULA_CLIENT_LIBRARY"),
    ("_sim.abi3.so", "libtrabecula_sim.so", "trabecula_sim", "TRABECULA_SIM_LIBRARY"),
]
REQUIREMENTS = ["numpy>=1.24", "gymnasium>=1.0; extra == 'gym'"]
#: The native half of trabecula.sim keeps to the interface that every Python from 3.9 on has.
TAG = "cp39-abi3"


def _version() -> str:
    return re.search(r'^VERSION = "(.*)"$', (HERE / "trabecula/_generated.py").read_text(), re.M).group(1)


def _libraries() -> dict[str, bytes]:
    """Those that are given; if none is, all as cargo builds them."""
    given = {name: os.environ[variable] for name, _, _, variable in LIBRARIES if os.environ.get(variable)}
    if not given:
        root = HERE.parents[1]
        packages = [word for _, _, package, _ in LIBRARIES for word in ("-p", package)]
        subprocess.run(["cargo", "build", "--release", "--lib", *packages], cwd=root, check=True)
        built = Path(os.environ.get("CARGO_TARGET_DIR", root / "target")) / "release"
        given = {name: str(built / file) for name, file, _, _ in LIBRARIES}
    return {f"trabecula/{name}": Path(path).read_bytes() for name, path in given.items()}


def _metadata() -> dict[str, bytes]:
    version = _version()
    folder = f"trabecula-{version}.dist-info"
    platform = re.sub(r"[-.]", "_", sysconfig.get_platform())
    metadata = (
        f"Metadata-Version: 2.1\nName: trabecula\nVersion: {version}\nRequires-Python: >=3.9\n"
        + "".join(f"Requires-Dist: {requirement}\n" for requirement in REQUIREMENTS)
        + "Provides-Extra: gym\nSummary: Simulations of bone drilling, and controllers and observers of a running Trabecula session\n"
    )
    wheel = f"Wheel-Version: 1.0\nGenerator: trabecula\nRoot-Is-Purelib: false\nTag: {TAG}-{platform}\n"
    return {f"{folder}/METADATA": metadata.encode(), f"{folder}/WHEEL": wheel.encode()}


def _write_wheel(wheel_directory: str, files: dict[str, bytes]) -> str:
    version = _version()
    platform = re.sub(r"[-.]", "_", sysconfig.get_platform())
    name = f"trabecula-{version}-{TAG}-{platform}.whl"
    record = f"trabecula-{version}.dist-info/RECORD"
    lines = []
    with zipfile.ZipFile(Path(wheel_directory) / name, "w", zipfile.ZIP_DEFLATED) as wheel:
        for path, content in files.items():
            digest = base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
            lines.append(f"{path},sha256={digest},{len(content)}\n")
            wheel.writestr(path, content)
        wheel.writestr(record, "".join(lines) + f"{record},,\n")
    return name


def build_wheel(wheel_directory, config_settings=None, metadata_directory=None):
    """PEP 517: the wheel with the sources and the libraries."""
    files = {f"trabecula/{path.name}": path.read_bytes() for path in sorted((HERE / "trabecula").glob("*.py*")) if path.is_file()}
    files["trabecula/py.typed"] = b""
    files.update(_libraries())
    files.update(_metadata())
    return _write_wheel(wheel_directory, files)


def build_sdist(sdist_directory, config_settings=None):
    """PEP 517 wants it; the sources of the libraries are the whole workspace."""
    raise NotImplementedError("install from a checkout: pip install ./clients/python")
