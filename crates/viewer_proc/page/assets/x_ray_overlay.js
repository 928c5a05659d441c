// Overlay on the X-ray in the frame's own projection: plan, structures, tool and tip at the time of the
// frame, cross-hair, distances.

import { CLICK_PX } from "/assets/measure.js";
import { textScale } from "/assets/plot.js";
import { pixelsPerMetre, project, sourceOf, unproject } from "/assets/pick.js";
import { drawMeasures } from "/assets/slice_tile.js";
import { context2d } from "/assets/software.js";
import { outlineFrom } from "/assets/structures.js";
import { COLOURS, burrBalls } from "/assets/tool_model.js";
import { transform } from "/assets/vector.js";

/** @typedef {import("/assets/vector.js").Vector} Vector */

/** @param {import("/assets/parts_list.js").Colour} colour */
const css = ([r, g, b]) => `rgb(${[r, g, b].map((part) => Math.round(part * 255)).join(" ")})`;
/** In a run, a state within this many ticks of a frame is used for it; a log sends the frame's own state. */
const NEAR_TICKS = 30;

export class XRayOverlay {
  /**
   * @param {HTMLCanvasElement} canvas over that of the X-ray @param {import("/assets/x_ray.js").XRay} xRay
   * @param {import("/assets/model.js").Model} model @param {import("/assets/cursor.js").Cursor} cursor
   * @param {import("/assets/measure.js").Measures} measures
   */
  constructor(canvas, xRay, model, cursor, measures) {
    this.canvas = canvas;
    this.xRay = xRay;
    this.model = model;
    this.cursor = cursor;
    this.measures = measures;
    /** @type {import("/assets/structures.js").Structures | undefined} */
    this.structures = undefined;
    this.on = true;
    this.#listen();
  }

  /** The shown frame, if its projection is known. */
  get frame() {
    const { xRay, model } = this;
    const frame = xRay.held ? model.heldFrame : model.frame;
    return xRay.shows === "second" || !frame?.projection ? undefined : frame;
  }

