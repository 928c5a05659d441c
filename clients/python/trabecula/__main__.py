"""Prints a folder of the installation, for copying from and for compilers.

    python3 -m trabecula            # scenes, examples, headers and documentation, as in a checkout
    python3 -m trabecula library    # libtrabecula_client.so
"""

from __future__ import annotations

import argparse
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[2]


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python3 -m trabecula",
        description="Prints a folder of the installation. Simulations and logs: the program `trabecula`.",
    )
    text = "files: scenes, examples, headers, documentation; library: libtrabecula_client.so"
    parser.add_argument("folder", nargs="?", choices=["files", "library"], default="files", help=text)
    wants_library = parser.parse_args().folder == "library"
    # In an installed package; else in a checkout, built by cargo.
    if (HERE / "files").exists():
        print(HERE if wants_library else HERE / "files")
    else:
        print(ROOT / "target" / "release" if wants_library else ROOT)


if __name__ == "__main__":
    main()
