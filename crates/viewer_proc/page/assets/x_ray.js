// Frames: decoding, window and level, and the difference of two frames.

import { context2d } from "/assets/software.js";

const LEVELS = 65536;
/** Fractions of the pixels that the automatic window leaves out. */
const CLIPPED = { dense: 0.01, soft: 0.3 };
/** A grey value within this fraction of an end of the range is air or metal. */
const AT_THE_END = 0.02;

/**
 * @typedef {{width: number, height: number, pixels: Uint16Array}} Image
 * @typedef {{level: number, width: number}} Window in grey values
 */

/** Decodes a sensor_msgs/msg/Image with mono16 pixels, CDR. @param {DataView} data @param {number} start of its body @returns {Image} */
export function decodeImage(data, start = 4) {
  let at = start;
  const align = (n) => (at = start + Math.ceil((at - start) / n) * n);
  const word = () => {
    align(4);
    at += 4;
    return data.getUint32(at - 4, true);
  };
  const text = () => {
    const size = word();
    const bytes = new Uint8Array(data.buffer, data.byteOffset + at, Math.max(0, size - 1));
    at += size;
    return new TextDecoder().decode(bytes);
  };
  at += 8;
  text();
  const [height, width] = [word(), word()];
  const encoding = text();
  if (encoding !== "mono16") throw new Error(`unsupported frame encoding ${encoding}; expected mono16`);
  at += 1;
  word();
  const bytes = word();
  const from = data.byteOffset + at;
  return { width, height, pixels: new Uint16Array(data.buffer.slice(from, from + bytes)) };
}

/**
 * Returns the window that spreads the grey levels of bone. Leaves out values at the ends of the detector's
 * range (air, metal) and a fraction of the pixels at the dense end and at the other one, where soft tissue
 * may be as bright as air.
 * @param {Image} image @param {boolean} [denseIsBright] @returns {Window}
 */
export function automaticWindow({ pixels }, denseIsBright = false) {
  const counts = new Uint32Array(LEVELS);
  for (const value of pixels) counts[value] += 1;
  const [first, last] = [LEVELS * AT_THE_END, LEVELS * (1 - AT_THE_END)].map(Math.round);
  let inside = 0;
  for (let value = first; value < last; value++) inside += counts[value];
  // A frame with only air or metal.
  if (inside < pixels.length * CLIPPED.dense) return { level: LEVELS / 2, width: LEVELS };
  const quantile = (share) => {
    let value = first;
    for (let left = inside * share; value < last && (left -= counts[value]) > 0; ) value += 1;
    return value;
  };
  const [low, high] = denseIsBright ? [quantile(CLIPPED.soft), quantile(1 - CLIPPED.dense)] : [quantile(CLIPPED.dense), quantile(1 - CLIPPED.soft)];
  return { level: (low + high) / 2, width: Math.max(16, high - low) };
}

/** An opaque grey as a canvas word. @param {number} grey 0 to 255 */
const word = (grey) => (0xff000000 | (grey << 16) | (grey << 8) | grey) >>> 0;

export class XRay {
  /** @param {HTMLCanvasElement} canvas @param {() => void} changed */
  constructor(canvas, changed) {
    this.canvas = canvas;
    this.context = context2d(canvas);
    this.changed = changed;
    /** @type {Image | undefined} */
    this.image = undefined;
    /** @type {Image | undefined} */
    this.second = undefined;
    /** Shown instead of the newest. @type {Image | undefined} */
    this.held = undefined;
    /** @type {"first" | "both" | "second" | "difference"} */
    this.shows = "first";
    this.inverted = false;
    /** Set by the scene's display. */
    this.denseIsBright = false;
    this.window = { level: LEVELS / 2, width: LEVELS };
    this.table = new Uint32Array(LEVELS);
    this.frames = 0;
  }

  /** @param {Image} image @param {boolean} second of the second log */
  take(image, second) {
    if (!this.image && !second) {
      this.window = automaticWindow(image, this.denseIsBright);
      this.#fillTable();
    }
    if (second && !this.second) this.shows = "both";
    this[second ? "second" : "image"] = image;
    this.frames += 1;
    this.changed();
  }

  /** Holds an image on screen, or releases it if undefined. @param {Image | undefined} image */
  hold(image) {
    this.held = image;
    this.changed();
  }

  automatic() {
    if (!this.image) return;
    this.window = automaticWindow(this.held ?? this.image, this.denseIsBright);
    this.#windowChanged();
  }

  invert() {
    this.inverted = !this.inverted;
    this.#windowChanged();
  }

  /** Moves level and width by fractions of the width. */
  adjust(level, width) {
    this.window.level = Math.max(0, Math.min(LEVELS, this.window.level + level * this.window.width));
    this.window.width = Math.max(16, Math.min(2 * LEVELS, this.window.width * Math.exp(width)));
    this.#windowChanged();
  }

  #windowChanged() {
    this.#fillTable();
    this.changed();
  }

  #fillTable() {
    const low = this.window.level - this.window.width / 2;
    for (let value = 0; value < LEVELS; value++) {
      const grey = Math.round(Math.max(0, Math.min(1, (value - low) / this.window.width)) * 255);
      this.table[value] = word(this.inverted ? 255 - grey : grey);
    }
  }

  draw() {
    const shown = this.shows === "second" ? this.second : (this.held ?? this.image);
    if (!shown) return;
    const other = this.second?.pixels.length === shown.pixels.length ? this.second.pixels : undefined;
    const both = this.shows === "both" && other;
    const { width, height, pixels } = shown;
    const words = this.#words(both ? 2 * width : width, height);
    if (both) {
      for (let row = 0; row < height; row++) {
        for (let column = 0; column < width; column++) {
          words[2 * row * width + column] = this.table[pixels[row * width + column]];
          words[(2 * row + 1) * width + column] = this.table[other[row * width + column]];
        }
      }
    } else if (this.shows === "difference" && other) {
      for (let i = 0; i < pixels.length; i++) words[i] = this.#difference(pixels[i], other[i]);
    } else {
      for (let i = 0; i < pixels.length; i++) words[i] = this.table[pixels[i]];
    }
    this.context.putImageData(this.data, 0, 0);
  }

  /** The canvas's pixels, four bytes each, reallocated when the size changes. */
  #words(width, height) {
    if (this.data?.width !== width || this.data?.height !== height) {
      Object.assign(this.canvas, { width, height });
      this.data = this.context.createImageData(width, height);
      this.words = new Uint32Array(this.data.data.buffer);
    }
    return this.words;
  }

  #difference(a, b) {
    return word(Math.round(Math.max(0, Math.min(255, 128 + ((a - b) / this.window.width) * 255))));
  }

  /** Drag: right widens, down darkens; double click: automatic; arrow keys likewise. */
  listen() {
    const { canvas } = this;
    canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      if (event.buttons !== 0) this.adjust(event.movementY * 0.004, event.movementX * 0.006);
    });
    canvas.addEventListener("dblclick", () => this.automatic());
    canvas.addEventListener("keydown", (event) => {
      const moves = { ArrowUp: [-0.04, 0], ArrowDown: [0.04, 0], ArrowLeft: [0, -0.08], ArrowRight: [0, 0.08] };
      const move = moves[event.key];
      if (!move) return;
      this.adjust(...move);
      event.preventDefault();
      event.stopPropagation();
    });
  }
}
