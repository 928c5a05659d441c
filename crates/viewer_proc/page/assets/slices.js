// The slices panel: the planes shown, requests to the viewer, pointer and keys.

import { placeText } from "/assets/guidance.js";
import { CLICK_PX } from "/assets/measure.js";
import { normal } from "/assets/slice_geometry.js";
import { SliceTile } from "/assets/slice_tile.js";
import { add, scale } from "/assets/vector.js";

/** @typedef {import("/assets/vector.js").Vector} Vector */

/** An element of `index.html`, of a kind known here. @param {string} id @returns {any} */
const element = (id) => document.getElementById(id);
/** Minimum time between two drawings of the slices: 16 per second, so that the 3D view stays smooth. */
const DRAW_MS = 60;
/** The tool is redrawn when a part of it has moved by this many page pixels. */
const VISIBLE_PX = 0.5;
/** Minimum time between two requests for the same slice. */
const ASK_MS = 150;
/** Delay before a refused request is repeated. */
const AGAIN_MS = 700;
const FIELD_M = [0.01, 0.6];
const STEP_M = 0.0005;
/** Hounsfield windows: level and width as used in radiology. */
export const HU_WINDOWS = { bone: { low: -200, width: 1500 }, "soft tissue": { low: -160, width: 400 }, all: { low: -1000, width: 4000 } };
const LEAST_WIDTH = 20;

export class Slices {
  /**
   * @param {import("/assets/model.js").Model} model @param {import("/assets/cursor.js").Cursor} cursor
   * @param {import("/assets/measure.js").Measures} measures
   * @param {(request: object) => Promise<any>} ask a `/slice` request @param {() => void} changed
   */
  constructor(model, cursor, measures, ask, changed) {
    this.model = model;
    this.cursor = cursor;
    this.measures = measures;
    this.ask = ask;
    this.changed = changed;
    /** @type {SliceTile[]} */
    this.tiles = [];
    /** Points of a plan that can be moved. @type {import("/assets/plan_edit.js").PlanEdit | undefined} */
    this.edit = undefined;
    /** @type {import("/assets/structures.js").Structures | undefined} */
    this.structures = undefined;
    this.on = true;
    this.field = 0.08;
    this.window = { ...HU_WINDOWS.bone };
    /** Why there is no image. */
    this.refused = "";
    this.asked = 0;
    this.drawnAt = 0;
    /** Time of the next request if nothing else triggers one. */
    this.due = Infinity;
    /** @type {ReturnType<typeof setTimeout> | undefined} */
    this.coming = undefined;
    /** State shown in the images. */
    this.key = "";
    /** Number of images drawn. */
    this.pictures = 0;
    element("slice-window").addEventListener("change", (event) => this.setWindow({ ...HU_WINDOWS[event.target.value] }));
  }

  /** Sets up the planes of a new scene. */
  takeInfo() {
    // Until the volume is loaded, or if it is not that of the log, there is nothing to slice.
    const slices = this.model.info?.volume ? this.model.info.slices : undefined;
    const key = JSON.stringify(slices ?? null);
    if (key !== this.made) {
      this.made = key;
      element("slice-tiles").replaceChildren();
      this.tiles = (slices?.planes ?? []).map((view) => this.#listen(new SliceTile(element("slice-tiles"), view, slices)));
    }
    // A moved pilot hole changes the image of the same plane.
    const holes = JSON.stringify(this.model.info?.scene?.predrill ?? []);
    if (holes !== this.holes) this.tiles.forEach((tile) => (tile.key = ""));
    this.holes = holes;
    this.refused = "";
    this.show();
  }

  /** Whether there is anything to show. */
  get there() {
    return this.tiles.length > 0;
  }

  toggle() {
    this.on = !this.on;
    this.show();
  }

  show() {
    const shown = this.on && this.there;
    document.body.classList.toggle("with-slices", shown);
    element("slices").hidden = !shown;
    element("slices-switch").hidden = !this.there;
    element("slices-switch").setAttribute("aria-pressed", String(shown));
    this.key = "";
    this.changed();
  }

  /** @param {import("/assets/slice_tile.js").HuWindow} window */
  setWindow(window) {
    this.window = { low: window.low, width: Math.max(LEAST_WIDTH, Math.min(65535, window.width)) };
    for (const tile of this.tiles) tile.paint(this.window);
    this.changed();
  }

  zoom(factor) {
    this.field = Math.max(FIELD_M[0], Math.min(FIELD_M[1], this.field * factor));
    this.changed();
  }

  /** Scrolls through the slices. @param {SliceTile} tile @param {number} metres */
  #through(tile, metres) {
    const { point } = this.cursor;
    if (point) this.cursor.place(add(point, scale(normal({ centre: point, ...tile.view }), metres)));
  }

