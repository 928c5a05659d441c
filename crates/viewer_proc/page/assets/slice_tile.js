// One slice: the newest image of a plane, and the overlay on it.

import { distanceText } from "/assets/measure.js";
import { cutBall, cutCylinder, cutMesh, normal, place, pointAt } from "/assets/slice_geometry.js";
import { textScale } from "/assets/plot.js";
import { drawHandles } from "/assets/plan_edit.js";
import { context2d } from "/assets/software.js";
import { COLOURS, burrBalls, holderFront } from "/assets/tool_model.js";
import { add, dot, scale, subtract, transform } from "/assets/vector.js";

/** @typedef {import("/assets/vector.js").Vector} Vector */
/** @typedef {import("/assets/slice_geometry.js").Plane} Plane */
/** @typedef {{plane: Plane, side: [number, number], columns: number, rows: number, removed: number, values: Int16Array}} Picture */
/** @typedef {{low: number, width: number}} HuWindow */

const MAGIC = 0x434c5354;
const HEADER_BYTES = 24;
/** Minimum of a 16-bit integer, negated. */
const LEAST = 32768;
/** Distance from the plane within which a path is drawn as lying in it. */
const NEAR_M = 0.0015;
/** Planes are requested in steps of this size along their normal. */
const STEP_M = 0.0001;
/** The cross-hair stays within this fraction of the image's half size. */
const INNER = 0.7;
const DRILLED_RGB = [178, 128, 20];
const OUTSIDE_RGB = [92, 98, 106];

/** @param {import("/assets/parts_list.js").Colour} colour */
const css = ([r, g, b]) => `rgb(${[r, g, b].map((part) => Math.round(part * 255)).join(" ")})`;

/** Decodes a `trabecula.slice` message. @param {DataView} data @returns {Omit<Picture, "plane" | "side">} */
export function decodeSlice(data) {
  if (data.getUint32(0, true) !== MAGIC || data.getUint32(4, true) !== 1) throw new Error("unsupported slice format");
  const [columns, rows] = [data.getUint32(8, true), data.getUint32(12, true)];
  const from = data.byteOffset + HEADER_BYTES;
  const values = new Int16Array(data.buffer.slice(from, from + 2 * columns * rows));
  return { columns, rows, removed: Number(data.getBigUint64(16, true)), values };
}

/** An opaque canvas pixel, in native byte order. @param {number[]} rgb */
const pixel = ([r, g, b]) => new Uint32Array(new Uint8ClampedArray([r, g, b, 255]).buffer)[0];
/** Pixel of every value from the lowest 16-bit integer on, for one window at a time. */
const table = { key: "", pixels: new Uint32Array(2 * LEAST) };

/** @param {HuWindow} hu @param {{outside: number, drilled: number}} limits */
function greys({ low, width }, { outside, drilled }) {
  const key = [low, width, outside, drilled].join();
  if (table.key !== key) {
    table.key = key;
    const levels = Array.from({ length: 256 }, (_, level) => pixel([level, level, level]));
    table.pixels.forEach((_, i) => {
      table.pixels[i] = levels[Math.round(Math.max(0, Math.min(1, (i - LEAST - low) / width)) * 255)];
    });
    table.pixels[drilled + LEAST] = pixel(DRILLED_RGB);
    table.pixels[outside + LEAST] = pixel(OUTSIDE_RGB);
  }
  return table.pixels;
}

export class SliceTile {
  /**
   * @param {HTMLElement} parent @param {{name: string, right: Vector, down: Vector, letters: string[] | null}} view of `/view/info`
   * @param {{outside: number, drilled: number, most_pixels: number}} limits
   */
  constructor(parent, view, limits) {
    this.view = view;
    this.limits = limits;
    this.element = parent.appendChild(document.createElement("figure"));
    this.element.className = "slice";
    this.canvas = this.element.appendChild(document.createElement("canvas"));
    this.canvas.id = `slice-${view.name.replaceAll(" ", "-")}`;
    this.canvas.tabIndex = 0;
    this.canvas.setAttribute("role", "application");
    this.canvas.setAttribute("aria-label", `CT, ${view.name}. Arrow keys move the cross-hair, Page up and Page down scroll through the slices.`);
    this.caption = this.element.appendChild(document.createElement("figcaption"));
    this.picture = document.createElement("canvas");
    this.layer = document.createElement("canvas");
    /** @type {Picture | undefined} */
    this.shown = undefined;
    /** Centre of the image. @type {Vector | undefined} */
    this.centre = undefined;
    this.asking = false;
    this.askedAt = 0;
    this.key = "";
    /** Incremented when the image changes. */
    this.version = 0;
    /** Canvas size in page pixels, and screen pixels per page pixel. */
    this.size = [1, 1];
    this.ratio = 1;
  }

