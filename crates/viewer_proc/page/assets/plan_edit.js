// Points of a scene before its run, moved by hand: burr start, target, isocentre. The server computes the
// consequences.

import { cameraRay, nearest } from "/assets/pick.js";
import { place as planePlace } from "/assets/slice_geometry.js";
import { outlined } from "/assets/slice_tile.js";
import { COLOURS } from "/assets/tool_model.js";
import { add, dot, scale, subtract, unit } from "/assets/vector.js";

/** @typedef {import("/assets/vector.js").Vector} Vector */
/** @typedef {"burr_start_mm" | "target_mm" | "isocentre_mm"} PlaceName */
/** @typedef {{name: PlaceName, label: string, colour: string, point: Vector}} Handle */

/** An element of `index.html`, of a kind known here. @param {string} id @returns {any} */
const element = (id) => document.getElementById(id);
/** @param {import("/assets/parts_list.js").Colour} colour */
const css = ([r, g, b]) => `rgb(${[r, g, b].map((part) => Math.round(part * 255)).join(" ")})`;
/** Name, label and colour of the movable points. @type {[PlaceName, string, string][]} */
const PLACES = [
  ["burr_start_mm", "burr start", css(COLOURS.burr)],
  ["target_mm", "target", css(COLOURS.target)],
  ["isocentre_mm", "isocentre", css(COLOURS.cursor)],
];
/** Patient directions in which the coordinates increase. */
const AXES = ["left", "posterior", "head"];
/** A pointer within this distance picks a handle, pixels. */
const GRAB_PX = 13;
const RADIUS_PX = 7;
/** A handle farther than this from a slice is drawn faintly, metres. */
const NEAR_M = 0.0015;
const STEP_MM = 0.5;

/** @param {number[]} place mm @returns {Vector} metres */
const metres = (place) => /** @type {Vector} */ (place.map((x) => x * 1e-3));
/** Rounds to a micrometre, like a scene file. @param {Vector} point metres */
const millimetres = (point) => point.map((x) => Math.round(x * 1e6) / 1e3);

export class PlanEdit {
  /**
   * @param {(request: object) => Promise<any>} ask a `/plan` request @param {() => void} changed
   * @param {import("/assets/cursor.js").Cursor} cursor
   */
  constructor(ask, changed, cursor) {
    this.ask = ask;
    this.changed = changed;
    this.cursor = cursor;
    /** Points as known to the server, mm. @type {Record<PlaceName, number[]> | undefined} */
    this.places = undefined;
    /** Moves not yet known to the server. @type {Map<PlaceName, number[]>} */
    this.moved = new Map();
    this.asking = false;
    /** Whether there are unsaved moves. */
    this.dirty = false;
    /** @type {PlaceName | undefined} */
    this.dragged = undefined;
    /** Incremented when a handle moves. */
    this.version = 0;
    this.#fill();
  }

  /** Whether there is anything to move. */
  get there() {
    return !!this.places;
  }

  /** @returns {Handle[]} */
  get handles() {
    const { places } = this;
    if (!places) return [];
    return PLACES.filter(([name]) => places[name]).map(([name, label, colour]) => ({ name, label, colour, point: metres(this.moved.get(name) ?? places[name]) }));
  }

