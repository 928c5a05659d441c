"""Checks the page of a live run whose controller is the page itself."""

import os
import signal
import time
from pathlib import Path

import slices
from page import BURR_PIXELS, Page, count, is_burr, is_link
from playwright.sync_api import Browser


# Notes when the first picture with bone has been rendered, in milliseconds since the page was requested.
FIRST_BONE = """const seek = setInterval(() => {
        const view = window.trabecula?.view;
        if (!view || view.surface.triangles === 0) return;
        const drawn = (window.drawn ??= view.pictures);
        if (view.pictures === drawn || view.busy) return;
        window.firstBone = performance.now();
        clearInterval(seek);
    }, 5);"""


def connects(page: Page) -> None:
    page.until("the page connects", lambda: page.text("phase") == "Running" and page.number("tick") > 0)
    before = page.number("tick")
    page.until("ticks go on", lambda: page.number("tick") > before)
    page.until("a clearance comes", lambda: page.text("clearance-rows").split()[0::2] == ["nerve", "mm", "mm"])
    page.until("parts are listed", lambda: "physics" in page.text("parts"))


def shows_the_tool(page: Page) -> None:
    page.until("the poses come", lambda: page.page.evaluate("trabecula.view.pictures > 3 && !!trabecula.model.poses"))
    picture = page.picture("scene-canvas")
    burr, links = count(picture, is_burr), count(picture, is_link)
    # At the page's initial distance the burr is some ten pixels across, and the links are ten times as long.
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
    values = set(page.picture("x-ray-canvas").convert("L").tobytes())
    assert len(values) > 20, f"the X-ray has {len(values)} greys"


def holds_the_frame_that_was_asked_for(page: Page) -> None:
    """Scheduled frames follow immediately; a requested one stays until the user returns to them."""
    assert not page.page.locator("#x-ray-live").is_visible()
    page.page.fill("#c-arm-primary", "40")
    page.page.click("text=Take frame")
    page.until("the frame that was asked for", lambda: page.text("frame-facts").startswith("requested, held"))
    held = page.text("frame-facts")
    assert ", 40.0° / " in held, held
    newest = "trabecula.model.frame.sequence"
    # The picture follows the text once the 3D view is rendered.
    shown = page.settled(lambda: page.picture("x-ray-canvas").tobytes())
    sequence = page.page.evaluate(newest)
    page.until("scheduled frames go on", lambda: page.page.evaluate(newest) > sequence + 1)
    assert page.text("frame-facts") == held
    assert page.picture("x-ray-canvas").tobytes() == shown, "a scheduled frame replaced the one that was asked for"
    page.page.click("#x-ray-live")
    page.until("the live frames", lambda: page.text("frame-facts").startswith("frame ") and ", 40.0°" not in page.text("frame-facts"))
    page.until("the picture of a live frame", lambda: page.picture("x-ray-canvas").tobytes() != shown)
    assert not page.page.locator("#x-ray-live").is_visible()


def pauses_and_steps(page: Page) -> None:
    page.page.click("#pause")
    page.until("pause", lambda: page.text("phase") == "Paused")
    stood = page.settled(lambda: page.number("tick"))
    assert page.page.evaluate("trabecula.model.status.tick") == stood, "the page does not show the tick at which the run stands"
    page.page.click("text=Step")
    page.until("one tick", lambda: page.number("tick") == stood + 1)
    page.page.click("#pause")
    page.until("it goes on", lambda: page.text("phase") == "Running" and page.number("tick") > stood + 1)


def drives(page: Page) -> None:
    page.page.evaluate("document.activeElement.blur()")
    page.page.keyboard.press("e")
    page.until("the page drives", lambda: page.text("drive-switch") == "Release control")
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


# Commanded by the gamepad only, and searched for in the log afterwards.
GAMEPAD_RPM = 6500
# A pad that does nothing, with the buttons and axes of the standard mapping.
PAD = """window.pad = { connected: true, id: "Test pad", axes: [0, 0, 0, 0], buttons: Array.from({ length: 17 }, () => ({ pressed: false, value: 0 })) };
    navigator.getGamepads = () => [null, window.pad];
    window.dispatchEvent(Object.assign(new Event("gamepadconnected"), { gamepad: window.pad }));"""


