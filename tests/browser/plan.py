"""Checks the page of a scene before its run: it is shown, its points are moved, it is saved, and run."""

import math
import tomllib
from pathlib import Path

import slices
from page import BURR_PIXELS, Page, count, is_burr
from playwright.sync_api import Browser

PLACES = "trabecula.model.info.plan.places"
# A slice of 80 mm in some 200 pixels: a pixel is 0.4 mm.
PIXEL_MM = 0.6


def shows_the_plan(page: Page) -> None:
    page.until("it is a plan", lambda: page.text("phase") == "Before the run")
    page.until("its figures", lambda: "target to outside" in page.text("plan-rows"))
    page.until("its surface", lambda: page.page.evaluate("trabecula.view.surface.triangles > 100"))
    slices.shows_slices(page)
    page.still()
    # The burr at the start, and the planned one.
    assert count(page.picture("scene-canvas"), is_burr) > BURR_PIXELS
    assert not page.page.locator("#plots").is_visible() and not page.page.locator("#pause").is_visible()


def place(page: Page, name: str) -> list[float]:
    return page.page.evaluate(f"{PLACES}.{name}")


def fields(page: Page, name: str) -> list[float]:
    return [float(page.page.input_value(f"#{name}-{axis}")) for axis in range(3)]


def radius(page: Page) -> float:
    rows = page.text("plan-rows").splitlines()
    line = next((line for line in rows if line.startswith("bend radius")), "")
    return float(line.split("\t")[-1].split()[0]) if line else -1.0


def arc_radius(page: Page) -> float:
    """Returns the radius of the circle that starts tangentially to the feed (+z, from 1 mm behind the start) and ends at the
    target."""
    start, target = place(page, "burr_start_mm"), place(page, "target_mm")
    beside = math.hypot(target[0] - start[0], target[1] - start[1])
    ahead = target[2] - start[2] - 1.0
    return (beside * beside + ahead * ahead) / (2.0 * beside)


def follows(page: Page, what: str) -> None:
    """Numbers, path and radius match the points."""
    target = lambda: place(page, "target_mm")
    page.until(f"{what}: the radius", lambda: abs(radius(page) - arc_radius(page)) < 0.06)
    end = page.page.evaluate("trabecula.model.info.scene.planned_path_m.at(-1)")
    assert all(abs(1e3 * a - b) < 1e-6 for a, b in zip(end, target())), (end, target())
    assert fields(page, "target_mm") == target(), (fields(page, "target_mm"), target())


def moves_by_number_and_key(page: Page) -> None:
    page.page.fill("#target_mm-0", "5.25")
    page.until("the target moves", lambda: place(page, "target_mm")[0] == 5.25)
    follows(page, "typed")
    page.page.focus("#target_mm-2")
    before = place(page, "target_mm")[2]
    page.page.keyboard.press("ArrowUp")
    page.until("a key moves it by a step", lambda: place(page, "target_mm")[2] == before + 0.5)
    page.page.evaluate("document.activeElement.blur()")
    follows(page, "by key")
    # The HU profile ends where the path does.
    along = page.page.evaluate("trabecula.model.info.plan.profile.at(-1)[0]")
    assert abs(along - page.page.evaluate("trabecula.model.info.plan.facts.target.along_mm")) < 0.3


def drags_in_a_slice(page: Page) -> None:
    """A drag by pixels is one by millimetres in the plane; the offset from the plane is unchanged."""
    tile = "trabecula.slices.tiles.find((tile) => tile.view.name === 'coronal')"
    page.page.evaluate("document.getElementById('slice-coronal').scrollIntoView({ block: 'center' })")
    box = page.page.locator("#slice-coronal").bounding_box()
    x, y = page.page.evaluate(f"{tile}.pixelOf(trabecula.planEdit.handles.find((one) => one.name === 'target_mm').point, trabecula.slices.field)")
    millimetres = 1e3 * page.page.evaluate(f"trabecula.slices.field / {tile}.canvas.clientWidth")
    before = place(page, "target_mm")
    page.page.mouse.move(box["x"] + x, box["y"] + y)
    page.page.mouse.down()
    page.page.mouse.move(box["x"] + x + 4, box["y"] + y, steps=2)
    page.page.mouse.move(box["x"] + x + 10, box["y"] + y + 8, steps=4)
    page.page.mouse.up()
    wanted = [before[0] + 10 * millimetres, before[1], before[2] - 8 * millimetres]
    page.until("the target is dragged", lambda: all(abs(a - b) < PIXEL_MM for a, b in zip(place(page, "target_mm"), wanted)))
    page.until("nothing is under way", lambda: page.page.evaluate("trabecula.planEdit.moved.size === 0 && !trabecula.planEdit.asking"))
    follows(page, "dragged")


