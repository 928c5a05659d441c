"""Checks of the page of a log, and of two logs side by side."""

import time
from pathlib import Path

import slices
from page import BURR_PIXELS, Page, count, is_burr
from playwright.sync_api import Browser


def opens_a_log(page: Page) -> None:
    page.until("the log is open", lambda: page.text("phase") in ("Playing", "Paused") and " of " in page.text("playback-time"))
    page.until("a state is shown", lambda: page.number("tick") >= 0)


def scrubs(page: Page) -> None:
    """The time line follows the keys, and all that is shown follows the time line."""
    page.until("the log's length is known", lambda: length(page) > 0)
    if page.text("play") == "Pause":
        page.page.click("#play")
    page.page.focus("#scrub")
    page.page.keyboard.press("End")
    page.until("the end", lambda: abs(page.number("time") - length(page)) < 0.02)
    end_tick, end_bend = page.number("tick"), page.value("Bend")
    page.page.keyboard.press("Home")
    page.until("the beginning", lambda: page.number("time") < 0.02)
    page.until("the state of the beginning", lambda: page.number("tick") < 20)
    assert end_tick > page.number("tick")
    page.until("the bend of the beginning", lambda: abs(page.value("Bend") - end_bend) > 0.01)
    box = page.page.locator("#scrub").bounding_box()
    page.page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.until("the middle", lambda: abs(page.number("time") - length(page) / 2) < 0.1 * length(page))


def length(page: Page) -> float:
    """The log's end in seconds, from the time line."""
    words = page.text("playback-time").split(" of ")
    return float(words[1].split()[0]) if len(words) == 2 else 0.0


def steps_by_ticks(page: Page) -> None:
    here = page.settled(lambda: page.number("tick"))
    page.page.click("text=+1 tick")
    page.until("a tick on", lambda: page.number("tick") == here + 1)
    page.page.click("text=−1 tick")
    page.until("a tick back", lambda: page.number("tick") == here)


def plays(page: Page) -> None:
    page.page.focus("#scrub")
    page.page.keyboard.press("Home")
    page.until("the beginning", lambda: page.number("time") < 0.02)
    page.page.click("#play")
    page.until("time goes on", lambda: page.number("time") > 0.05)
    if page.text("play") == "Pause":
        page.page.keyboard.press("Tab")
        page.page.click("#play")
    page.until("it stands", lambda: page.text("phase") == "Paused")


def draws(page: Page) -> None:
    page.until("the poses come", lambda: page.page.evaluate("!!trabecula.model.poses && !trabecula.view.busy"))
    page.until("the burr is seen", lambda: count(page.picture("scene-canvas"), is_burr) > BURR_PIXELS)


def shows_frames(page: Page) -> None:
    page.until("a frame is shown", lambda: page.text("frame-facts").startswith("frame "))
    greys = set(page.picture("x-ray-canvas").convert("L").tobytes())
    assert len(greys) > 20, f"the X-ray has {len(greys)} greys"


def goes_to_marks(page: Page) -> None:
    """The key for the next event goes to the first mark of that kind behind where it stands."""
    page.until("the thumb stands where the time is", lambda: page.page.evaluate("Number(document.querySelector('#scrub').value)") > 0)
    page.page.focus("#scrub")
    page.page.keyboard.press("Home")
    page.until("the beginning", lambda: page.number("time") < 0.02)
    marks = page.page.evaluate("trabecula.timeLine.events.filter((mark) => mark.kind === 'event').map((mark) => mark.time_ns)")
    here = page.number("time")
    later = sorted(ns / 1e9 for ns in marks if ns / 1e9 > here)
    assert later, f"no event behind {here} s: {marks}"
    page.page.keyboard.press("n")
    page.until(f"the event at {later[0]} s", lambda: abs(page.number("time") - later[0]) < 0.002)


def shows_differences(page: Page) -> None:
    page.until("the page compares", lambda: page.page.locator("#compare").is_visible())
    page.page.focus("#scrub")
    page.page.keyboard.press("End")
    page.until("fields differ", lambda: "tendon_tension_n" in page.text("compare-rows") or "bend_rad" in page.text("compare-rows"))
    rows = page.page.locator("#compare-rows tr").all_inner_texts()
    assert len(rows) > 3, rows


def finds_where_they_part(page: Page) -> None:
    """The key for the next divergence goes to the tick where the two runs part, and the table says in what."""
    page.page.evaluate("document.activeElement.blur()")
    mark = page.page.evaluate("trabecula.timeLine.events.find((mark) => mark.kind === 'divergence')")
    assert mark and "tendon_force_n" in mark["text"], mark
    page.page.focus("#scrub")
    page.page.keyboard.press("Home")
    page.until("the beginning", lambda: page.number("time") < 0.001)
    page.until("the runs are the same there", lambda: "no field" in page.text("compare-rows"))
    page.page.keyboard.press("g")
    page.until("the tick where they part", lambda: page.number("tick") == round(mark["time_ns"] / 1e6))
    page.until("it is said what differs", lambda: mark["text"] in page.text("mark-text"))
    page.page.click("text=−1 tick")
    page.until("the tick before", lambda: page.number("tick") == round(mark["time_ns"] / 1e6) - 1)
    page.until("the runs are the same there", lambda: "no field" in page.text("compare-rows"))


def check(browser: Browser, url: str, pictures: Path) -> None:
    """One log."""
    page = Page(browser, url)
    for one in (opens_a_log, scrubs, steps_by_ticks, draws, shows_frames, plays, goes_to_marks):
        _run(one, page)
    page.page.focus("#scrub")
    page.page.keyboard.press("End")
    page.until("the end", lambda: abs(page.number("time") - length(page)) < 0.02)
    for one in slices.LOG:
        _run(one, page)
    page.still()
    page.save(pictures / "log.png")
    page.clean()
    page.page.close()


def check_two(browser: Browser, url: str, pictures: Path) -> None:
    """Two logs."""
    page = Page(browser, url)
    for one in (opens_a_log, finds_where_they_part, shows_differences):
        _run(one, page)
    page.still()
    page.save(pictures / "two_logs.png")
    page.clean()
    page.page.close()


def _run(one, page: Page) -> None:
    start = time.monotonic()
    one(page)
    print(f"ok {one.__name__} {time.monotonic() - start:.1f} s", flush=True)
