"""Checks the slices, the cross-hair and the distances: of a log at its end, and of a live run."""

from page import Page

TILES = ["axial", "coronal", "sagittal", "along-the-path"]
# Each slice's axes to the right and down, in the patient frame, by radiological convention.
AXES = {"axial": ([1, 0, 0], [0, 1, 0]), "coronal": ([1, 0, 0], [0, 0, -1]), "sagittal": ([0, 1, 0], [0, 0, -1])}
FIELD = "trabecula.slices.field"
POINT = "trabecula.cursor.point"


def shows_slices(page: Page) -> None:
    page.until("four slices", lambda: page.page.evaluate("trabecula.slices.tiles.filter((tile) => tile.shown).length") == 4)
    for tile in TILES:
        greys = set(page.picture(f"slice-{tile}").convert("L").tobytes())
        assert len(greys) > 20, f"{tile} has {len(greys)} greys"
    # Unchanged slices are not requested again.
    page.settled(lambda: page.page.evaluate("trabecula.slices.asked"))


def moves_the_cross_hair(page: Page) -> None:
    """A click in a slice moves the cross-hair there, according to the slice's scale, and the other slices follow."""
    page.page.evaluate("trabecula.cursor.follows || trabecula.cursor.toggle()")
    for tile, (right, down) in AXES.items():
        box = page.page.locator(f"#slice-{tile}").bounding_box()
        before = page.page.evaluate(f"trabecula.slices.tiles.find((tile) => tile.view.name === '{tile}').centre")
        page.page.mouse.click(box["x"] + box["width"] / 2 + 20, box["y"] + box["height"] / 2 - 10)
        metres = page.page.evaluate(FIELD) / box["width"]
        expected = [b + 20 * metres * r - 10 * metres * d for b, r, d in zip(before, right, down)]
        found = page.page.evaluate(POINT)
        # A pointer has whole pixels; the slice's middle may lie between two.
        assert max(abs(a - b) for a, b in zip(found, expected)) < 1.01 * metres, f"{tile}: {found}, expected {expected}"
    assert page.page.get_attribute("#slices-follow", "aria-pressed") == "false"
    place = ", ".join(f"{1e3 * x:.1f}" for x in page.page.evaluate(POINT))
    page.until("the place is told", lambda: page.text("slice-facts").startswith(place))


def goes_through_the_slices(page: Page) -> None:
    page.page.focus("#slice-coronal")
    before = page.page.evaluate(POINT)
    for _ in range(4):
        page.page.keyboard.press("PageDown")
    # The coronal slices are seen from the front: onward is posterior, half a millimetre each.
    moved = [b - a for a, b in zip(before, page.page.evaluate(POINT))]
    assert max(abs(a - b) for a, b in zip(moved, [0, 0.002, 0])) < 1e-9, moved
    page.page.keyboard.press("ArrowLeft")
    moved = [b - a for a, b in zip(before, page.page.evaluate(POINT))]
    assert max(abs(a - b) for a, b in zip(moved, [-0.0005, 0.002, 0])) < 1e-9, moved


def has_windows(page: Page) -> None:
    """Tissue above -200 HU is not black in the bone window; the soft-tissue window is narrower; a drag with Shift sets a
    custom one."""
    # The picture itself: on the screen the focused one has a frame.
    picture = lambda: page.page.evaluate("document.querySelector('#slice-coronal').toDataURL()")
    bone = page.settled(picture)
    page.page.select_option("#slice-window", "soft tissue")
    page.until("another window", lambda: "window -160 to 240 HU" in page.text("slice-facts"))
    page.until("another picture", lambda: picture() != bone)
    box = page.page.locator("#slice-coronal").bounding_box()
    page.page.keyboard.down("Shift")
    page.page.mouse.move(box["x"] + 40, box["y"] + 40)
    page.page.mouse.down()
    page.page.mouse.move(box["x"] + 80, box["y"] + 40, steps=4)
    page.page.mouse.up()
    page.page.keyboard.up("Shift")
    page.until("a wider window", lambda: page.page.evaluate("trabecula.slices.window.width") > 450)
    page.page.select_option("#slice-window", "bone")
    page.until("the first window", lambda: picture() == bone)


def measures_in_a_slice(page: Page) -> None:
    page.page.click("#measure")
    box = page.page.locator("#slice-axial").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.page.mouse.click(x - 30, y)
    assert page.text("measure-facts") == "click the second point"
    page.page.mouse.click(x + 30, y + 20)
    expected = 1e3 * (60**2 + 20**2) ** 0.5 * page.page.evaluate(FIELD) / box["width"]
    measured = float(page.text("measure-facts").split()[0])
    assert abs(measured - expected) <= 0.06 + expected / 60, f"{measured} mm, expected {expected}"


def measures_in_the_x_ray(page: Page) -> None:
    """Two points at the depth of the cross-hair, clicked where the frame's own projection shows them."""
    page.page.evaluate("trabecula.cursor.follows || trabecula.cursor.toggle()")
    page.until("a frame with its projection", lambda: page.page.evaluate("!!trabecula.model.frame?.projection && !!trabecula.cursor.point"))
    # From above the head is up: left and right lie across the detector, which is in front of the patient.
    places, size = page.page.evaluate("""async () => {
        const { project } = await import("/assets/pick.js");
        const [x, y, z] = trabecula.cursor.point;
        const { projection } = trabecula.model.frame;
        const { width, height } = trabecula.xRay.canvas;
        return [[[x - 0.01, y, z], [x + 0.005, y, z + 0.008]].map((point) => project(projection, point)), [width, height]];
    }""")
    box = page.page.locator("#x-ray-canvas").bounding_box()
    scale = min(box["width"] / size[0], box["height"] / size[1])
    for column, row, _ in places:
        page.page.mouse.click(box["x"] + (box["width"] - size[0] * scale) / 2 + (column + 0.5) * scale,
                              box["y"] + (box["height"] - size[1] * scale) / 2 + (row + 0.5) * scale)
    measured = float(page.text("measure-facts").split()[0])
    # sqrt(15² + 8²) = 17 mm; a pixel of the page is about a quarter of a millimetre.
    assert abs(measured - 17.0) < 0.6, f"{measured} mm, expected 17"


