"""Checks the page of a log, and of two logs side by side."""

import time
from pathlib import Path
from xml.etree import ElementTree

import detail
import slices
import structures
from page import BURR_PIXELS, Page, count, is_burr, is_link
from playwright.sync_api import Browser


def opens_a_log(page: Page) -> None:
    page.until("the log is open", lambda: page.text("phase") in ("Playing", "Paused") and " of " in page.text("playback-time"))
    page.until("a state is shown", lambda: page.number("tick") >= 0)
    page.until("the log's length is known", lambda: length(page) > 0)


def scrubs(page: Page) -> None:
    """The time line follows the keys, and everything on the page follows the time line."""
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


def shows_clearances(page: Page) -> None:
    """The clearance from a ball ahead of the burr is that of two balls; within the margin, row and tool change colour."""
    page.page.focus("#scrub")
    page.page.keyboard.press("Home")
    page.until("the beginning", lambda: page.number("time") < 0.02)
    page.until("a clearance", lambda: page.text("clearance-rows").startswith("nerve\t"))
    two_balls = "(({ tip: [x, y, z], info }) => 1e3 * (Math.hypot(x, y, z - 0.01) - 0.002 - info.tool.burr_radius_m))(trabecula.model)"
    page.until("its distance", lambda: abs(float(page.text("clearance-rows").split()[1]) - page.page.evaluate(two_balls)) < 0.01)
    links = lambda: count(page.picture("scene-canvas"), is_link)
    page.until("the links' own colour", lambda: links() > BURR_PIXELS)
    margin = "(margin_m) => { trabecula.model.info.scene.structures[0].margin_m = margin_m; trabecula.changed(); }"
    page.page.evaluate(margin, 0.1)
    page.until("a warning", lambda: page.page.locator("#clearance-rows .warning").count() == 1)
    # The planned path has a few pixels of the links' colour.
    page.until("the colour of a margin", lambda: links() < BURR_PIXELS)
    page.page.evaluate(margin, 0.002)
    page.until("no warning", lambda: page.page.locator("#clearance-rows .warning").count() == 0)


def length(page: Page) -> float:
    """Returns the log's end in seconds, from the time line."""
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
    page.until("the end", lambda: page.text("phase") == "Paused" and abs(page.number("time") - length(page)) < 0.002)


def pauses(page: Page) -> None:
    """The second press of the button pauses; slowly, because one that comes after the end plays again."""
    page.page.select_option("#playback-speed", "0.05")
    page.page.focus("#scrub")
    page.page.keyboard.press("Home")
    page.until("the beginning", lambda: page.number("time") < 0.02)
    page.page.click("#play")
    page.until("it plays", lambda: page.text("play") == "Pause")
    page.page.click("#play")
    page.until("a pause", lambda: page.text("phase") == "Paused")
    assert page.number("time") < length(page)
    page.page.select_option("#playback-speed", "1")


def draws(page: Page) -> None:
    page.until("the poses come", lambda: page.page.evaluate("!!trabecula.model.poses && !trabecula.view.busy"))
    page.until("the burr is seen", lambda: count(page.picture("scene-canvas"), is_burr) > BURR_PIXELS)


def shows_frames(page: Page) -> None:
    page.until("a frame is shown", lambda: page.text("frame-facts").startswith("frame "))
    greys = set(page.picture("x-ray-canvas").convert("L").tobytes())
    assert len(greys) > 20, f"the X-ray has {len(greys)} greys"


def goes_to_marks(page: Page) -> None:
    """The key for the next event goes to the next mark of that kind."""
    page.until("the thumb stands where the time is", lambda: page.page.evaluate("Number(document.querySelector('#scrub').value)") > 0)
    page.page.focus("#scrub")
    page.page.keyboard.press("Home")
    page.until("the beginning", lambda: page.number("time") < 0.02)
    all_marks = page.page.evaluate("trabecula.timeLine.events")
    kind = "event" if any(mark["kind"] == "event" for mark in all_marks) else "note"
    marks = [mark["time_ns"] for mark in all_marks if mark["kind"] == kind]
    here = page.number("time")
    later = sorted(ns / 1e9 for ns in marks if ns / 1e9 > here)
    assert later, f"no event behind {here} s: {marks}"
    page.page.keyboard.press("n")
    page.until(f"the event at {later[0]} s", lambda: abs(page.number("time") - later[0]) < 0.002)


