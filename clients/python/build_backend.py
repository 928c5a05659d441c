"""Builds the wheel: cargo builds libtrabecula_client, which goes into the package. Needs Rust and Python, nothing else."""

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
LIBRARY = "libtrabecula_client.so"
#: Path of a library that is built already.
VARIABLE = "TRABECULA_CLIENT_LIBRARY"
REQUIREMENT = "numpy>=1.24"


def _version() -> str:
    return re.search(r'^VERSION = "(.*)"$', (HERE / "trabecula/_generated.py").read_text(), re.M).group(1)


def _library() -> bytes:
    given = os.environ.get(VARIABLE)
    if given:
        return Path(given).read_bytes()
    root = HERE.parents[1]
    subprocess.run(["cargo", "build", "--release", "-p", "trabecula_client", "--lib"], cwd=root, check=True)
    target = Path(os.environ.get("CARGO_TARGET_DIR", root / "target"))
    return (target / "release" / LIBRARY).read_bytes()


def _metadata() -> dict[str, bytes]:
    version = _version()
    folder = f"trabecula-{version}.dist-info"
    platform = re.sub(r"[-.]", "_", sysconfig.get_platform())
    metadata = (
        f"Metadata-Version: 2.1\nName: trabecula\nVersion: {version}\nRequires-Python: >=3.9\n"
        f"Requires-Dist: {REQUIREMENT}\nSummary: Controllers and observers of a running Trabecula session\n"
    )
    wheel = f"Wheel-Version: 1.0\nGenerator: trabecula\nRoot-Is-Purelib: false\nTag: py3-none-{platform}\n"
    return {f"{folder}/METADATA": metadata.encode(), f"{folder}/WHEEL": wheel.encode()}


def _write_wheel(wheel_directory: str, files: dict[str, bytes]) -> str:
    version = _version()
    platform = re.sub(r"[-.]", "_", sysconfig.get_platform())
    name = f"trabecula-{version}-py3-none-{platform}.whl"
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
    """PEP 517: the wheel with the sources and the library."""
    files = {f"trabecula/{path.name}": path.read_bytes() for path in sorted((HERE / "trabecula").glob("*.py"))}
    files["trabecula/py.typed"] = b""
    files[f"trabecula/{LIBRARY}"] = _library()
    files.update(_metadata())
    return _write_wheel(wheel_directory, files)


def build_sdist(sdist_directory, config_settings=None):
    """PEP 517 wants it; the sources of the library are the whole workspace."""
    raise NotImplementedError("install from a checkout: pip install ./clients/python")