  /** Schedules a redraw, unless an earlier one is due. @param {number} milliseconds */
  #later(milliseconds) {
    const due = performance.now() + milliseconds;
    if (this.due <= due) return;
    clearTimeout(this.coming);
    this.due = due;
    this.coming = setTimeout(() => ((this.due = Infinity), this.changed()), milliseconds);
  }

  /** Draws what has changed, no more often than is visible. */
  draw() {
    if (!this.on || !this.there) return;
    const { model, cursor } = this;
    cursor.tip(model.tip);
    const point = cursor.point ?? model.info?.scene?.burr_start_m;
    if (!point) return;
    const now = performance.now();
    if (now < this.drawnAt + DRAW_MS) return this.#later(this.drawnAt + DRAW_MS - now);
    this.drawnAt = now;
    const { poses, info } = model;
    const planes = this.tiles.map((tile) => (tile.measure(), tile.planeAt(point, this.field)));
    planes.forEach((plane, i) => this.#request(this.tiles[i], plane));
    const structures = this.structures?.shown ?? [];
    const key = [this.#key(planes, poses), this.structures?.version, structures.map(({ colour }) => colour)].join();
    if (key === this.key) return;
    this.key = key;
    this.pictures += 1;
    const scene = { poses, tool: info?.tool, path: info?.scene?.planned_path_m ?? [], target: info?.scene?.target_m, cursor: cursor.point, measures: this.measures, handles: this.edit?.handles ?? [], structures };
    planes.forEach((plane, i) => this.tiles[i].draw(plane, this.field, scene));
    this.#facts(point);
  }

  /** Everything that the images depend on; points are rounded to visible steps. @param {import("/assets/slice_geometry.js").Plane[]} planes @param {import("/assets/tool_model.js").Poses | undefined} poses */
  #key(planes, poses) {
    const step = (VISIBLE_PX * this.field) / Math.max(...this.tiles.map((tile) => tile.size[0]));
    /** @param {Vector | undefined} point */
    const place = (point) => point?.map((x) => Math.round(x / step));
    const tool = poses ? [poses.base, ...poses.links, poses.burr].map((pose) => place(pose.position)) : [];
    const tiles = this.tiles.map((tile, i) => [tile.version, ...tile.size, tile.ratio, place(planes[i].centre)]);
    const { low, width } = this.window;
    return [this.made, this.edit?.version, this.refused, this.field, low, width, this.measures.version, this.cursor.follows, place(this.cursor.point), tool, tiles].join();
  }

  /** Requests a tile's image if the current one is outdated or missing; one request per tile at a time. */
  #request(tile, plane) {
    const request = tile.request(plane, this.field);
    const key = JSON.stringify([request, this.model.removed]);
    const now = performance.now();
    const wait = tile.askedAt + (this.refused ? AGAIN_MS : ASK_MS) - now;
    if (tile.key === key || tile.asking) return;
    if (wait > 0) return this.#later(wait);
    tile.asking = true;
    tile.askedAt = now;
    this.asked += 1;
    this.ask(request).then((answer) => {
      tile.asking = false;
      this.refused = answer.bytes ? "" : (answer.error ?? "no slice received");
      if (answer.bytes) {
        tile.key = key;
        tile.take(request, answer.bytes, this.window);
      }
      this.changed();
    });
  }

  #facts(point) {
    const values = this.tiles.map((tile) => tile.valueAt(point)).filter((value) => value !== undefined);
    const { low, width } = this.window;
    const facts = this.refused || `${placeText(point)} mm${values.length > 0 ? `, ${values[0]}` : ""}; window ${Math.round(low)} to ${Math.round(low + width)} HU`;
    const place = element("slice-facts");
    if (place.textContent !== facts) place.textContent = facts;
    element("slices-follow").setAttribute("aria-pressed", String(this.cursor.follows));
    for (const tile of this.tiles) if (tile.caption.textContent !== tile.view.name) tile.caption.textContent = tile.view.name;
    const preset = Object.entries(HU_WINDOWS).find(([, one]) => one.low === low && one.width === width);
    const list = element("slice-window");
    if (list.value !== (preset?.[0] ?? "own")) list.value = preset?.[0] ?? "own";
  }

  /** @param {SliceTile} tile */
  #listen(tile) {
    const { canvas } = tile;
    this.edit?.listenToSlice(tile, () => this.field);
    let [pressed, travelled] = [-1, 0];
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      [pressed, travelled] = [event.shiftKey ? 2 : event.button, 0];
      if (pressed === 0 && !this.measures.on) this.cursor.place(tile.pointOf(event, this.field));
    });
    canvas.addEventListener("pointermove", (event) => {
      if (pressed < 0) return;
      travelled += Math.abs(event.movementX) + Math.abs(event.movementY);
      if (pressed === 2) this.#adjust(event.movementY, event.movementX);
      else if (pressed === 0 && !this.measures.on) this.cursor.place(tile.pointOf(event, this.field));
    });
    canvas.addEventListener("pointerup", (event) => {
      if (pressed === 0 && this.measures.on && travelled < CLICK_PX) this.measures.add(tile.pointOf(event, this.field));
      pressed = -1;
    });
    canvas.addEventListener("pointercancel", () => (pressed = -1));
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      if (event.ctrlKey) this.zoom(Math.exp(event.deltaY * 0.002));
      else this.#through(tile, Math.sign(event.deltaY) * STEP_M);
    }, { passive: false });
    canvas.addEventListener("dblclick", () => this.setWindow({ ...HU_WINDOWS.bone }));
    canvas.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || !this.#press(tile, event)) return;
      event.preventDefault();
      event.stopPropagation();
    });
    return tile;
  }

  /** Moves level and width by a drag, in pixels. */
  #adjust(down, right) {
    const { low, width } = this.window;
    const level = low + width / 2 + down * width * 0.004;
    const wide = Math.max(LEAST_WIDTH, width * Math.exp(right * 0.006));
    this.setWindow({ low: level - wide / 2, width: wide });
  }

  /** @param {SliceTile} tile @param {KeyboardEvent} event */
  #press(tile, event) {
    const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    const arrow = arrows[event.key];
    const { point } = this.cursor;
    if (arrow && event.shiftKey) this.#adjust(arrow[1] * 10, arrow[0] * 10);
    else if (arrow && point) this.cursor.place(add(point, add(scale(tile.view.right, arrow[0] * STEP_M), scale(tile.view.down, arrow[1] * STEP_M))));
    else if (event.key === "PageUp") this.#through(tile, -STEP_M);
    else if (event.key === "PageDown") this.#through(tile, STEP_M);
    else if (event.key === "Enter" && this.measures.on && point) this.measures.add(point);
    else return false;
    return true;
  }
}