  /** Position of the image in its element: scale in pixels, and upper left corner. */
  #fit(width, height) {
    const { width: columns, height: rows } = this.xRay.canvas;
    const scale = Math.min(width / columns, height / rows);
    return { scale, left: (width - columns * scale) / 2, top: (height - rows * scale) / 2 };
  }

  draw() {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight].map((n) => Math.max(1, Math.round(n * ratio)));
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    const context = context2d(this.canvas);
    context.clearRect(0, 0, width, height);
    const { frame } = this;
    if (!frame || !this.on) return;
    const { scale, left, top } = this.#fit(width, height);
    /** @param {Vector} point */
    const at = (point) => {
      const seen = project(frame.projection, point);
      return seen && [left + (seen[0] + 0.5) * scale, top + (seen[1] + 0.5) * scale, seen[2]];
    };
    const { columns, rows } = this.#size();
    context.save();
    context.beginPath();
    context.rect(left, top, columns * scale, rows * scale);
    context.clip();
    const mark = ratio * textScale();
    const paint = { context, at, ratio: mark, scale, projection: frame.projection };
    this.#drawStructures(paint);
    this.#drawPlan(paint);
    this.#drawTool(paint, frame);
    drawMeasures(context, this.measures, at, mark);
    if (this.cursor.point && !this.cursor.follows) this.#drawCross(paint, this.cursor.point);
    context.restore();
  }

  /** The first log's image; the second log's is next to it. */
  #size() {
    const { width, height } = this.xRay.canvas;
    return { columns: this.xRay.shows === "both" && this.xRay.second ? width / 2 : width, rows: height };
  }

  #line({ context, at }, points, colour, width, dash) {
    context.strokeStyle = colour;
    context.lineWidth = width;
    context.setLineDash(dash);
    context.beginPath();
    for (const place of points.map(at)) if (place) context.lineTo(place[0], place[1]);
    context.stroke();
    context.setLineDash([]);
  }

  #drawStructures({ context, at, ratio, projection }) {
    context.lineWidth = 1.5 * ratio;
    for (const { mesh, colour } of this.structures?.shown ?? []) {
      context.strokeStyle = css(colour);
      context.beginPath();
      for (const [from, to] of outlineFrom(mesh, sourceOf(projection)).map((ends) => ends.map(at))) {
        if (!from || !to) continue;
        context.moveTo(from[0], from[1]);
        context.lineTo(to[0], to[1]);
      }
      context.stroke();
    }
  }

  #drawPlan(paint) {
    const scene = this.model.info?.scene;
    const { context, at, ratio } = paint;
    if (scene?.planned_path_m) this.#line(paint, scene.planned_path_m, css(COLOURS.planned), 2 * ratio, [5 * ratio, 4 * ratio]);
    const target = scene?.target_m && at(scene.target_m);
    if (!target) return;
    context.strokeStyle = css(COLOURS.target);
    context.lineWidth = 2 * ratio;
    context.beginPath();
    context.arc(target[0], target[1], 4 * ratio, 0, 7);
    for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      context.moveTo(target[0] + dx * 3 * ratio, target[1] + dy * 3 * ratio);
      context.lineTo(target[0] + dx * 9 * ratio, target[1] + dy * 9 * ratio);
    }
    context.stroke();
  }

  #drawTool(paint, frame) {
    // Kept with the frame: a held frame outlives the states.
    frame.poses ??= this.model.posesAt(frame.tick, this.model.info?.kind === "log" ? 0 : NEAR_TICKS);
    const { poses } = frame;
    const tool = this.model.info?.tool;
    if (!poses || !tool) return;
    const { context, at, ratio, scale, projection } = paint;
    const joints = [poses.base.position, transform(poses.base, [0, 0, tool.shaft?.length_m ?? 0]), ...poses.links.map((link) => link.position), poses.burr.position];
    this.#line(paint, joints, css(COLOURS.linkOdd), 1.5 * ratio, []);
    const tip = at(poses.burr.position);
    if (!tip) return;
    context.strokeStyle = css(COLOURS.burr);
    context.lineWidth = 2 * ratio;
    for (const { centre, radius } of burrBalls(poses, tool)) {
      const seen = at(centre);
      if (!seen) continue;
      context.beginPath();
      context.arc(seen[0], seen[1], Math.max(2 * ratio, radius * pixelsPerMetre(projection, seen[2]) * scale), 0, 7);
      context.stroke();
    }
    context.fillStyle = css(COLOURS.burr);
    context.beginPath();
    context.arc(tip[0], tip[1], 1.8 * ratio, 0, 7);
    context.fill();
  }

  #drawCross({ context, at, ratio }, point) {
    const place = at(point);
    if (!place) return;
    const [x, y] = place;
    context.strokeStyle = "rgb(120 230 160)";
    context.lineWidth = ratio;
    context.beginPath();
    for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      context.moveTo(x + dx * 6 * ratio, y + dy * 6 * ratio);
      context.lineTo(x + dx * 18 * ratio, y + dy * 18 * ratio);
    }
    context.stroke();
  }

  /** Returns the point under the pointer, in the plane parallel to the detector through the cross-hair. @param {PointerEvent} event @returns {Vector | undefined} */
  pointOf(event) {
    const { frame } = this;
    const middle = this.cursor.point ?? this.model.info?.c_arm?.isocentre_m;
    const depth = frame && middle && project(frame.projection, middle)?.[2];
    if (!depth) return undefined;
    const { scale, left, top } = this.#fit(this.canvas.clientWidth, this.canvas.clientHeight);
    const { columns, rows } = this.#size();
    const [column, row] = [(event.offsetX - left) / scale, (event.offsetY - top) / scale];
    if (column < 0 || row < 0 || column > columns || row > rows) return undefined;
    return unproject(frame.projection, column - 0.5, row - 0.5, depth);
  }

  /** A click moves the cross-hair or measures; drags adjust the window and are handled by the X-ray
   * itself. */
  #listen() {
    const { canvas } = this.xRay;
    let travelled = 0;
    canvas.addEventListener("pointerdown", () => (travelled = 0));
    canvas.addEventListener("pointermove", (event) => (travelled += Math.abs(event.movementX) + Math.abs(event.movementY)));
    canvas.addEventListener("click", (event) => {
      const point = travelled < CLICK_PX ? this.pointOf(/** @type {PointerEvent} */ (event)) : undefined;
      if (!point) return;
      if (this.measures.on) this.measures.add(point);
      else this.cursor.place(point);
    });
  }
}