def drives_by_gamepad(page: Page) -> None:
    """Sticks and trigger of a gamepad pull the tendon, feed, and run the burr; A pauses."""
    page.page.evaluate(PAD)
    assert "Test pad" in page.text("gamepad")
    page.page.evaluate("document.activeElement.blur()")
    page.page.keyboard.press("e")
    page.until("the page drives", lambda: page.text("drive-switch") == "Release control")
    page.page.evaluate(f"trabecula.drive.set({{ burrRpm: {GAMEPAD_RPM} }})")
    before = page.value("Tension")
    page.page.evaluate("pad.axes[3] = -1")
    page.until("the right stick pulls the tendon", lambda: page.value("Tension") > before + 1.0)
    page.page.evaluate("pad.axes[3] = 0.05")
    page.page.evaluate("pad.buttons[7] = { pressed: true, value: 1 }")
    page.until("the trigger runs the burr", lambda: abs(page.value("Burr speed") - GAMEPAD_RPM) < 100)
    base = "trabecula.model.poses.base.position"
    start = page.page.evaluate(base)
    page.page.evaluate("pad.axes[1] = 1")
    moved = lambda: sum((a - b) ** 2 for a, b in zip(page.page.evaluate(base), start)) ** 0.5
    page.until("the left stick retracts the tool", lambda: moved() > 0.0003)
    page.page.evaluate("pad.axes[1] = 0")
    page.page.evaluate("pad.buttons[7] = { pressed: false, value: 0 }")
    page.until("the burr stands", lambda: page.value("Burr speed") < 10)
    for phase in ("Paused", "Running"):
        page.page.evaluate("pad.buttons[0] = { pressed: true, value: 1 }")
        page.until(f"the button A: {phase}", lambda: page.text("phase") == phase)
        page.page.evaluate("pad.buttons[0] = { pressed: false, value: 0 }")
        page.until("the button is up", lambda: page.page.evaluate("trabecula.drive.padPause === false"))
    page.page.keyboard.press("e")
    page.until("the page lets go", lambda: page.text("drive-switch") != "Release control")
    page.page.evaluate("window.pad = null")


def holds_a_speed(page: Page) -> None:
    """A speed below real time: the page shows that the run continues more slowly, and Pause stops it."""
    page.page.select_option("#speed", "0.1")
    page.until("it is said", lambda: page.text("phase") == "Running at 0.1 ×")
    page.until("time goes slower", lambda: 0.0 < page.number("rate") < 0.3)
    page.page.click("#pause")
    page.until("pause", lambda: page.text("phase") == "Paused")
    stood = page.settled(lambda: page.number("tick"))
    page.page.click("#pause")
    page.until("the speed is held again", lambda: page.text("phase") == "Running at 0.1 ×" and page.number("tick") > stood)
    page.page.select_option("#speed", "1")
    page.until("its own speed", lambda: page.text("phase") == "Running")


def costs_little(page: Page) -> None:
    """Measures the time to the first picture with bone, and the page's script time while the run continues at full rate, with
    and without slices. Nothing is asserted, because the figures depend on the machine."""
    page.until("the first picture with bone is noted", lambda: page.page.evaluate("window.firstBone > 0"))
    print(f"first picture with bone {page.page.evaluate('window.firstBone') / 1000:.2f} s after the page was requested; load average "
          f"{os.getloadavg()[0]:.1f}", flush=True)
    for slices_are in ("with slices", "without slices"):
        figures = page.page.evaluate("""async () => {
            const { work, view, connection, slices } = trabecula;
            let [messages, milliseconds, began, first, drawn] = [0, 0, performance.now(), view.pictures, slices.pictures];
            const took = connection.took;
            connection.took = (one) => (took(one), (messages += 1), (milliseconds += one));
            work.times = [];
            await new Promise((done) => setTimeout(done, 3000));
            connection.took = took;
            const seconds = (performance.now() - began) / 1000;
            return { pictures: (view.pictures - first) / seconds, drawn: work.times.length / seconds, median: work.quantile(0.5),
                p95: work.quantile(0.95), messages: messages / seconds, share: milliseconds / seconds / 10, triangles: view.surface.triangles,
                slices: (slices.pictures - drawn) / seconds, software: view.software, ratio: view.detail.ratio };
        }""")
        print("page {}: script {median:.2f} ms a picture (p95 {p95:.2f}), {share:.1f} % of the time for {messages:.0f} messages/s; {drawn:.0f} "
              "pictures/s of which {pictures:.0f} with the 3D view and {slices:.0f} with slices, {triangles} triangles, drawn by the processor: "
              "{software}, with {ratio:.2f} of the pixels along a side".format(slices_are, **figures), flush=True)
        page.page.evaluate("trabecula.slices.toggle()")


def works_with_keys_alone(page: Page) -> None:
    """The Tab key reaches every control, each shows its focus, and help, pause and reset need no pointer."""
    page.page.evaluate("document.activeElement.blur()")
    controls = page.page.evaluate(
        "[...document.querySelectorAll('button, select, input, canvas[tabindex]')].filter((e) => e.offsetParent && !e.disabled)"
        ".map((e) => e.id || e.textContent.trim())")
    wanted, reached = set(controls), set()
    # A full turn: also the menus, links and the browser's own controls.
    for _ in range(len(controls) + 24):
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
               "pause, resume" in page.text("help"))
    page.page.keyboard.press("Escape")
    # While the help is open, it receives the keys.
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


