// A ring buffer of samples over time: full rate in, minimum and maximum of each pixel column out.

/** Capacity: the longest window at 1 kHz. */
export const CAPACITY = 1 << 16;

/** Several values that share one time axis (seconds of simulated time, ascending). */
export class Series {
  /** @param {number} width values per sample */
  constructor(width) {
    this.times = new Float64Array(CAPACITY);
    this.values = Array.from({ length: width }, () => new Float32Array(CAPACITY));
    this.clear();
  }

  clear() {
    this.first = 0;
    this.end = 0;
  }

  /** The newest time, or undefined. */
  get lastTime() {
    return this.end > this.first ? this.times[(this.end - 1) % CAPACITY] : undefined;
  }

  /** Adds a sample. If time goes backward (a scrub, a restarted log), later samples are dropped. */
  push(time, ...sample) {
    while (this.end > this.first && this.times[(this.end - 1) % CAPACITY] >= time) this.end -= 1;
    const slot = this.end % CAPACITY;
    this.times[slot] = time;
    sample.forEach((value, i) => (this.values[i][slot] = value));
    this.end += 1;
    this.first = Math.max(this.first, this.end - CAPACITY);
  }

  /** Index of the first sample at or after a time. */
  lowerBound(time) {
    let [low, high] = [this.first, this.end];
    while (low < high) {
      const middle = Math.floor((low + high) / 2);
      if (this.times[middle % CAPACITY] < time) low = middle + 1;
      else high = middle;
    }
    return low;
  }

  /** One value of the newest sample, or undefined. */
  last(which) {
    return this.end > this.first ? this.values[which][(this.end - 1) % CAPACITY] : undefined;
  }

  /** One value at or just before a time, or undefined. */
  at(which, time) {
    const index = this.lowerBound(time + 1e-9) - 1;
    return index >= this.first ? this.values[which][index % CAPACITY] : undefined;
  }

  /**
   * Passes minimum, maximum and mean of each column of a window to `draw`, so that no peak is lost.
   * @param {number} which @param {number} from seconds @param {number} to seconds @param {number} columns
   * @param {(column: number, low: number, high: number, mean: number) => void} draw
   */
  decimate(which, from, to, columns, draw) {
    const values = this.values[which];
    const perSecond = columns / (to - from);
    let [column, low, high, sum, count] = [-1, 0, 0, 0, 0];
    for (let index = this.lowerBound(from); index < this.end; index++) {
      const slot = index % CAPACITY;
      if (this.times[slot] > to) break;
      const here = Math.min(columns - 1, Math.floor((this.times[slot] - from) * perSecond));
      const value = values[slot];
      if (here !== column) {
        if (column >= 0) draw(column, low, high, sum / count);
        [column, low, high, sum, count] = [here, value, value, 0, 0];
      }
      if (value < low) low = value;
      if (value > high) high = value;
      sum += value;
      count += 1;
    }
    if (column >= 0) draw(column, low, high, sum / count);
  }
}