def drags_in_the_view(page: Page) -> None:
    """A handle follows the pointer, and the view does not move."""
    at = "trabecula.sceneOverlay.pixelOf(trabecula.planEdit.handles.find((one) => one.name === 'isocentre_mm').point)"
    page.page.evaluate("window.scrollTo(0, 0)")
    box = page.page.locator("#scene-canvas").bounding_box()
    x, y = page.page.evaluate(at)
    before, yaw = place(page, "isocentre_mm"), page.page.evaluate("trabecula.view.camera.yaw")
    page.page.mouse.move(box["x"] + x, box["y"] + y)
    page.page.mouse.down()
    page.page.mouse.move(box["x"] + x + 25, box["y"] + y - 15, steps=5)
    page.page.mouse.up()
    near = lambda: math.dist(page.page.evaluate(at), (x + 25, y - 15)) < 1.5
    page.until("the isocentre is under the pointer", lambda: near() and math.dist(place(page, "isocentre_mm"), before) > 1.0)
    assert page.page.evaluate("trabecula.view.camera.yaw") == yaw, "the drag turned the view"


def refuses_in_the_scenes_words(page: Page) -> None:
    before = place(page, "burr_start_mm")
    page.page.fill("#burr_start_mm-1", "1e7")
    page.until("it is refused", lambda: "`tool.burr_start_mm[1]` is 10000000; allowed:" in page.text("plan-said"))
    assert place(page, "burr_start_mm") == before
    page.page.fill("#burr_start_mm-1", str(before[1]))
    page.until("it is taken back", lambda: page.text("plan-said") == "")


def save(page: Page, name: str) -> None:
    page.page.click("#plan-save")
    page.page.fill("#plan-name", name)
    page.page.keyboard.press("Enter")


def saves(page: Page, scene: Path) -> Path:
    """The file has the values shown and is otherwise the same as the original, which is unchanged."""
    original = scene.read_text()
    for wrong in ("../elsewhere.toml", "/tmp/elsewhere.toml", ".hidden.toml"):
        save(page, wrong)
        page.until(f"{wrong} is refused", lambda wrong=wrong: f"invalid name `{wrong}`" in page.text("plan-said"))
    save(page, scene.name)
    page.until("the original is refused", lambda: "never overwritten" in page.text("plan-said"))
    edited = scene.with_name("edited.toml")
    edited.write_text("# somebody else's\n")
    save(page, edited.name)
    page.until("it asks", lambda: page.page.locator("#confirm").is_visible() and "exists" in page.text("confirm-text"))
    page.page.click("#confirm button[value=no]")
    assert edited.read_text() == "# somebody else's\n"
    save(page, edited.name)
    page.page.click("#confirm button[value=yes]")
    page.until("it is saved", lambda: "saved: " in page.text("plan-said"))
    text = edited.read_text()
    found = tomllib.loads(text)
    drilling = found["controller"][0]["curved_drilling"]
    for name, value in (("burr_start_mm", found["tool"]["burr_start_mm"]), ("target_mm", drilling["target_mm"]), ("isocentre_mm", found["drr"]["isocentre_mm"])):
        assert fields(page, name) == value, (name, fields(page, name), value)
    changed = ("target_mm", "isocentre_mm", "insertion_mm", "ramp_end_mm", "bend_toward")
    others = lambda lines: [line for line in lines.splitlines() if not line.startswith(changed)]
    assert others(text) == others(original), "more than the places changed"
    assert scene.read_text() == original, "the original changed"
    return edited


def runs(page: Page) -> None:
    """The page follows the run of the saved scene, and then shows its log."""
    page.page.click("#plan-run")
    page.until("it runs", lambda: page.page.evaluate("document.body.classList.contains('live')"))
    page.until("its log is here", lambda: page.page.evaluate("document.body.classList.contains('log')"))
    page.until("the whole time", lambda: "1.000 s" in page.text("playback-time"))
    # Texts are drawn with the next picture.
    page.until("it is paused", lambda: page.text("phase") == "Paused" and not page.page.locator("#banner").is_visible())


def check(browser: Browser, url: str, scene: Path, pictures: Path) -> None:
    page = Page(browser, url)
    for one in (shows_the_plan, moves_by_number_and_key, drags_in_a_slice, drags_in_the_view, refuses_in_the_scenes_words):
        one(page)
        print(f"ok {one.__name__}", flush=True)
    page.save(pictures / "plan.png")
    saves(page, scene)
    print("ok saves", flush=True)
    runs(page)
    print("ok runs", flush=True)
    page.save(pictures / "plan_log.png")
    page.clean()
    page.page.close()