  /** Measures the canvas: once per frame, because this can force the browser to lay out the page. */
  measure() {
    this.size = [this.canvas.clientWidth || 1, this.canvas.clientHeight || 1];
    this.ratio = Math.min(window.devicePixelRatio || 1, 2);
  }

  /** Returns the plane through the cross-hair; its centre moves only if the cross-hair would leave the image. @param {Vector} point @param {number} field metres */
  planeAt(point, field) {
    const { right, down } = this.view;
    const half = [field / 2, (field / 2) * this.aspect];
    const centre = this.centre ?? point;
    const away = subtract(point, centre);
    const off = [dot(away, right), dot(away, down)];
    const moved = off.map((distance, i) => Math.sign(distance) * Math.max(0, Math.abs(distance) - INNER * half[i]));
    this.centre = add(centre, add(scale(right, moved[0]), scale(down, moved[1])));
    const n = normal({ centre, right, down });
    // A tool that trembles at the edge of a step would request two planes in turn: a plane stays until the
    // cross-hair is a step away.
    if (Math.abs(dot(subtract(point, this.centre), n)) > STEP_M) {
      const behind = Math.round(dot(point, n) / STEP_M) * STEP_M - dot(this.centre, n);
      this.centre = add(this.centre, scale(n, behind));
    }
    return { centre: this.centre, right, down };
  }

  get aspect() {
    return this.size[1] / this.size[0];
  }

  /** Returns the request to the server. @param {Plane} plane @param {number} field */
  request(plane, field) {
    const size = this.size.map((n) => n * this.ratio);
    const fit = Math.min(1, this.limits.most_pixels / Math.max(...size));
    const [columns, rows] = size.map((n) => Math.max(1, Math.round(n * fit)));
    return { centre_m: plane.centre, right: plane.right, down: plane.down, side_m: [field, field * this.aspect], columns, rows };
  }

  /** @param {ReturnType<SliceTile["request"]>} request @param {DataView} answer @param {HuWindow} hu */
  take(request, answer, hu) {
    const plane = { centre: request.centre_m, right: request.right, down: request.down };
    this.shown = { plane, side: /** @type {[number, number]} */ (request.side_m), ...decodeSlice(answer) };
    this.paint(hu);
  }

  /** Converts the newest image to grey levels. @param {HuWindow} hu */
  paint(hu) {
    if (!this.shown) return;
    const { columns, rows, values } = this.shown;
    Object.assign(this.picture, { width: columns, height: rows });
    const context = context2d(this.picture);
    const image = context.createImageData(columns, rows);
    const pixels = new Uint32Array(image.data.buffer);
    const table = greys(hu, this.limits);
    for (let i = 0; i < values.length; i++) pixels[i] = table[values[i] + LEAST];
    context.putImageData(image, 0, 0);
    this.version += 1;
  }

  /** Returns the newest image's Hounsfield units at a point; undefined outside the image, a text if there is no number. @param {Vector} point */
  valueAt(point) {
    if (!this.shown) return undefined;
    const { plane, side, columns, rows, values } = this.shown;
    const [right, down] = place(plane, point);
    const column = Math.floor((right / side[0] + 0.5) * columns);
    const row = Math.floor((down / side[1] + 0.5) * rows);
    if (column < 0 || row < 0 || column >= columns || row >= rows) return undefined;
    const value = values[row * columns + column];
    if (value === this.limits.outside) return "outside the CT";
    return value === this.limits.drilled ? "drilled" : `${value} HU`;
  }