def plots_are_whole(page: Page) -> None:
    """The plots show the whole log before anything was played, without gaps, and exact values."""
    span = "trabecula.plots.logs[0].span"
    page.until("the log is read", lambda: page.page.evaluate(f"!!{span} && {span}.reading === null"))
    columns = page.page.evaluate(f"{span}.fields.get('/state bend_rad').at")
    apart = max(b - a for a, b in zip(columns, columns[1:], strict=False))
    ticks = round(length(page) * 1000)
    assert columns[0] == 0 and apart <= page.page.evaluate(f"{span}.columns") // ticks + 1, (columns[:9], apart)
    missed = page.text("missed")
    assert missed == "0 of 0", f"a run in lockstep misses nothing, and the page says {missed}"


def plays_fast_without_loss(page: Page) -> None:
    """Regression: at twenty times its speed a log's messages outran the page, and the plots had spurious steps."""
    before = page.page.evaluate("trabecula.plots.logs[0].span.fields.get('/state bend_rad').mean")
    page.page.select_option("#playback-speed", "20")
    plays(page)
    page.page.select_option("#playback-speed", "1")
    assert "dropped" not in page.text("notices"), page.text("notices")
    assert page.page.evaluate("trabecula.plots.logs[0].span.fields.get('/state bend_rad').mean") == before


def times_agree(page: Page) -> None:
    """Regression: headline, slider and state showed three different times."""
    page.page.evaluate("trabecula.connection.call('/playback', {action: 'seek', time_ns: 432100000})")
    page.until("the head line's time", lambda: page.text("time") == "0.432 s")
    page.until("the state's tick", lambda: page.number("tick") == 432)
    # The slider is drawn with the next picture, the other two every tenth of a second.
    page.until("the slider's time", lambda: page.text("playback-time").startswith("0.432 s"))


def plots_any_field(page: Page) -> None:
    """A field found by its name is plotted, zoomed with all others, saved, and restored after a reload."""
    count, span = page.page.locator(".plot").count(), "trabecula.plots.logs[0].span"
    page.page.click("text=Add field")
    page.page.fill("#field-search", "state t_world_burr.position_m[2]")
    page.page.click("#field-list button >> nth=0")
    page.page.click("#fields-close")
    page.until("a plot more", lambda: page.page.locator(".plot").count() == count + 1)
    key = "/state t_world_burr.position_m[2]"
    page.until("its values", lambda: page.page.evaluate(f"trabecula.plots.logs[0].span?.fields.get('{key}')?.at.length > 100"))
    page.page.evaluate("trabecula.plots.axis.zoom(0.1, 0.5), trabecula.changed('plots')")
    assert page.page.evaluate("trabecula.plots.range().map((x) => x.toFixed(3)).join()") == "0.450,0.550"
    page.until("the span's own columns", lambda: page.page.evaluate(f"{span}.to - {span}.from < 0.25"))
    csv = page.page.evaluate("import('/assets/figure.js').then(({ plotsCsv }) => plotsCsv(trabecula.plots))").splitlines()
    assert f'"{key} least"' in csv[0] and 100 <= len(csv) <= 105, (csv[0], len(csv))
    svg = page.page.evaluate("import('/assets/figure.js').then(({ plotsSvg }) => plotsSvg(trabecula.plots, trabecula.theme.colours))")
    ElementTree.fromstring(svg)
    assert svg.count("<text") > 20
    page.page.reload()
    opens_a_log(page)
    page.until("the layout is kept", lambda: page.page.locator(".plot").count() == count + 1)
    page.page.evaluate("trabecula.actions.run('restore')")
    page.until("the plots as at first", lambda: page.page.locator(".plot").count() == count)


