// What the page itself costs the browser: script time, without the picture that the graphics card or the processor then makes.

const KEPT = 600;

/** Pictures and messages since the last `take`, and the script time of the last pictures. */
export class Work {
  pictures = 0;
  messageMs = 0;
  /** Milliseconds of each of the last pictures. @type {number[]} */
  times = [];

  /** A picture was drawn. @param {number} milliseconds */
  picture(milliseconds) {
    this.pictures += 1;
    this.times.push(milliseconds);
    if (this.times.length > KEPT) this.times.shift();
  }

  /** Messages were taken. @param {number} milliseconds */
  message(milliseconds) {
    this.messageMs += milliseconds;
  }

  /** Script time of a picture that a share of the last ones kept below. @param {number} share */
  quantile(share) {
    const sorted = [...this.times].sort((a, b) => a - b);
    return sorted[Math.floor(share * (sorted.length - 1))] ?? 0;
  }

  /** Pictures and milliseconds of messages since the last call. */
  take() {
    const { pictures, messageMs } = this;
    this.pictures = this.messageMs = 0;
    return { pictures, messageMs };
  }
}