  /** Returns the point under the pointer. @param {{offsetX: number, offsetY: number}} event @param {number} field @returns {Vector} */
  pointOf(event, field, behind = 0) {
    const { right, down } = this.view;
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const perPixel = field / (width || 1);
    const plane = { centre: this.centre ?? [0, 0, 0], right, down };
    const point = pointAt(plane, [(event.offsetX - width / 2) * perPixel, (event.offsetY - height / 2) * perPixel]);
    return behind ? add(point, scale(normal(plane), behind)) : point;
  }

  /** Projects a point, page pixels. @param {Vector} point @param {number} field */
  pixelOf(point, field) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const [right, down] = place({ centre: this.centre ?? [0, 0, 0], ...this.view }, point);
    return [width / 2 + (right * width) / field, height / 2 + (down * width) / field];
  }

  /**
   * @param {Plane} plane @param {number} field
   * @param {{poses?: import("/assets/tool_model.js").Poses, tool?: any, path: Vector[], target?: Vector, cursor?: Vector,
   *   measures: import("/assets/measure.js").Measures, handles: import("/assets/plan_edit.js").Handle[],
   *   structures: import("/assets/structures.js").Structures["shown"]}}
   *   scene
   */
  draw(plane, field, scene) {
    const { ratio } = this;
    const [width, height] = this.size.map((n) => Math.max(1, Math.round(n * ratio)));
    for (const canvas of [this.canvas, this.layer]) if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    const context = context2d(this.canvas);
    context.fillStyle = `rgb(${OUTSIDE_RGB.join(" ")})`;
    context.fillRect(0, 0, width, height);
    const scaleBy = width / field;
    /** @param {Vector} point @returns {[number, number, number]} pixels, and metres behind the plane */
    const at = (point) => {
      const [right, down, behind] = place(plane, point);
      return [width / 2 + right * scaleBy, height / 2 + down * scaleBy, behind];
    };
    this.#drawPicture(context, at, scaleBy);
    // Letters and lines scale with the page's text.
    const mark = ratio * textScale();
    const paint = { context, at, ratio: mark, scaleBy, width, height, plane };
    for (const { mesh, colour } of scene.structures) this.#drawStructure(paint, mesh, css(colour));
    if (scene.poses && scene.tool) this.#drawTool(paint, scene.poses, scene.tool);
    this.#drawPath(paint, scene.path);
    if (scene.target) this.#drawTarget(paint, scene.target);
    this.#drawMeasures(paint, scene.measures);
    if (scene.cursor) this.#drawCross(paint, scene.cursor);
    drawHandles(context, scene.handles, at, mark);
    this.#drawLetters(paint);
  }

  #drawPicture(context, at, scaleBy) {
    if (!this.shown) return;
    const { plane, side } = this.shown;
    const [x, y] = at(plane.centre);
    const [w, h] = [side[0] * scaleBy, side[1] * scaleBy];
    context.imageSmoothingEnabled = true;
    context.drawImage(this.picture, x - w / 2, y - h / 2, w, h);
  }

  /** Outlines where the plane cuts a structure. */
  #drawStructure({ context, plane, ratio, scaleBy, width, height }, mesh, colour) {
    const outline = new Path2D();
    for (const ends of cutMesh(plane, mesh)) {
      const [[x0, y0], [x1, y1]] = ends.map(([right, down]) => [width / 2 + right * scaleBy, height / 2 + down * scaleBy]);
      outline.moveTo(x0, y0);
      outline.lineTo(x1, y1);
    }
    context.lineCap = "round";
    for (const [style, size] of [["rgb(0 0 0 / .6)", 4], [colour, 2]]) {
      context.strokeStyle = /** @type {string} */ (style);
      context.lineWidth = /** @type {number} */ (size) * ratio;
      context.stroke(outline);
    }
    context.lineCap = "butt";
  }

  /** Outlines where the plane cuts the holder, shaft and links together, and the burr. */
  #drawTool({ context, plane, ratio, scaleBy, width, height }, poses, tool) {
    const cylinders = [{ from: poses.base.position, to: transform(poses.base, [0, 0, tool.shaft?.length_m ?? 0]), radius: tool.shaft?.radius_m ?? 0.003 }];
    const front = holderFront(poses, tool);
    if (front) cylinders.push({ from: front, to: poses.base.position, radius: tool.shaft?.radius_m ?? 0.003 });
    const holder = front ? cutCylinder(plane, poses.flange.position, front, tool.holder.radius_m) : [];
    poses.links.forEach((pose, i) => {
      const link = tool.links?.[i];
      if (link) cylinders.push({ from: pose.position, to: transform(pose, [0, 0, link.length_m]), radius: link.outer_radius_m });
    });
    const pixels = ([right, down]) => [width / 2 + right * scaleBy, height / 2 + down * scaleBy];
    /** @param {Vector} centre @param {number} radius */
    const ball = (centre, radius) => {
      const cut = cutBall(plane, centre, radius);
      return cut ? [circle(pixels(cut.at), cut.radius * scaleBy)] : [];
    };
    const body = cylinders.flatMap(({ from, to, radius }) => {
      const corners = cutCylinder(plane, from, to, radius);
      // A ball at the joint closes the gap opened by a bend.
      return [...(corners.length > 0 ? [polygon(corners.map(pixels))] : []), ...ball(from, radius)];
    });
    if (holder.length > 0) this.#outline(context, [polygon(holder.map(pixels))], css(COLOURS.shaft), ratio);
    this.#outline(context, body, css(COLOURS.linkOdd), ratio);
    const burr = burrBalls(poses, tool).flatMap(({ centre, radius }) => ball(centre, radius));
    this.#outline(context, burr, css(COLOURS.burr), ratio);
  }

  /** Outlines a union: strokes its parts, then erases the inside of each. @param {Path2D[]} parts */
  #outline(context, parts, colour, ratio) {
    if (parts.length === 0) return;
    const layer = context2d(this.layer);
    layer.clearRect(0, 0, this.layer.width, this.layer.height);
    layer.globalCompositeOperation = "source-over";
    layer.lineJoin = "round";
    for (const [style, size] of [["rgb(0 0 0 / .6)", 6], [colour, 4]]) {
      layer.strokeStyle = /** @type {string} */ (style);
      layer.lineWidth = /** @type {number} */ (size) * ratio;
      for (const part of parts) layer.stroke(part);
    }
    layer.globalCompositeOperation = "destination-out";
    for (const part of parts) layer.fill(part);
    context.drawImage(this.layer, 0, 0);
  }

  /** Draws the path solid where it lies in the plane and dashed in front of or behind it. */
  #drawPath({ context, at, ratio }, path) {
    if (path.length < 2) return;
    const points = path.map(at);
    context.strokeStyle = css(COLOURS.planned);
    let from = 0;
    while (from + 1 < points.length) {
      const near = Math.abs(points[from + 1][2]) <= NEAR_M;
      let to = from + 1;
      while (to + 1 < points.length && Math.abs(points[to + 1][2]) <= NEAR_M === near) to += 1;
      context.beginPath();
      for (let i = from; i <= to; i++) context.lineTo(points[i][0], points[i][1]);
      context.setLineDash(near ? [] : [4 * ratio, 4 * ratio]);
      context.lineWidth = (near ? 2 : 1.4) * ratio;
      context.stroke();
      from = to;
    }
    context.setLineDash([]);
  }

  #drawTarget({ context, at, ratio }, target) {
    const [x, y, behind] = at(target);
    context.globalAlpha = Math.abs(behind) <= NEAR_M ? 1 : 0.45;
    context.strokeStyle = css(COLOURS.target);
    context.lineWidth = 2 * ratio;
    context.beginPath();
    context.arc(x, y, 4 * ratio, 0, 7);
    for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      context.moveTo(x + dx * 3 * ratio, y + dy * 3 * ratio);
      context.lineTo(x + dx * 9 * ratio, y + dy * 9 * ratio);
    }
    context.stroke();
    context.globalAlpha = 1;
  }

  #drawMeasures({ context, at, ratio }, measures) {
    drawMeasures(context, measures, at, ratio);
  }

  /** The cross-hair, with an open centre. */
  #drawCross({ context, at, ratio, width, height }, cursor) {
    const [x, y] = at(cursor);
    const gap = 9 * ratio;
    context.strokeStyle = "rgb(120 230 160 / .8)";
    context.lineWidth = ratio;
    context.beginPath();
    for (const [x0, y0, x1, y1] of [[0, y, x - gap, y], [x + gap, y, width, y], [x, 0, x, y - gap], [x, y + gap, x, height]]) {
      context.moveTo(x0, y0);
      context.lineTo(x1, y1);
    }
    context.stroke();
  }

  #drawLetters({ context, ratio, width, height, scaleBy }) {
    const [left, right, upper, lower] = this.view.letters ?? ["", "feed", "", ""];
    context.font = `600 ${12 * ratio}px system-ui, sans-serif`;
    context.textBaseline = "middle";
    const letter = (text, x, y, align) => {
      context.textAlign = align;
      outlined(context, text, x, y, "#fff", ratio);
    };
    letter(left, 6 * ratio, height / 2, "left");
    letter(right, width - 6 * ratio, height / 2, "right");
    letter(upper, width / 2, 10 * ratio, "center");
    letter(lower, width / 2, height - 10 * ratio, "center");
    if (!this.view.letters) letter("bend ↑", width - 6 * ratio, 12 * ratio, "right");
    const bar = 0.01 * scaleBy;
    context.fillStyle = "#fff";
    context.fillRect(width - 8 * ratio - bar, height - 8 * ratio, bar, 2 * ratio);
    letter("10 mm", width - 8 * ratio, height - 17 * ratio, "right");
  }
}