def hides_panels(page: Page) -> None:
    """A hidden panel stays hidden after a reload, and can be shown again."""
    page.page.click("text=Panels")
    page.page.uncheck("input[data-panel='x-ray']")
    page.until("no X-ray", lambda: not page.page.locator("#x-ray").is_visible())
    page.page.reload()
    opens_a_log(page)
    assert not page.page.locator("#x-ray").is_visible()
    page.page.click("text=Panels")
    page.page.check("input[data-panel='x-ray']")
    page.until("the X-ray again", lambda: page.page.locator("#x-ray").is_visible())
    page.page.click("text=Panels")


def answers_odd_requests(page: Page) -> None:
    """Empty spans, unknown fields and too many requests are rejected with a message, and the page continues to work."""
    ask = "(request) => trabecula.connection.call('/series', request)"
    field = {"topic": "/state", "field": "bend_rad"}
    good = {"fields": [field], "from_ns": 0, "to_ns": 10**9, "columns": 10}
    odd = [({"to_ns": 0}, "empty"), ({"columns": 0}, "columns"), ({"columns": 10**6}, "columns"), ({"fields": [field] * 99}, "fields"),
           ({"fields": [{"topic": "/nothing", "field": "x"}]}, "/nothing"), ({"fields": [{"topic": "/state", "field": "hash"}]}, "not a scalar"),
           ({"second": True}, "second"), ({"from_ns": -1}, "malformed")]
    for change, word in odd:
        answer = page.page.evaluate(ask, {**good, **change})
        assert not answer["ok"] and word in answer["error"], (change, answer)
    many = page.page.evaluate(f"(request) => Promise.all(Array.from({{length: 300}}, () => ({ask})(request)))", good)
    assert sum(answer["ok"] for answer in many) > 10 and all(answer["ok"] or "busy" in answer["error"] for answer in many)
    assert page.page.evaluate(ask, good)["ok"]
    assert len(page.page.evaluate(ask, {**good, "to_ns": 2**63})["series"][0]["at"]) == 1


def ends_are_told(page: Page) -> None:
    """After the end of the shorter log, nothing is compared with its last state."""
    page.page.focus("#scrub")
    page.page.keyboard.press("End")
    page.until("its end is told", lambda: "the second log has ended at" in page.text("compare-rows"))


def shows_differences(page: Page) -> None:
    page.until("the page compares", lambda: page.page.locator("#compare").is_visible())
    page.page.evaluate("trabecula.connection.call('/playback', {action: 'seek', time_ns: 600000000})")
    page.until("fields differ", lambda: "tendon_tension_n" in page.text("compare-rows") or "bend_rad" in page.text("compare-rows"))
    rows = page.page.locator("#compare-rows tr").all_inner_texts()
    assert len(rows) > 3, rows


def finds_where_they_part(page: Page) -> None:
    """The key for the next divergence goes to the tick where the two runs diverge, and the table shows the fields."""
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
    """Checks one log."""
    page = Page(browser, url)
    for one in (opens_a_log, plots_are_whole, plays_fast_without_loss, times_agree, plots_any_field, hides_panels, answers_odd_requests, scrubs, steps_by_ticks, draws, shows_clearances, structures.shows_structures, detail.draws_each_triangle_once, detail.follows_the_rendering_time, detail.costs_a_picture, shows_frames, pauses, plays, goes_to_marks):
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
    """Checks two logs."""
    page = Page(browser, url)
    for one in (opens_a_log, finds_where_they_part, shows_differences, ends_are_told):
        _run(one, page)
    page.still()
    page.save(pictures / "two_logs.png")
    page.clean()
    page.page.close()


def _run(one, page: Page) -> None:
    start = time.monotonic()
    one(page)
    print(f"ok {one.__name__} {time.monotonic() - start:.1f} s", flush=True)
