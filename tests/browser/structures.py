"""Checks that a critical structure, a ball ahead of the burr, is drawn in the 3D view, in a slice and in the X-ray."""

import math

from page import Page
from PIL import Image, ImageChops

CENTRE = [0.0, 0.0, 0.01]
RADIUS_M = 0.002
# A translucent surface or a line changes a pixel's channels by more than this.
CHANGED = 40
# Looks at the ball from near, and places the cross-hair beside it; RESTORE undoes that.
LOOK = """([x, y, z]) => {
    const { view, cursor, slices } = trabecula, { camera } = view;
    const { centre, distance, follows } = camera;
    window.before = { camera: { centre, distance, follows }, cursor: { point: cursor.point, follows: cursor.follows }, field: slices.field };
    Object.assign(camera, { centre: [x, y, z], distance: 0.03, follows: false });
    cursor.place([x + 0.009, y, z]);
    for (const tile of slices.tiles) tile.centre = undefined;
    slices.zoom(0.03 / slices.field);
}"""
RESTORE = """() => {
    Object.assign(trabecula.view.camera, window.before.camera);
    Object.assign(trabecula.cursor, window.before.cursor);
    trabecula.slices.zoom(window.before.field / trabecula.slices.field);
}"""
# The middle and the radius of the ball's picture, in pixels of each element.
EXPECTED = """async ([centre, radius]) => {
    const { project } = await import("/assets/vector.js");
    const ray = await import("/assets/pick.js");
    const { FIELD_OF_VIEW_RAD } = await import("/assets/camera.js");
    const { camera, canvas } = trabecula.view, { clientWidth: width, clientHeight: height } = canvas;
    const [x, y, , w] = project(camera.clipFromWorld(width / height), centre);
    const perMetre = height / 2 / Math.tan(FIELD_OF_VIEW_RAD / 2);
    const tile = trabecula.slices.tiles.find(({ view }) => view.name === "coronal");
    const { frame, canvas: overlay, xRay } = trabecula.xRayOverlay;
    const [column, row, depth] = ray.project(frame.projection, centre);
    const fit = Math.min(overlay.clientWidth / xRay.canvas.width, overlay.clientHeight / xRay.canvas.height);
    const left = (overlay.clientWidth - xRay.canvas.width * fit) / 2, top = (overlay.clientHeight - xRay.canvas.height * fit) / 2;
    return {
        "scene-canvas": [(0.5 + 0.5 * x / w) * width, (0.5 - 0.5 * y / w) * height, perMetre * radius / Math.sqrt(w * w - radius * radius)],
        "slice-coronal": [...tile.pixelOf(centre, trabecula.slices.field), radius / trabecula.slices.field * tile.canvas.clientWidth],
        "x-ray-overlay": [left + (column + 0.5) * fit, top + (row + 0.5) * fit, radius * ray.pixelsPerMetre(frame.projection, depth) * fit],
    };
}"""


def shows_structures(page: Page) -> None:
    """What the switch takes away is where the ball is: a disc in the 3D view, and a circle in a slice and in the X-ray."""
    page.until("its mesh", lambda: page.page.evaluate("trabecula.structures.meshes.size") == 1)
    page.until("a frame with its projection", lambda: page.page.evaluate("!!trabecula.xRayOverlay.frame"))
    page.page.evaluate(LOOK, CENTRE)
    _rest(page)
    expected = page.page.evaluate(EXPECTED, [CENTRE, RADIUS_M])
    shown = {place: page.picture(place) for place in expected}
    page.page.click("#structures-switch")
    assert page.page.get_attribute("#structures-switch", "aria-pressed") == "false"
    _rest(page)
    for place, (x, y, radius) in expected.items():
        away = _distances(shown[place], page.picture(place), x, y)
        assert away, f"{place} shows no structure"
        assert max(away) < radius + 4, f"{place}: {max(away):.1f} pixels from the middle of a ball of {radius:.1f}"
        if place == "scene-canvas":
            share = len(away) / (math.pi * radius**2)
            assert 0.85 < share < 1.1, f"{share:.2f} of a disc of {radius:.1f} pixels"
        else:
            mean = sum(away) / len(away)
            print(f"{place}: a circle of {mean:.2f} pixels, expected {radius:.2f}", flush=True)
            assert min(away) > radius - 4 and abs(mean - radius) < 0.7, f"{place}: {min(away):.1f}, mean {mean:.2f} pixels of {radius:.1f}"
            # All around: the line is wider than a pixel.
            assert len(away) > 2 * math.pi * radius, f"{place}: {len(away)} pixels of a circle of {radius:.1f}"
    page.page.click("#structures-switch")
    assert "nerve" in page.page.evaluate("document.querySelector('#legend').textContent")
    page.page.evaluate(RESTORE)


def _rest(page: Page) -> None:
    """Waits until the 3D view and the slices do not change."""
    page.still()
    page.until("the slices", lambda: page.page.evaluate("trabecula.slices.tiles.every((tile) => tile.shown && !tile.asking)"))
    page.settled(lambda: page.page.evaluate("[trabecula.slices.pictures, trabecula.slices.asked]"))


def _distances(one: Image.Image, other: Image.Image, x: float, y: float) -> list[float]:
    """Returns the distance from a place of each pixel that differs between two pictures."""
    difference = ImageChops.difference(one, other)
    pixels, width = difference.tobytes(), difference.width
    changed = [i // 3 for i in range(0, len(pixels), 3) if sum(pixels[i : i + 3]) > CHANGED]
    return [math.hypot(i % width + 0.5 - x, i // width + 0.5 - y) for i in changed]
