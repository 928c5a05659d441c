// Detail of a view that is rendered in software: while it changes, as many pixels as can be rendered quickly.

/** Shares of the pixels along a side, each with two thirds of the pixels of the one before. */
export const RATIOS = [1, 0.82, 0.67, 0.54, 0.44, 0.36, 0.3];
const FIRST = 2;
/** A picture that takes longer is too slow for 10 per second besides the rest of the page. */
const SLOW_MS = 75;
/** After this number of pictures in a row in less time, the next one has half as many pixels again. */
const QUICK_MS = 35;
const QUICK_PICTURES = 8;

export class Detail {
  #level = FIRST;
  #quick = 0;

  /** Pixels per pixel of the page while the view changes. */
  get ratio() {
    return RATIOS[this.#level];
  }

  /** Takes the rendering time of a picture with this ratio. @param {number} milliseconds */
  rendered(milliseconds) {
    this.#quick = milliseconds < QUICK_MS ? this.#quick + 1 : 0;
    if (milliseconds > SLOW_MS && this.#level < RATIOS.length - 1) this.#level += 1;
    if (this.#quick < QUICK_PICTURES || this.#level === 0) return;
    this.#level -= 1;
    this.#quick = 0;
  }
}