  /** @param {any} info of `/view/info` */
  takeInfo(info) {
    this.places = info?.plan?.places;
    this.version += 1;
    for (const [name] of PLACES) {
      const place = this.moved.get(name) ?? this.places?.[name];
      element(`place-${name}`).hidden = !place;
      this.#inputs(name).forEach((input, axis) => {
        if (place && document.activeElement !== input) input.value = place[axis].toFixed(3).replace(/\.?0+$/, "");
      });
    }
  }

  /** Moves a point. Requests to the server are sent one at a time. @param {PlaceName} name @param {number[]} place mm */
  move(name, place) {
    if (!place.every(Number.isFinite)) return;
    this.moved.set(name, place);
    this.version += 1;
    this.changed();
    this.#send();
  }

  async #send() {
    if (this.asking || this.moved.size === 0) return;
    this.asking = true;
    const sent = new Map(this.moved);
    const answer = await this.ask({ action: "move", places: Object.fromEntries(sent) });
    this.asking = false;
    // Points moved further in the meantime are sent next. A refused move is reverted.
    for (const [name, place] of sent) if (this.moved.get(name) === place) this.moved.delete(name);
    this.say(answer.ok ? "" : answer.error);
    if (answer.ok) this.dirty = true;
    else this.version += 1;
    this.showButtons();
    this.changed();
    this.#send();
  }

  async restore() {
    this.moved.clear();
    const answer = await this.ask({ action: "restore" });
    if (answer.ok) this.dirty = false;
    this.say(answer.ok ? "" : answer.error);
    this.showButtons();
  }

  /** Writes the scene next to its file; asks before overwriting a file. @param {string} name @param {(question: string, act: () => void) => void} confirmed */
  async save(name, confirmed, replace = false) {
    const answer = await this.ask({ action: "save", name, replace });
    if (answer.exists) return confirmed(`${answer.error}. Overwrite it?`, () => this.save(name, confirmed, true));
    if (answer.ok) this.dirty = false;
    this.say(answer.ok ? `saved: ${answer.path}` : answer.error, answer.ok);
    this.showButtons();
  }

  async run() {
    const answer = await this.ask({ action: "run" });
    this.say(answer.ok ? "starting the run…" : answer.error, answer.ok);
  }

  /** @param {string} text @param {boolean} [good] */
  say(text, good = false) {
    const place = element("plan-said");
    place.textContent = text ?? "";
    place.classList.toggle("error", !!text && !good);
  }

  showButtons() {
    element("plan-restore").disabled = !this.dirty;
    element("plan-run").title = this.dirty ? "save the plan first" : "runs the scene's file";
    element("plan-state").textContent = this.dirty ? "unsaved changes" : "";
  }

  /** @param {PlaceName} name @returns {HTMLInputElement[]} */
  #inputs(name) {
    return AXES.map((_, axis) => element(`${name}-${axis}`));
  }

  /** Builds a row of numbers for each point. */
  #fill() {
    for (const [name, label, colour] of PLACES) {
      const row = element("plan-places").appendChild(document.createElement("tr"));
      row.id = `place-${name}`;
      row.hidden = true;
      const head = row.appendChild(document.createElement("th"));
      head.scope = "row";
      head.textContent = label;
      head.style.borderLeft = `4px solid ${colour}`;
      AXES.forEach((axis, i) => {
        const input = document.createElement("input");
        Object.assign(input, { type: "number", step: String(STEP_MM), id: `${name}-${i}`, ariaLabel: `${label}, mm, ${axis}` });
        // An empty field is not a number; the user may still be typing.
        input.addEventListener("input", () => input.value !== "" && this.move(name, this.#inputs(name).map((one) => Number(one.value))));
        input.addEventListener("keydown", (event) => event.key === "Enter" && input.blur());
        row.appendChild(document.createElement("td")).appendChild(input);
      });
      const here = document.createElement("button");
      Object.assign(here, { textContent: "here", className: "small", title: `moves the ${label} to the cross-hair`, ariaLabel: `${label} to the cross-hair` });
      here.addEventListener("click", () => this.cursor.point && this.move(name, millimetres(this.cursor.point)));
      row.appendChild(document.createElement("td")).appendChild(here);
    }
  }

  /**
   * Makes handles draggable on a canvas. @param {HTMLElement} canvas
   * @param {(handle: Handle) => number[] | undefined} at page pixels in the canvas
   * @param {(point: Vector, event: PointerEvent) => Vector} to the handle's new position
   */
  listen(canvas, at, to) {
    /** @type {PlaceName | undefined} */
    let held;
    const point = (name) => this.handles.find((handle) => handle.name === name)?.point;
    const near = (event) => {
      const away = this.handles.map((handle) => {
        const place = at(handle);
        return { name: handle.name, px: place ? Math.hypot(place[0] - event.offsetX, place[1] - event.offsetY) : Infinity };
      });
      return away.filter(({ px }) => px <= GRAB_PX).sort((a, b) => a.px - b.px)[0]?.name;
    };
    // Runs before the canvas's own listeners: dragging a handle neither turns the view nor moves the
    // cross-hair.
    const first = { capture: true };
    canvas.addEventListener("pointerdown", (event) => {
      if (event.button !== 0 || event.shiftKey || !(held = near(event))) return;
      event.stopImmediatePropagation();
      canvas.setPointerCapture(event.pointerId);
      this.dragged = held;
      // A view that followed the burr would move away under the pointer.
      this.cursor.follows = false;
      canvas.focus();
    }, first);
    canvas.addEventListener("pointermove", (event) => {
      if (!held) {
        if (event.buttons === 0) canvas.classList.toggle("grab", this.there && !!near(event));
        return;
      }
      event.stopImmediatePropagation();
      const from = point(held);
      if (from) this.move(held, millimetres(to(from, event)));
    }, first);
    for (const kind of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(kind, (event) => {
        if (!held) return;
        event.stopImmediatePropagation();
        held = this.dragged = undefined;
      }, first);
    }
  }

  /** In the 3D view a handle moves perpendicular to the line of sight. @param {import("/assets/scene_view.js").SceneView} view @param {(point: Vector) => number[] | undefined} at */
  listenToView(view, at) {
    const { canvas, camera } = view;
    canvas.addEventListener("pointermove", () => this.dragged && (camera.follows = false), { capture: true });
    this.listen(canvas, (handle) => at(handle.point), (point, event) => {
      const ray = cameraRay(camera, event.offsetX, event.offsetY, canvas.clientWidth, canvas.clientHeight);
      const forward = unit(subtract(camera.centre, camera.eye));
      const far = dot(subtract(point, ray.origin), forward) / dot(ray.direction, forward);
      return Number.isFinite(far) ? add(ray.origin, scale(ray.direction, far)) : nearest(ray, point);
    });
  }

  /** In a slice a handle moves within the plane and keeps its distance from it. @param {import("/assets/slice_tile.js").SliceTile} tile @param {() => number} field metres */
  listenToSlice(tile, field) {
    const plane = () => ({ centre: tile.centre ?? [0, 0, 0], ...tile.view });
    this.listen(tile.canvas, (handle) => tile.pixelOf(handle.point, field()), (point, event) => {
      const behind = planePlace(plane(), point)[2];
      return tile.pointOf(event, field(), behind);
    });
  }
}

/**
 * Draws labelled rings. @param {CanvasRenderingContext2D} context @param {Handle[]} handles @param {(point:
 * Vector) => number[] | undefined} at pixels, and
 *   distance from the image plane, if there is one @param {number} ratio
 */
export function drawHandles(context, handles, at, ratio) {
  context.font = `600 ${11 * ratio}px system-ui, sans-serif`;
  context.textAlign = "left";
  context.textBaseline = "middle";
  for (const { label, colour, point } of handles) {
    const place = at(point);
    if (!place) continue;
    const [x, y, behind] = place;
    context.globalAlpha = Math.abs(behind ?? 0) <= NEAR_M ? 1 : 0.55;
    for (const [style, width] of [["rgb(0 0 0 / .7)", 5], [colour, 2.5]]) {
      context.strokeStyle = /** @type {string} */ (style);
      context.lineWidth = /** @type {number} */ (width) * ratio;
      context.beginPath();
      context.arc(x, y, RADIUS_PX * ratio, 0, 7);
      context.stroke();
    }
    outlined(context, label, x + (RADIUS_PX + 4) * ratio, y, "#fff", ratio);
    context.globalAlpha = 1;
  }
}
