// The cross-hair: one place that slices, 3D view and X-ray share. It stays on the tip until the user puts it elsewhere.

/** @typedef {import("/assets/vector.js").Vector} Vector */

export class Cursor {
  /** @param {() => void} changed */
  constructor(changed) {
    this.changed = changed;
    /** Patient frame, metres. @type {Vector | undefined} */
    this.point = undefined;
    this.follows = true;
  }

  /** Puts it somewhere, off the tip. @param {Vector} point */
  place(point) {
    if (!point.every(Number.isFinite)) return;
    this.point = point;
    this.follows = false;
    this.changed();
  }

  /** Back onto the tip, or off it where it is. */
  toggle() {
    this.follows = !this.follows;
    this.changed();
  }

  /** Where the tip is now. @param {Vector | undefined} tip */
  tip(tip) {
    if (tip && (this.follows || !this.point)) this.point = tip;
  }
}
