// The time axis shared by all plots and the tick strip: the last seconds of a run, a whole log, or a selected
// span.

/** Selectable lengths of a run's time axis, seconds. */
const WINDOWS = [1, 2, 5, 10, 20, 60];
/** Minimum span, seconds: a few ticks. */
const SHORTEST_S = 0.005;
/** Where a log's position is placed in the span after it has left it. */
const PAGE_SHARE = 0.1;

export class TimeAxis {
  constructor() {
    this.seconds = 10;
    /** The selected span; undefined: the last seconds, or the whole log. @type {[number, number] |
     * undefined} */
    this.chosen = undefined;
    /** First and last time of a log, seconds; undefined for a run. @type {[number, number] | undefined} */
    this.log = undefined;
    /** The newest time of a run, or the position in a log, seconds. */
    this.now = 0;
  }

  /** Begin and end, seconds. @returns {[number, number]} */
  range() {
    if (this.chosen) return this.chosen;
    if (this.log) return [this.log[0], Math.max(this.log[1], this.log[0] + SHORTEST_S)];
    const end = Math.max(this.seconds, this.now);
    return [end - this.seconds, end];
  }

  /** Updates the time; a log's selected span pages on when the position leaves it. @param {number} now seconds */
  move(now) {
    const before = this.now;
    this.now = now;
    if (!this.log || !this.chosen || now === before) return;
    const [from, to] = this.chosen;
    if (now >= from && now <= to) return;
    const span = to - from;
    this.#choose(now - PAGE_SHARE * span, span);
  }

  #choose(from, span) {
    const [first, last] = this.log ?? [0, Math.max(this.now, this.seconds)];
    const whole = Math.max(last - first, SHORTEST_S);
    const length = Math.min(whole, Math.max(SHORTEST_S, span));
    const begin = Math.min(Math.max(first, from), first + whole - length);
    this.chosen = length >= whole && this.log ? undefined : [begin, begin + length];
  }

  /** Zooms the span about a time. @param {number} factor @param {number} about seconds */
  zoom(factor, about) {
    const [from, to] = this.range();
    const at = Math.min(Math.max(about, from), to);
    this.#choose(at - (at - from) * factor, (to - from) * factor);
  }

  /** Moves the span. @param {number} by seconds */
  pan(by) {
    const [from, to] = this.range();
    this.#choose(from + by, to - from);
  }

  /** Resets to the last seconds, or the whole log. */
  reset() {
    this.chosen = undefined;
  }

  /** Selects the next longer or shorter time axis. @param {1 | -1} direction */
  step(direction) {
    if (this.log || this.chosen) return this.zoom(direction > 0 ? 2 : 0.5, this.now);
    const at = WINDOWS.indexOf(this.seconds) + direction;
    this.seconds = WINDOWS[Math.max(0, Math.min(WINDOWS.length - 1, at))];
  }
}
