"""Checks of the page of a scene before its run."""

from pathlib import Path

import slices
from page import BURR_PIXELS, Page, count, is_burr
from playwright.sync_api import Browser


def check(browser: Browser, url: str, pictures: Path) -> None:
    page = Page(browser, url)
    page.until("it is a plan", lambda: page.text("phase") == "Before the run")
    page.until("its figures", lambda: "target to outside" in page.text("plan-rows"))
    page.until("its surface", lambda: page.page.evaluate("trabecula.view.surface.triangles > 100"))
    slices.shows_slices(page)
    page.still()
    # The burr at the start, and the planned one.
    assert count(page.picture("scene-canvas"), is_burr) > BURR_PIXELS
    assert not page.page.locator("#plots").is_visible() and not page.page.locator("#pause").is_visible()
    page.save(pictures / "plan.png")
    page.clean()
    page.page.close()
    print("ok plan", flush=True)
