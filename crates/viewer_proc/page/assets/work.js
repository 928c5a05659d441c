// The page's own cost in the browser: script time, without the rendering by the graphics card or processor.

const KEPT = 600;

/** Frames and messages since the last `take`, and the script time of the last frames. */
export class Work {
  pictures = 0;
  messageMs = 0;
  /** Milliseconds of each of the last frames. @type {number[]} */
  times = [];

  /** Records a drawn frame. @param {number} milliseconds */
  picture(milliseconds) {
    this.pictures += 1;
    this.times.push(milliseconds);
    if (this.times.length > KEPT) this.times.shift();
  }

  /** Records processed messages. @param {number} milliseconds */
  message(milliseconds) {
    this.messageMs += milliseconds;
  }

  /** Returns a quantile of the script time of the last frames. @param {number} share */
  quantile(share) {
    const sorted = [...this.times].sort((a, b) => a - b);
    return sorted[Math.floor(share * (sorted.length - 1))] ?? 0;
  }

  /** Returns frames, and milliseconds spent on messages, since the last call. */
  take() {
    const { pictures, messageMs } = this;
    this.pictures = this.messageMs = 0;
    return { pictures, messageMs };
  }
}
