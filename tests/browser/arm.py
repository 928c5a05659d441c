"""Checks the page of an arm with meshes: its links exist, at positions that match its own lengths."""

from pathlib import Path

from page import Page
from playwright.sync_api import Browser

# Link 4 of configs/arms/puma560 has no mesh.
LINKS = [0, 1, 2, 3, 5, 6]
UPPER_ARM_M = 0.4318


def check(browser: Browser, url: str, pictures: Path) -> None:
    page = Page(browser, url)
    page.until("its links", lambda: sorted(page.page.evaluate("[...trabecula.view.arm.blocks.keys()]")) == LINKS)
    page.until("its frames", lambda: page.page.evaluate("trabecula.model.poses?.arm.length === 6"))
    # From the shoulder to the elbow. Regression: every arm was drawn with the lengths of the UR5.
    away = "(a, b) => Math.hypot(...a.position.map((x, i) => x - b.position[i]))"
    length_m = page.page.evaluate(f"(({away}))(trabecula.model.poses.arm[1], trabecula.model.poses.arm[2])")
    assert abs(length_m - UPPER_ARM_M) < 1e-6, length_m
    # From a distance at which the whole arm is in the picture.
    page.page.evaluate("Object.assign(trabecula.view.camera, { distance: 3 }) && trabecula.view.changed()")
    page.still()
    page.save(pictures / "arm.png")
    page.clean()
    page.page.close()