def measures_in_the_3d_view(page: Page) -> None:
    """A click on the burr's centre hits its surface, a burr radius from the centre."""
    page.still()
    x, y = page.page.evaluate("""async () => {
        const { project } = await import("/assets/vector.js");
        const { camera, canvas } = trabecula.view;
        const [x, y, , w] = project(camera.clipFromWorld(canvas.clientWidth / canvas.clientHeight), trabecula.model.tip);
        return [(0.5 + 0.5 * x / w) * canvas.clientWidth, (0.5 - 0.5 * y / w) * canvas.clientHeight];
    }""")
    box = page.page.locator("#scene-canvas").bounding_box()
    page.page.mouse.click(box["x"] + x, box["y"] + y)
    begun, tip = page.page.evaluate("[trabecula.measures.begun, trabecula.model.tip]")
    radius = page.page.evaluate("trabecula.model.info.tool.burr_radius_m")
    distance = sum((a - b) ** 2 for a, b in zip(begun, tip)) ** 0.5
    # Bone in front of the section plane is cut away, so that nothing hides the burr.
    assert abs(distance - radius) < 1e-6, f"{distance} m, expected {radius}"
    page.page.keyboard.press("Escape")
    page.page.click("#measure")
    page.page.click("#measure-clear")
    assert page.text("measure-facts") == "" and not page.page.locator("#measure-clear").is_visible()


def enlarges_the_x_ray(page: Page) -> None:
    small = page.page.locator("#x-ray-canvas").bounding_box()
    page.page.click("#x-ray-large")
    page.until("it is large", lambda: page.page.locator("#x-ray-canvas").bounding_box()["width"] > 1.5 * small["width"])
    page.page.evaluate("document.activeElement.blur()")
    page.page.keyboard.press("Escape")
    page.until("it is small", lambda: page.page.locator("#x-ray-canvas").bounding_box() == small)


def draws_the_tool_where_the_x_ray_shows_it(page: Page) -> None:
    """The burr is metal: at its position in the overlay, the frame is darker than a burr's width beside it."""
    inside, outside = page.page.evaluate("""async () => {
        const { project, pixelsPerMetre } = await import("/assets/pick.js");
        const { model, xRay } = trabecula;
        const frame = model.frame;
        const burr = model.posesAt(frame.tick, 30).burr.position;
        const [column, row, depth] = project(frame.projection, burr);
        const radius = (model.info.tool.burr_radius_m) * pixelsPerMetre(frame.projection, depth);
        const { width, height, pixels } = xRay.image;
        const sums = [[0, 0], [0, 0]];
        for (let r = 0; r < height; r++) for (let c = 0; c < width; c++) {
          const far = Math.hypot(c - column, r - row) / radius;
          const ring = far < 0.8 ? 0 : far > 1.4 && far < 2 && r > row ? 1 : -1;
          if (ring >= 0) { sums[ring][0] += pixels[r * width + c]; sums[ring][1] += 1; }
        }
        return sums.map(([sum, count]) => sum / count);
    }""")
    assert inside < 0.7 * outside, f"grey {inside} in the burr, {outside} beside it"


def tells_the_numbers(page: Page) -> None:
    tip = [float(x) for x in page.text("tip").removesuffix(" mm").split(",")]
    shown = [1e3 * x for x in page.page.evaluate("trabecula.model.poses.burr.position")]
    assert max(abs(a - b) for a, b in zip(tip, shown)) <= 0.06, (tip, shown)
    assert page.text("force").endswith(" N"), page.text("force")
    # There is no planned path if the page itself is the controller.
    planned = page.page.evaluate("(trabecula.model.info.scene.planned_path_m ?? []).length > 1")
    off_plan = page.text("off-plan")
    assert off_plan.endswith(" mm") if planned else off_plan == "–", (planned, off_plan)


def survives_a_flood_of_requests(page: Page) -> None:
    """Two hundred slices at once, and invalid ones: all are answered, most are rejected, and the page continues to work."""
    answers = page.page.evaluate("""async () => {
        const { connection } = trabecula;
        const slice = { centre_m: [0, 0, 0], right: [1, 0, 0], down: [0, 1, 0], side_m: [0.1, 0.1], columns: 256, rows: 256 };
        const bad = [{ ...slice, centre_m: [0, NaN, 0] }, { ...slice, columns: 1e9 }, { ...slice, right: [1, 1, 0] }, {}];
        const all = await Promise.all([...Array(200).fill(slice), ...bad].map((one) => connection.call("/slice", one)));
        return all.map((answer) => answer.bytes?.byteLength ?? answer.error);
    }""")
    assert sum(answer == 24 + 2 * 256 * 256 for answer in answers) >= 8, answers
    assert any("in progress" in str(answer) for answer in answers), answers
    assert all(isinstance(answer, str) for answer in answers[200:]), answers[200:]
    page.until("slices still come", lambda: page.page.evaluate("trabecula.slices.refused === ''"))


LOG = (shows_slices, draws_the_tool_where_the_x_ray_shows_it, tells_the_numbers, moves_the_cross_hair, goes_through_the_slices, has_windows,
       measures_in_a_slice, measures_in_the_x_ray, measures_in_the_3d_view, enlarges_the_x_ray, survives_a_flood_of_requests)
LIVE = (shows_slices, tells_the_numbers)
