"""Checks of the page of a live run whose controller is the page itself."""

import os
import signal
import time
from pathlib import Path

from page import BURR_PIXELS, Page, count, is_burr, is_link
from playwright.sync_api import Browser


def connects(page: Page) -> None:
    page.until("the page connects", lambda: page.text("phase") == "Running" and page.number("tick") > 0)
    before = page.number("tick")
    page.until("ticks go on", lambda: page.number("tick") > before)
    page.until("parts are listed", lambda: "physics" in page.text("parts"))


def shows_the_tool(page: Page) -> None:
    page.until("the poses come", lambda: page.page.evaluate("trabecula.view.pictures > 3 && !!trabecula.model.poses"))
    picture = page.picture("scene-canvas")
    burr, links = count(picture, is_burr), count(picture, is_link)
    # At the distance at which the page begins the burr is some ten pixels across, and the links are ten times as long.
    assert burr > BURR_PIXELS, f"{burr} pixels of the burr"
    assert links > 3 * BURR_PIXELS, f"{links} pixels of the links"


def shows_bone(page: Page) -> None:
    page.until("the surface comes", lambda: page.page.evaluate("trabecula.view.surface.triangles > 100"))
    shown = page.picture("scene-canvas")
    page.page.evaluate("document.activeElement.blur()")
    for _ in range(3):
        page.page.keyboard.press("b")
    assert page.text("bone-mode") == "Bone: hidden"
    before = shown.tobytes()
    page.until("the bone vanishes", lambda: sum(a != b for a, b in zip(before, page.picture("scene-canvas").tobytes())) > 3000)
    page.page.keyboard.press("b")


def frames_update(page: Page) -> None:
    page.until("a frame comes", lambda: page.text("frame-facts").startswith("frame "))
    first = page.text("frame-facts")
    page.until("the next frame comes", lambda: page.text("frame-facts") != first)
    # Scheduled frames follow at once, so every frame is noted as it comes.
    page.page.evaluate("""(() => { const { model } = trabecula; const take = model.takeFrame.bind(model); window.angles = [];
        model.takeFrame = (...message) => { take(...message); window.angles.push(model.frame.primary); }; })()""")
    page.page.fill("#c-arm-primary", "40")
    page.page.click("text=Take frame")
    page.until("the frame at the angle that was asked for", lambda: page.page.evaluate("angles.some((angle) => Math.abs(angle - 0.6981317) < 1e-3)"))
    values = set(page.picture("x-ray-canvas").convert("L").tobytes())
    assert len(values) > 20, f"the X-ray has {len(values)} greys"


def pauses_and_steps(page: Page) -> None:
    page.page.click("#pause")
    page.until("pause", lambda: page.text("phase") == "Paused")
    page.until("the last state is shown", lambda: page.number("tick") > 0)
    time.sleep(0.3)
    stood = page.number("tick")
    time.sleep(0.7)
    assert page.number("tick") == stood, "ticks go on although the run is paused"
    page.page.click("text=Step")
    page.until("one tick", lambda: page.number("tick") == stood + 1)
    page.page.click("#pause")
    page.until("it goes on", lambda: page.text("phase") == "Running" and page.number("tick") > stood + 1)


def drives(page: Page) -> None:
    page.page.evaluate("document.activeElement.blur()")
    page.page.keyboard.press("e")
    page.until("the page drives", lambda: page.text("drive-switch") == "Let go")
    before = page.value("Tension")
    page.page.keyboard.down("d")
    page.until("the key pulls the tendon", lambda: page.value("Tension") > before + 1.0)
    page.page.keyboard.up("d")
    page.page.keyboard.press("q")
    page.until("the burr turns", lambda: page.value("Burr speed") > 1000)
    inserted = "trabecula.model.poses.base.position"
    start = page.page.evaluate(inserted)
    page.page.keyboard.down("w")
    moved = lambda: sum((a - b) ** 2 for a, b in zip(page.page.evaluate(inserted), start)) ** 0.5
    page.until("the key inserts the tool", lambda: moved() > 0.0005)
    page.page.keyboard.up("w")
    page.page.keyboard.press("q")
    page.until("the burr stands", lambda: page.value("Burr speed") < 10)
    page.page.keyboard.press("e")