def shows_nothing_without_token(browser: Browser, url: str) -> None:
    """A page without the token reports that, and shows nothing of the run."""
    page = Page(browser, url.split("#")[0])
    page.until("it says why", lambda: "missing or wrong token" in page.text("banner"))
    assert page.text("phase") == "Not connected", page.text("phase")
    assert not page.text("frame-facts").startswith("frame "), page.text("frame-facts")
    page.clean()
    page.page.close()


def shows_the_x_ray_without_webgl(browser: Browser, url: str) -> None:
    """A browser without WebGL shows everything but the 3D view."""
    page = Page(browser, url, before="""
        const original = HTMLCanvasElement.prototype.getContext;
        HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
          return kind === "webgl2" ? null : original.call(this, kind, ...more);
        };""")
    page.until("it connects", lambda: page.text("phase") == "Running")
    assert "No 3D view" in page.text("banner"), page.text("banner")
    page.until("the X-ray is shown all the same", lambda: page.text("frame-facts").startswith("frame "))
    page.clean()
    page.page.close()


def says_that_the_hub_died(page: Page, victim: int) -> None:
    page.clean()
    os.kill(victim, signal.SIGKILL)
    page.until("a banner", lambda: page.page.locator("#banner").is_visible() and page.text("banner") != "", 30.0)
    said = page.text("banner").lower()
    assert any(word in said for word in ("gone", "died", "not connected")), said
    assert page.text("phase") != "Paused", "the page shows the log, as if the run had come to its end"


# Records every text of the phase, and every banner, from now on.
WATCH = """window.seen = [];
    new MutationObserver(() => {
      const banner = document.getElementById("banner");
      const now = document.getElementById("phase").textContent + (banner.hidden ? "" : ` | ${banner.className}: ${banner.textContent}`);
      if (window.seen.at(-1) !== now) window.seen.push(now);
    }).observe(document.body, { subtree: true, childList: true, characterData: true, attributes: true });"""


def check_end(browser: Browser, url: str, pictures: Path) -> None:
    """After a run ends, the page shows the time line of its log; nothing turns red in the meantime."""
    page = Page(browser, url)
    connects(page)
    page.until("its plots", lambda: page.number("tick") > 300)
    page.page.evaluate(WATCH)
    page.page.click("button[data-action=stop]")
    page.page.click("#confirm button[value=yes]")
    page.until("the log's time line", lambda: page.page.locator("#time-line").is_visible() and " of " in page.text("playback-time"))
    page.until("it stands at a time of the log", lambda: page.text("phase") == "Paused" and not page.page.locator("#banner").is_visible())
    page.until("its plots are the log's", lambda: page.page.evaluate("trabecula.plots.samples({ topic: '/state', field: 'bend_rad' })?.at(0.1) !== undefined"))
    seen = page.page.evaluate("window.seen")
    assert any(one.startswith("Ended") for one in seen), seen
    wrong = [one for one in seen if "Not connected" in one or "Reconnecting" in one or "| error" in one]
    assert not wrong, wrong
    assert "the run has ended" not in page.text("notices") or "error" not in page.page.inner_html("#notices"), page.text("notices")
    page.page.click("#play")
    page.until("it plays", lambda: page.text("phase") == "Playing" and page.number("time") > 0.1)
    page.save(pictures / "ended.png")
    page.clean()
    page.page.close()
    print("ok check_end", flush=True)


def check(browser: Browser, url: str, victim: int, pictures: Path) -> None:
    """Runs all checks on one page, in sequence."""
    page = Page(browser, url, before=FIRST_BONE)
    for one in (connects, shows_the_tool, shows_bone, frames_update, holds_the_frame_that_was_asked_for, pauses_and_steps, drives,
                drives_by_gamepad, holds_a_speed, costs_little, *slices.LIVE):
        _run(one, page)
    page.save(pictures / "live.png")
    for one in (works_with_keys_alone, light_and_dark):
        _run(one, page)
    for one in (shows_nothing_without_token, shows_the_x_ray_without_webgl):
        one(browser, url)
        print(f"ok {one.__name__}", flush=True)
    says_that_the_hub_died(page, victim)
    page.save(pictures / "hub_died.png")
    print("ok says_that_the_hub_died", flush=True)


def _run(one, page: Page) -> None:
    start = time.monotonic()
    one(page)
    print(f"ok {one.__name__} {time.monotonic() - start:.1f} s", flush=True)
