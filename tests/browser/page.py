"""Helpers shared by the checks: a browser, one page, and ways to inspect it."""

import io
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import chromium
from PIL import Image
from playwright.sync_api import Browser, sync_playwright
from playwright.sync_api import Page as BrowserPage

# Allows for a software renderer on a shared machine; only a failure reaches it.
LIMIT_S = 40.0
SIZE = {"width": 1100, "height": 760}
# Minimum number of pixels of a visible burr: a third of its disc.
BURR_PIXELS = 30


@contextmanager
def browser(cache: Path) -> Iterator[Browser]:
    """A headless Chromium."""
    program, environment = chromium.executable(cache)
    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=program, args=chromium.FLAGS, env=environment)
        try:
            yield started
        finally:
            started.close()


class Page:
    """The viewer's page; records console errors and requests to other servers."""

    def __init__(self, browser: Browser, url: str, size: dict[str, int] = SIZE, before: str = "") -> None:
        self.errors: list[str] = []
        self.strangers: list[str] = []
        self.host = urlsplit(url).netloc
        self.page: BrowserPage = browser.new_page(viewport=size, color_scheme="light")
        self.page.set_default_timeout(LIMIT_S * 1000)
        self.page.on("console", lambda message: self.errors.append(message.text) if message.type == "error" else None)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", lambda request: self._host(request.url))
        self.page.on("websocket", lambda socket: self._host(socket.url))
        if before:
            self.page.add_init_script(before)
        self.page.goto(url)

    def _host(self, url: str) -> None:
        if urlsplit(url).netloc != self.host:
            self.strangers.append(url)

    def text(self, place: str) -> str:
        return self.page.inner_text(f"#{place}")

    def number(self, place: str) -> float:
        """Returns the first number of a readout; -1 before there is one."""
        first = self.text(place).split()[0].rstrip("%°×")
        return float(first) if first.replace(".", "").replace("-", "").isdigit() else -1.0

    def settled(self, read: Callable[[], object]) -> object:
        """Waits until a value has not changed for a second, so that earlier requests have been answered; returns it."""
        seen, since = read(), time.monotonic()
        end = since + LIMIT_S
        while time.monotonic() - since < 1.0:
            assert time.monotonic() < end, f"still changing after {LIMIT_S:.0f} s, now {str(seen)[:200]}"
            time.sleep(0.05)
            if (now := read()) != seen:
                seen, since = now, time.monotonic()
        return seen

    def still(self) -> None:
        """Waits until the 3D view is drawn and no longer changes."""
        self.until("the picture", lambda: not self.page.evaluate("trabecula.view.busy"))
        self.settled(lambda: self.page.evaluate("[trabecula.view.pictures, trabecula.view.surface.triangles]"))

    def value(self, plot: str, which: int = 0) -> float:
        """Returns a plot's newest value, as shown in its heading."""
        values = self.page.locator(".plot", has_text=plot).locator(".value").all_inner_texts()
        return float(values[which])

    def until(self, what: str, holds: Callable[[], bool], limit_s: float = LIMIT_S) -> None:
        """Waits for a condition; the error names it."""
        end = time.monotonic() + limit_s
        while not holds():
            if time.monotonic() > end:
                raise AssertionError(f"{what}: not within {limit_s:.0f} s; phase {self.text('phase')}, tick {self.text('tick')}, "
                                     f"banner {self.text('banner')!r}, messages {self.text('notices')[:400]!r}")
            time.sleep(0.05)

    def picture(self, place: str) -> Image.Image:
        """Returns an element's picture, without the tools over the 3D view."""
        overlays = "for (const e of document.querySelectorAll('.scene-tools, #gizmo, #scale-bar')) e.hidden = {}"
        self.page.evaluate(overlays.format("true"))
        try:
            return self._picture(place)
        finally:
            self.page.evaluate(overlays.format("false"))

    def _picture(self, place: str) -> Image.Image:
        return Image.open(io.BytesIO(self.page.locator(f"#{place}").screenshot())).convert("RGB")

    def save(self, path: Path) -> None:
        self.page.screenshot(path=path)

    def clean(self) -> None:
        """Asserts that there was no console error and no request to another server."""
        assert not self.errors, f"errors on the console: {self.errors}"
        assert not self.strangers, f"requests to others than {self.host}: {self.strangers}"


def count(picture: Image.Image, matches: Callable[[int, int, int], bool]) -> int:
    """Counts the pixels of a kind."""
    pixels = picture.tobytes()
    return sum(matches(*pixels[i : i + 3]) for i in range(0, len(pixels), 3))


def is_burr(red: int, green: int, blue: int) -> bool:
    """Matches the burr's orange in any light."""
    return red > 110 and red > 1.6 * green and green > 1.2 * blue


def is_link(red: int, green: int, blue: int) -> bool:
    """Matches the links' blues in any light; nothing else in the scene is that blue."""
    return blue > 60 and blue > 1.5 * red and green > 1.2 * red


def middle(picture: Image.Image, matches: Callable[[int, int, int], bool]) -> tuple[float, float]:
    """Returns the mean position of the pixels of a kind."""
    pixels, width = picture.tobytes(), picture.width
    places = [(i // 3 % width, i // 3 // width) for i in range(0, len(pixels), 3) if matches(*pixels[i : i + 3])]
    assert places, "no such pixel"
    return sum(x for x, _ in places) / len(places), sum(y for _, y in places) / len(places)