def works_with_keys_alone(page: Page) -> None:
    """The Tab key reaches every control, each shows that it has the focus, and help, pause and reset need no pointer."""
    page.page.evaluate("document.activeElement.blur()")
    wanted = set(page.page.evaluate(
        "[...document.querySelectorAll('button, select, input, canvas[tabindex]')].filter((e) => e.offsetParent && !e.disabled)"
        ".map((e) => e.id || e.textContent.trim())"))
    reached = set()
    for _ in range(len(wanted) + 12):
        page.page.keyboard.press("Tab")
        name, outline = page.page.evaluate(
            "(() => { const e = document.activeElement; return [e.id || e.textContent.trim(), getComputedStyle(e).outlineStyle]; })()")
        if name in wanted:
            assert outline not in ("none", ""), f"{name} does not show that it has the focus"
        reached.add(name)
    assert wanted <= reached, f"the Tab key does not reach {wanted - reached}"
    page.page.evaluate("document.activeElement.blur()")
    page.page.keyboard.press("?")
    page.until("help", lambda: page.page.locator("#help").is_visible() and "slacken the tendon" in page.page.inner_text("body") or
               "pause, go on" in page.text("help"))
    page.page.keyboard.press("Escape")
    # Keys are for the help as long as it is open.
    page.until("the help is gone", lambda: page.page.evaluate("!document.querySelector('dialog[open]') && !document.activeElement.closest('dialog')"))
    page.page.keyboard.press("Space")
    page.until("Space pauses", lambda: page.text("phase") == "Paused")
    page.page.keyboard.press("Space")
    page.until("Space goes on", lambda: page.text("phase") == "Running")
    unnamed = page.page.evaluate(
        "[...document.querySelectorAll('button, select, input')].filter((e) => !(e.textContent.trim() || e.ariaLabel || e.labels?.length))"
        ".map((e) => e.outerHTML)")
    assert not unnamed, f"controls without a name: {unnamed}"


def light_and_dark(page: Page) -> None:
    theme = "document.documentElement.dataset.theme"
    assert page.page.evaluate(theme) == "light"
    page.page.emulate_media(color_scheme="dark")
    page.until("the page follows the system", lambda: page.page.evaluate(theme) == "dark")
    page.page.keyboard.press("t")
    page.until("the key changes it", lambda: page.page.evaluate(theme) == "light")


def reads_only_without_token(browser: Browser, url: str) -> None:
    """A page without the token watches; this one has no WebGL either."""
    page = Page(browser, url.split("#")[0], before="""
        const original = HTMLCanvasElement.prototype.getContext;
        HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
          return kind === "webgl2" ? null : original.call(this, kind, ...more);
        };""")
    page.until("it connects", lambda: page.text("phase") == "Running")
    page.page.click("#pause")
    page.until("it says why it does not control", lambda: "Read only" in page.text("notices"))
    assert page.text("phase") == "Running"
    assert "No 3D view" in page.text("banner"), page.text("banner")
    page.until("the X-ray is shown all the same", lambda: page.text("frame-facts").startswith("frame "))
    page.clean()
    page.page.close()


def says_that_the_hub_died(page: Page, victim: int) -> None:
    page.clean()
    os.kill(victim, signal.SIGKILL)
    page.until("a banner", lambda: page.page.locator("#banner").is_visible() and page.text("banner") != "", 30.0)
    said = page.text("banner").lower()
    assert any(word in said for word in ("ended", "gone", "died", "not connected")), said


def check(browser: Browser, url: str, victim: int, pictures: Path) -> None:
    """All checks on one page, in turn."""
    page = Page(browser, url)
    for one in (connects, shows_the_tool, shows_bone, frames_update, pauses_and_steps, drives):
        _run(one, page)
    page.save(pictures / "live.png")
    for one in (works_with_keys_alone, light_and_dark):
        _run(one, page)
    reads_only_without_token(browser, url)
    print("ok reads_only_without_token", flush=True)
    says_that_the_hub_died(page, victim)
    page.save(pictures / "hub_died.png")
    print("ok says_that_the_hub_died", flush=True)


def _run(one, page: Page) -> None:
    start = time.monotonic()
    one(page)
    print(f"ok {one.__name__} {time.monotonic() - start:.1f} s", flush=True)
