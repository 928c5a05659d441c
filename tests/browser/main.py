"""Runs the checks of one kind against a running viewer: `main.py live|end|log|two|plan|arm --url URL …`.

Exit code 77: Chromium is not available; what was tried is printed.
"""

import argparse
import sys
from pathlib import Path

import arm
import chromium
import live
import log
import page
import plan

SKIPPED = 77


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kind", choices=["live", "end", "log", "two", "plan", "arm"])
    parser.add_argument("--url", required=True)
    parser.add_argument("--cache", type=Path, required=True, help="where a Chromium is kept")
    parser.add_argument("--pictures", type=Path, required=True, help="where screenshots go")
    parser.add_argument("--victim", type=int, help="process whose death the page must notice")
    parser.add_argument("--scene", type=Path, help="file of the scene that is shown before its run")
    arguments = parser.parse_args()
    arguments.pictures.mkdir(parents=True, exist_ok=True)
    try:
        with page.browser(arguments.cache) as browser:
            if arguments.kind == "live":
                live.check(browser, arguments.url, arguments.victim, arguments.pictures)
            elif arguments.kind == "end":
                live.check_end(browser, arguments.url, arguments.pictures)
            elif arguments.kind == "plan":
                plan.check(browser, arguments.url, arguments.scene, arguments.pictures)
            elif arguments.kind == "arm":
                arm.check(browser, arguments.url, arguments.pictures)
            elif arguments.kind == "log":
                log.check(browser, arguments.url, arguments.pictures)
            else:
                log.check_two(browser, arguments.url, arguments.pictures)
    except chromium.NoChromium as reason:
        print(reason, file=sys.stderr)
        return SKIPPED
    return 0


if __name__ == "__main__":
    sys.exit(main())
