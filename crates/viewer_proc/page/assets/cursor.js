// The cross-hair: one point shared by slices, 3D view and X-ray. It follows the tip until the user places it.

/** @typedef {import("/assets/vector.js").Vector} Vector */

export class Cursor {
  /** @param {() => void} changed */
  constructor(changed) {
    this.changed = changed;
    /** Patient frame, metres. @type {Vector | undefined} */
    this.point = undefined;
    this.follows = true;
  }

  /** Places it at a point and stops following the tip. @param {Vector} point */
  place(point) {
    if (!point.every(Number.isFinite)) return;
    this.point = point;
    this.follows = false;
    this.changed();
  }

  /** Toggles following the tip. */
  toggle() {
    this.follows = !this.follows;
    this.changed();
  }

  /** Takes the tip's position. @param {Vector | undefined} tip */
  tip(tip) {
    if (tip && (this.follows || !this.point)) this.point = tip;
  }
}
