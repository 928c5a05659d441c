"""Build backend: the wheel with the program, the client library and the native half of trabecula.sim from
cargo, and with scenes, examples, headers and documentation; and the sdist.

Needs Rust, a C++ compiler with binutils, and Python. Setting (`-C` of pip and build):
`platform=manylinux_2_28_x86_64` states the platform of prebuilt binaries; without it the wheel is for
machines like this one.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import io
import json
import os
import re
import subprocess
import sys
import sysconfig
import tarfile
import tempfile
import threading
import time
import zipfile
from pathlib import Path
from typing import NamedTuple

try:
    import tomllib
except ModuleNotFoundError:  # Python before 3.11
    import tomli as tomllib

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
#: The native half of trabecula.sim uses only the stable ABI of Python 3.9 and newer.
TAG = "cp39-abi3"
#: Time limits for a full build and for any other program, s; only reached by a hang.
BUILD_LIMIT_S = 4 * 3600
LIMIT_S = 120
#: Files of the checkout that the wheel holds in its folder `files`, under the same paths, so that the
#: documentation's commands work in a copy of it. The Rust client needs the sources.
SHIPPED = (
    "README.md",
    "CITATION.cff",
    "configs/",
    "docs/",
    "clients/scenes/",
    "clients/c/README.md",
    "clients/c/examples/",
    "clients/c/include/",
    "clients/cpp/",
    "clients/zig/",
    "clients/ros2/",
    "clients/python/README.md",
    "clients/python/examples/",
)
#: Time between two lines of progress, s.
PROGRESS_S = 20.0
#: File with the licences of linked crates, in addition to the wheel's own; generated per wheel, so not in the
#: source distribution.
THIRD_PARTY = "THIRD_PARTY"
#: Earliest time in zip files; a fixed time makes the wheel reproducible.
EPOCH = (1980, 1, 1, 0, 0, 0)


class Binary(NamedTuple):
    """A file built by cargo."""

    #: Path in the wheel; {data} is the folder for files outside the package.
    place: str
    #: File name of cargo's build.
    built: str
    #: Workspace package, and the option that selects its target.
    package: str
    target: str
    #: Environment variable with the path of a prebuilt file.
    variable: str
    mode: int


LIBRARIES = [
    Binary(
        "trabecula/libtrabecula_client.so",
        "libtrabecula_client.so",
        "trabecula_client",
        "--lib",
        "TRABECULA_CLIENT_LIBRARY",
        0o644,
    ),
    Binary(
        "trabecula/_sim.abi3.so",
        "libtrabecula_sim.so",
        "trabecula_sim",
        "--lib",
        "TRABECULA_SIM_LIBRARY",
        0o644,
    ),
    # In `lib` beside the program's folder, where `trabecula fmu export` looks for it.
    Binary(
        "{data}/data/lib/libtrabecula_fmu.so",
        "libtrabecula_fmu.so",
        "trabecula_fmu",
        "--lib",
        "TRABECULA_FMU_LIBRARY",
        0o644,
    ),
]
PROGRAM = Binary(
    "{data}/scripts/trabecula", "trabecula", "trabecula", "--bin=trabecula", "TRABECULA_PROGRAM", 0o755
)


def _project() -> dict:
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def _version() -> str:
    return re.search(r'^VERSION = "(.*)"$', (HERE / "trabecula/_generated.py").read_text(), re.M).group(1)


def _binaries() -> dict[Binary, Path]:
    """Returns the prebuilt files, if a library is given; otherwise builds all with cargo."""
    binaries = [*LIBRARIES, PROGRAM]
    if any(os.environ.get(library.variable) for library in LIBRARIES):
        given = [binary for binary in binaries if os.environ.get(binary.variable)]
        return {binary: Path(os.environ[binary.variable]) for binary in given}
    packages = [f"--package={binary.package}" for binary in binaries]
    targets = sorted({binary.target for binary in binaries})
    built = ROOT / os.environ.get("CARGO_TARGET_DIR", "target") / "release"
    text = f"Building program and libraries in {built}, as `cargo build --release` does"
    print(text, file=sys.stderr, flush=True)
    _build(["cargo", "build", "--release", "--locked", *packages, *targets])
    return {binary: built / binary.built for binary in binaries}


def _build(line: list[str]) -> None:
    """Runs cargo; a terminal shows that it goes on, because pip shows a backend's output only with `-v`.

    Raises:
        CalledProcessError: cargo failed.
    """
    try:
        terminal = open("/dev/tty", "w") if not sys.stderr.isatty() else None
    except OSError:
        terminal = None
    began = said = time.monotonic()
    compiled = 0
    with subprocess.Popen(line, cwd=ROOT, stderr=subprocess.PIPE, text=True) as cargo:
        limit = threading.Timer(BUILD_LIMIT_S, cargo.kill)
        limit.start()
        try:
            assert cargo.stderr is not None  # a pipe
            for text in cargo.stderr:
                print(text, end="", file=sys.stderr, flush=True)
                compiled += text.lstrip().startswith("Compiling ")
                now = time.monotonic()
                if terminal and compiled and now - said >= PROGRESS_S:
                    said = now
                    hint = "a first build takes 4 to 10 minutes on two cores"
                    message = f"\ntrabecula: {compiled} crates after {now - began:.0f} s ({hint})"
                    print(message, file=terminal, flush=True)
        finally:
            limit.cancel()
            if terminal:
                terminal.close()
    if cargo.returncode != 0:
        raise subprocess.CalledProcessError(cargo.returncode, line)


def _stripped(path: Path) -> bytes:
    """Strips line tables and symbols, nine tenths of a program's file."""
    with tempfile.TemporaryDirectory() as folder:
        small = Path(folder) / path.name
        subprocess.run(["strip", "-o", str(small), str(path)], check=True, timeout=LIMIT_S)
        return small.read_bytes()


