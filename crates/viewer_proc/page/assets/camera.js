// A camera that orbits a point, and the pointer and keys that move it.

import { add, cross, lookAt, multiply, perspective, scale, subtract, unit } from "/assets/vector.js";

/** @typedef {import("/assets/vector.js").Vector} Vector */

/** Vertical field of view. */
export const FIELD_OF_VIEW_RAD = (32 * Math.PI) / 180;
const STEEPEST_RAD = 1.55;
const KEY_TURN_RAD = 0.08;
const DISTANCE_M = [0.01, 6];

/** View directions; yaw 0 is in front of the patient. */
export const VIEWS = {
  front: { yaw: 0.45, pitch: 0.25 },
  side: { yaw: -Math.PI / 2, pitch: 0.1 },
  above: { yaw: 0, pitch: STEEPEST_RAD },
};

export class Camera {
  /** @param {() => void} changed */
  constructor(changed) {
    this.changed = changed;
    /** @type {Vector} */
    this.centre = [0, 0, 0];
    this.distance = 0.3;
    this.yaw = VIEWS.front.yaw;
    this.pitch = VIEWS.front.pitch;
    /** True until the user moves the centre: it then follows the burr. */
    this.follows = true;
  }

  /** @returns {Vector} Eye in the patient frame (LPS): +x left, +y posterior, +z superior. */
  get eye() {
    const c = Math.cos(this.pitch);
    /** @type {Vector} */
    const direction = [Math.sin(this.yaw) * c, -Math.cos(this.yaw) * c, Math.sin(this.pitch)];
    return add(this.centre, scale(direction, this.distance));
  }

  get view() {
    return lookAt(this.eye, this.centre, [0, 0, 1]);
  }

  /** @param {number} aspect width over height */
  clipFromWorld(aspect) {
    return multiply(perspective(FIELD_OF_VIEW_RAD, aspect, this.distance * 0.02, this.distance * 20), this.view);
  }

  /** Metres per pixel at the centre. @param {number} height of the view in pixels */
  metresPerPixel(height) {
    return (2 * this.distance * Math.tan(FIELD_OF_VIEW_RAD / 2)) / height;
  }

  look(view) {
    Object.assign(this, view);
    this.follows = true;
    this.changed();
  }

  turn(yaw, pitch) {
    this.yaw += yaw;
    this.pitch = Math.max(-STEEPEST_RAD, Math.min(STEEPEST_RAD, this.pitch + pitch));
    this.changed();
  }

  zoom(factor) {
    this.distance = Math.max(DISTANCE_M[0], Math.min(DISTANCE_M[1], this.distance * factor));
    this.changed();
  }

  /** Pans the centre across the view. @param {number} right metres @param {number} up metres */
  pan(right, up) {
    const back = unit(subtract(this.eye, this.centre));
    const toRight = unit(cross([0, 0, 1], back));
    this.centre = add(this.centre, add(scale(toRight, right), scale(cross(back, toRight), up)));
    this.follows = false;
    this.changed();
  }

  /** Listens to pointer, wheel and keys of the view's element. @param {HTMLElement} element */
  listen(element) {
    element.addEventListener("pointerdown", (event) => element.setPointerCapture(event.pointerId));
    element.addEventListener("contextmenu", (event) => event.preventDefault());
    element.addEventListener("pointermove", (event) => {
      if (event.buttons === 0) return;
      if (event.buttons > 1 || event.shiftKey) {
        const metres = this.metresPerPixel(element.clientHeight);
        this.pan(-event.movementX * metres, event.movementY * metres);
      } else {
        this.turn(-event.movementX * 0.008, event.movementY * 0.008);
      }
    });
    element.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(event.deltaY * 0.001));
    }, { passive: false });
    element.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || !this.#key(event)) return;
      event.preventDefault();
      event.stopPropagation();
    });
  }

  #key(event) {
    const step = this.distance * 0.03;
    const arrows = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    const arrow = arrows[event.key];
    if (arrow && event.shiftKey) this.pan(-arrow[0] * step, -arrow[1] * step);
    else if (arrow) this.turn(-arrow[0] * KEY_TURN_RAD, -arrow[1] * KEY_TURN_RAD);
    else if (event.key === "PageUp") this.zoom(0.9);
    else if (event.key === "PageDown") this.zoom(1 / 0.9);
    else return false;
    return true;
  }
}