/** @param {number[]} middle @param {number} radius */
function circle([x, y], radius) {
  const path = new Path2D();
  path.arc(x, y, radius, 0, 2 * Math.PI);
  path.closePath();
  return path;
}

/** @param {number[][]} corners */
function polygon(corners) {
  const path = new Path2D();
  for (const [x, y] of corners) path.lineTo(x, y);
  path.closePath();
  return path;
}

/** Draws a text that is readable on any background. */
export function outlined(context, text, x, y, colour, ratio) {
  context.lineWidth = 3 * ratio;
  context.lineJoin = "round";
  context.strokeStyle = "rgb(0 0 0 / .75)";
  context.strokeText(text, x, y);
  context.fillStyle = colour;
  context.fillText(text, x, y);
}

/**
 * Draws distances over an image. @param {CanvasRenderingContext2D} context @param
 * {import("/assets/measure.js").Measures} measures
 * @param {(point: Vector) => number[] | undefined} at pixels of a point; undefined: not visible @param {number} ratio
 */
export function drawMeasures(context, measures, at, ratio) {
  /** @param {number[]} place */
  const ends = (place) => {
    context.beginPath();
    context.arc(place[0], place[1], 3 * ratio, 0, 7);
    context.stroke();
  };
  context.font = `600 ${12 * ratio}px system-ui, sans-serif`;
  context.textAlign = "center";
  context.textBaseline = "bottom";
  const stroked = (draw) => {
    for (const [style, width] of [["rgb(0 0 0 / .7)", 4], ["#ffe14d", 2]]) {
      context.strokeStyle = /** @type {string} */ (style);
      context.lineWidth = /** @type {number} */ (width) * ratio;
      draw();
    }
  };
  for (const { from, to } of measures.lines) {
    const [a, b] = [at(from), at(to)];
    if (!a || !b) continue;
    stroked(() => {
      context.beginPath();
      context.moveTo(a[0], a[1]);
      context.lineTo(b[0], b[1]);
      context.stroke();
      ends(a);
      ends(b);
    });
    outlined(context, distanceText(from, to), (a[0] + b[0]) / 2, (a[1] + b[1]) / 2 - 4 * ratio, "#ffe14d", ratio);
  }
  const begun = measures.begun && at(measures.begun);
  if (begun) stroked(() => ends(begun));
}