def _metadata(licences: list[str]) -> str:
    project = _project()
    lines = [
        "Metadata-Version: 2.4",
        f"Name: {project['name']}",
        f"Version: {_version()}",
        f"Summary: {project['description']}",
        f"License-Expression: {project['license']}",
        *(f"License-File: {file}" for file in licences),
        *(f"Classifier: {classifier}" for classifier in project["classifiers"]),
        f"Requires-Python: {project['requires-python']}",
        *(f"Requires-Dist: {requirement}" for requirement in project["dependencies"]),
    ]
    for extra, requirements in project["optional-dependencies"].items():
        lines.append(f"Provides-Extra: {extra}")
        lines += [f"Requires-Dist: {wanted}; extra == '{extra}'" for wanted in requirements]
    lines += ["Description-Content-Type: text/markdown", "", (ROOT / project["readme"]).read_text()]
    return "\n".join(lines)


#: Prefixes of the names of licence and notice files, in lower case.
NOTICES = ("license", "licence", "copying", "copyright", "notice", "unlicense", "ofl", "ufl")


def _third_party() -> str:
    """Returns licences and notices of every crate linked into the binaries, as found in its package; each
    text once.

    Uses `cargo metadata` for this machine's platform: the normal dependencies of the three packages, without
    those of other systems, of tests and of builds. A crate without a licence file is listed with its licence,
    authors and source.
    """
    platform = f"--filter-platform={os.uname().machine}-unknown-linux-gnu"
    line = ["cargo", "metadata", "--locked", "--format-version=1", platform]
    said = json.loads(subprocess.run(line, cwd=ROOT, check=True, capture_output=True, timeout=LIMIT_S).stdout)
    packages = {package["id"]: package for package in said["packages"]}
    needs = {
        node["id"]: [
            other["pkg"]
            for other in node["deps"]
            if any(kind["kind"] is None for kind in other["dep_kinds"])
        ]
        for node in said["resolve"]["nodes"]
    }
    own = {binary.package for binary in [*LIBRARIES, PROGRAM]}
    linked, new = set(), [package["id"] for package in said["packages"] if package["name"] in own]
    while new:
        if (crate := new.pop()) not in linked:
            linked.add(crate)
            new += needs[crate]
    crates = sorted(
        (packages[crate] for crate in linked if packages[crate]["source"]),
        key=lambda crate: (crate["name"], crate["version"]),
    )
    texts: dict[str, list[str]] = {}
    heading = "Third-party software in the binaries of Trabecula: crate, licence, authors, source."
    lines = [f"{heading} The texts follow.", ""]
    for crate in crates:
        licence = crate["license"] or (crate["license_file"] and "see below")
        if not licence:
            raise ValueError(f"crate {crate['name']} {crate['version']} states no licence")
        named = f"{crate['name']} {crate['version']}"
        authors = ", ".join(crate["authors"]) or "authors not stated"
        lines.append(f"{named}: {licence}; {authors}; {crate['repository'] or 'crates.io'}")
        folder = Path(crate["manifest_path"]).parent
        for file in sorted([*folder.glob("*"), *folder.glob("*/*")]):
            is_text = file.suffix.lower() in ("", ".md", ".txt", ".apache", ".mit")
            if file.name.lower().startswith(NOTICES) and is_text and file.is_file():
                text = file.read_text(errors="replace").strip()
                texts.setdefault(text, []).append(f"{named}, {file.relative_to(folder)}")
    for text, places in texts.items():
        lines += ["", "=" * 100, *places, "", text]
    return "\n".join(lines) + "\n"


