"""Creates docs/pictures/viewer.png: the page of a live run of the default scene.

From the repository's root, after `cargo build --release` and `cargo test --release --test browser`,
which creates the environment:

    target/tmp/browser-1.65.2/bin/python3 tests/browser/pictures.py
"""

import io
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import page
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = ROOT / "target/release/trabecula"
SCENE = ROOT / "configs/femur_curved_drilling.toml"
SIZE = {"width": 1440, "height": 900}
# Simulated time at which the burr is well inside the head, and the bend nearly complete.
SHOWN_AT_S = 17.5
# The page draws in software, on the cores that the run needs: at half speed it gets every message. It pauses
# by itself, because a question from outside may come too late.
SLOWLY = """(seconds) => {
    const control = (request) => trabecula.call("/control", request);
    const look = () => trabecula.model.time >= seconds ? control({ action: "pause" }) : setTimeout(look, 20);
    control({ action: "speed", speed: 0.5 }).then(look);
}"""
LIMIT_BYTES = 400_000


def said(program: subprocess.Popen, what: str, pattern: str) -> str:
    """Returns the first group of the first matching line that a program prints; the program ends eventually."""
    for line in program.stdout:
        if found := re.search(pattern, line):
            return found[1]
    raise SystemExit(f"a program ended without its {what}")


def picture(url: str) -> Image.Image:
    """Takes a picture of the page when the simulation has reached the moment to show."""
    with page.browser(ROOT / "target/tmp") as browser:
        # Software rendering, of the surface that a graphics card would show.
        shown = page.Page(browser, f"{url}&surface=fine", SIZE)
        shown.until("it runs", lambda: shown.number("tick") > 0)
        shown.page.evaluate(SLOWLY, SHOWN_AT_S)
        shown.until("the moment to show", lambda: shown.text("phase") == "Paused", 600.0)
        shown.page.evaluate("document.activeElement.blur()")
        shown.page.mouse.move(0, 0)
        shown.until("the surface is there", lambda: shown.page.evaluate("trabecula.view.surface.triangles > 0"))
        shown.still()
        shown.clean()
        return Image.open(io.BytesIO(shown.page.screenshot())).convert("RGB")


def main() -> None:
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs/pictures/viewer.png"
    with tempfile.TemporaryDirectory() as folder:
        started = []

        def start(*arguments: str | Path) -> subprocess.Popen:
            started.append(subprocess.Popen([PROGRAM, *arguments], stdout=subprocess.PIPE, text=True))
            return started[-1]

        try:
            # The browser renders in software, on the cores that the run needs.
            run = start("run", SCENE, "--set", 'run.policy="fifo"', "--output", folder, "--images", "none", "--quiet")
            session = said(run, "session", r"^session\s+(\S+)")
            view = start("view", "--session", session, "--port", "0", "--no-open", "--page-folder", ROOT / "crates/viewer_proc/page")
            shown = picture(said(view, "address", r"(http://\S+#token=\S+)"))
        finally:
            for process in reversed(started):
                process.terminate()
                process.wait()
    # Few colours: a palette keeps text and lines sharp in a small file.
    shown.quantize(256, dither=Image.Dither.NONE).save(out, optimize=True)
    size = out.stat().st_size
    assert size < LIMIT_BYTES, f"{out} has {size} bytes, more than {LIMIT_BYTES}"
    print(f"{out} {size} bytes")


if __name__ == "__main__":
    main()
