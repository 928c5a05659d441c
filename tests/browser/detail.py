"""Checks what a view that is rendered in software leaves out, that the picture stays the same, and what it costs."""

import os
from pathlib import Path

from page import Page

# Draws the section twice: with the triangles sorted by the cut, and with all of them in both passes. Returns
# the triangles of the bone in each picture and the mean difference of a pixel's channels.
SORTED = """() => {
    const { view, model, structures } = trabecula, { gl, surface } = view;
    structures.on = false;
    const drawElements = gl.drawElements, draw = surface.draw;
    const picture = () => {
        let triangles = 0;
        gl.drawElements = (mode, count, ...more) => ((triangles += count / 3), drawElements.call(gl, mode, count, ...more));
        view.filmed = true;
        view.draw(model);
        const pixels = new Uint8Array(4 * gl.drawingBufferWidth * gl.drawingBufferHeight);
        gl.readPixels(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
        return { triangles, pixels };
    };
    const sorted = picture();
    surface.draw = (uniforms) => draw.call(surface, uniforms);
    const all = picture();
    delete gl.drawElements;
    delete surface.draw;
    view.filmed = false;
    structures.on = true;
    const away = sorted.pixels.reduce((sum, value, i) => sum + Math.abs(value - all.pixels[i]), 0);
    const marked = new Set(sorted.pixels).size;
    return { sorted: sorted.triangles, all: all.triangles, whole: surface.triangles, away: away / sorted.pixels.length, marked };
}"""


def draws_each_triangle_once(page: Page) -> None:
    """On each side of the cut only its own triangles are drawn, whichever side the eye is on, and the picture is the same."""
    page.until("the surface comes", lambda: page.page.evaluate("trabecula.view.surface.triangles > 100"))
    assert page.page.evaluate("trabecula.view.boneMode") == "section"
    for turn in (0.0, 3.14):
        page.page.evaluate(f"trabecula.view.camera.turn({turn}, 0)")
        found = page.page.evaluate(SORTED)
        assert found["all"] == 2 * found["whole"], found
        # Those within two millimetres of the cut are drawn on both sides.
        assert found["whole"] <= found["sorted"] < 1.4 * found["whole"], found
        # Translucent triangles in another order blend a little differently.
        assert found["away"] < 0.2 and found["marked"] > 50, found
    page.page.evaluate("trabecula.view.camera.turn(-3.14, 0)")


def follows_the_rendering_time(page: Page) -> None:
    """Slow pictures have fewer pixels, down to a limit; quick ones get them back, and neither alternates."""
    ratios = page.page.evaluate("""async () => {
        const { Detail } = await import("/assets/detail.js");
        const detail = new Detail();
        const after = (pictures, milliseconds) => {
            for (let i = 0; i < pictures; i++) detail.rendered(milliseconds);
            return detail.ratio;
        };
        return [after(0, 0), after(20, 200), after(20, 60), after(200, 10), after(1, 80), after(7, 10), after(1, 50)];
    }""")
    first, slow, same, quick, one, seven, steady = ratios
    assert 0.29 < slow == same < 0.5 < first < 1 == quick > one == seven == steady, ratios


# Draws pictures of a view that turns, each after the one before is complete; returns the triangles of one.
TURNING = """async (pictures) => {
    const { view, model } = trabecula, { gl } = view;
    let triangles = 0;
    for (const [name, at, instances] of [["drawElements", 1, undefined], ["drawElementsInstanced", 1, 4]]) {
        const call = gl[name];
        gl[name] = (...given) => ((triangles += (given[at] / 3) * (given[instances] ?? 1)), call.apply(gl, given));
    }
    for (let i = 0; i < pictures; i++) {
        view.camera.yaw += 0.01;
        view.sharp = false;
        view.draw(model);
        gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
        await new Promise((done) => setTimeout(done, 0));
    }
    delete gl.drawElements;
    delete gl.drawElementsInstanced;
    return [triangles / pictures, gl.drawingBufferWidth, gl.drawingBufferHeight];
}"""
PICTURES = 40


def costs_a_picture(page: Page) -> None:
    """Measures the processor time that the browser renders a picture of a turning view with, which depends little on other
    load. Nothing is asserted, because it depends on the machine."""
    before = rendering_s()
    triangles, width, height = page.page.evaluate(TURNING, PICTURES)
    milliseconds = 1000 * (rendering_s() - before) / PICTURES
    print(f"a picture of {width} x {height} pixels and {triangles:.0f} triangles: {milliseconds:.0f} ms of processor time to render; load "
          f"average {os.getloadavg()[0]:.1f}", flush=True)


def rendering_s() -> float:
    """Returns the processor time of the process that renders for the browsers of this script, s."""
    parents, times = {}, {}
    for process in Path("/proc").glob("[0-9]*"):
        try:
            fields = (process / "stat").read_text().rsplit(")", 1)[1].split()
            is_renderer = b"--type=gpu-process" in (process / "cmdline").read_bytes()
        except OSError:
            continue
        parents[int(process.name)] = int(fields[1])
        if is_renderer:
            times[int(process.name)] = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def is_ours(process: int) -> bool:
        return process == os.getpid() or (process in parents and is_ours(parents[process]))

    return sum(time for process, time in times.items() if is_ours(process))