def _write_wheel(path: Path, files: dict[str, tuple[bytes, int]], record: str) -> None:
    lines = []
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as wheel:
        for name, (content, mode) in files.items():
            digest = base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
            lines.append(f"{name},sha256={digest},{len(content)}\n")
            entry = zipfile.ZipInfo(name, EPOCH)
            entry.external_attr = (0o100000 | mode) << 16
            wheel.writestr(entry, content, zipfile.ZIP_DEFLATED)
        wheel.writestr(zipfile.ZipInfo(record, EPOCH), "".join(lines) + f"{record},,\n", zipfile.ZIP_DEFLATED)


def build_wheel(wheel_directory, config_settings=None, metadata_directory=None):
    """PEP 517: builds the wheel with the sources, the libraries and the program."""
    name = f"trabecula-{_version()}"
    info, data = f"{name}.dist-info", f"{name}.data"
    platform = (config_settings or {}).get("platform") or re.sub(r"[-.]", "_", sysconfig.get_platform())
    sources = [path for path in sorted((HERE / "trabecula").glob("*.py*")) if path.is_file()]
    sources.append(HERE / "trabecula/py.typed")
    files = {f"trabecula/{path.name}": (path.read_bytes(), 0o644) for path in sources}
    shipped = [file for file in _source_files() if file.startswith(SHIPPED)]
    files.update({f"trabecula/files/{file}": ((ROOT / file).read_bytes(), 0o644) for file in shipped})
    for binary, path in _binaries().items():
        files[binary.place.format(data=data)] = (_stripped(path), binary.mode)
    wheel = f"Wheel-Version: 1.0\nGenerator: trabecula\nRoot-Is-Purelib: false\nTag: {TAG}-{platform}\n"
    files[f"{info}/METADATA"] = (_metadata([*_project()["license-files"], THIRD_PARTY]).encode(), 0o644)
    files[f"{info}/WHEEL"] = (wheel.encode(), 0o644)
    for file in _project()["license-files"]:
        files[f"{info}/licenses/{file}"] = ((ROOT / file).read_bytes(), 0o644)
    files[f"{info}/licenses/{THIRD_PARTY}"] = (_third_party().encode(), 0o644)
    file = f"{name}-{TAG}-{platform}.whl"
    _write_wheel(Path(wheel_directory) / file, files, f"{info}/RECORD")
    return file


def _source_files() -> list[str]:
    """Returns the source files: those known to git, or, in an unpacked sdist, all except cargo's output."""
    if (ROOT / ".git").exists():
        line = ["git", "ls-files", "-z"]
        git = subprocess.run(line, cwd=ROOT, check=True, capture_output=True, timeout=LIMIT_S)
        return [name for name in git.stdout.decode().split("\0") if name and (ROOT / name).is_file()]
    found = []
    for folder, folders, names in os.walk(ROOT):
        is_root = Path(folder) == ROOT
        left_out = ("__pycache__", ".venv", "target", "out") if is_root else ("__pycache__", ".venv")
        folders[:] = [name for name in folders if name not in left_out]
        own = [name for name in names if not (name == "PKG-INFO" and is_root)]
        found += [str((Path(folder) / name).relative_to(ROOT)) for name in own]
    return sorted(found)


def build_sdist(sdist_directory, config_settings=None):
    """PEP 517: builds the sdist with the whole workspace, because program and libraries are built from it."""
    name = f"trabecula-{_version()}"
    path = Path(sdist_directory) / f"{name}.tar.gz"
    contents = [("PKG-INFO", _metadata(_project()["license-files"]).encode(), 0o644)]
    for file in _source_files():
        mode = 0o755 if os.access(ROOT / file, os.X_OK) else 0o644
        contents.append((file, (ROOT / file).read_bytes(), mode))
    # Fixed times, so that the same sources give the same file.
    with open(path, "wb") as raw, gzip.GzipFile("", "wb", mtime=0, fileobj=raw) as packed:
        with tarfile.open(fileobj=packed, mode="w", format=tarfile.PAX_FORMAT) as archive:
            for file, content, mode in contents:
                entry = tarfile.TarInfo(f"{name}/{file}")
                entry.size, entry.mode = len(content), mode
                archive.addfile(entry, io.BytesIO(content))
    return path.name
