// Distances: two clicks in any of the views define one.

import { length, subtract } from "/assets/vector.js";

/** @typedef {import("/assets/vector.js").Vector} Vector */
const KEPT = 20;
/** A pointer that moved less than this counts as a click, not a drag. */
export const CLICK_PX = 4;

/** @param {Vector} from @param {Vector} to */
export const distanceText = (from, to) => `${(length(subtract(to, from)) * 1e3).toFixed(1)} mm`;

export class Measures {
  /** @param {() => void} changed */
  constructor(changed) {
    this.changed = changed;
    this.on = false;
    /** @type {{from: Vector, to: Vector}[]} */
    this.lines = [];
    /** The first point of an unfinished distance. @type {Vector | undefined} */
    this.begun = undefined;
    /** Incremented on every change. */
    this.version = 0;
  }

  #change() {
    this.version += 1;
    this.changed();
  }

  toggle() {
    this.on = !this.on;
    this.begun = undefined;
    this.#change();
  }

  /** @param {Vector} point a click */
  add(point) {
    if (!point.every(Number.isFinite)) return;
    if (this.begun) {
      this.lines.push({ from: this.begun, to: point });
      if (this.lines.length > KEPT) this.lines.shift();
      this.begun = undefined;
    } else {
      this.begun = point;
    }
    this.#change();
  }

  clear() {
    this.lines = [];
    this.begun = undefined;
    this.#change();
  }

  /** Text for the user. */
  get text() {
    if (this.on && this.begun) return "click the second point";
    const last = this.lines.at(-1);
    if (last) return distanceText(last.from, last.to);
    return this.on ? "click the first point" : "";
  }
}
