// A plot: minimum, maximum and mean of every pixel column, so that no peak is lost.

import { context2d } from "/assets/software.js";

/**
 * @typedef {{spacing: number, at: (time: number) => number | undefined, last?: () => number | undefined,
 *   each: (from: number, to: number, columns: number, draw: (time: number, low: number, high: number, mean:
 *   number) => void) => void}} Samples `spacing`: seconds covered by a sample; 0: unknown.
 * @typedef {{name: import("/assets/log_series.js").FieldName, label: string, samples: Samples, scale: number, colour: string,
 *   dashed?: boolean}} Line  `colour` names a custom property of the style sheet.
 * @typedef {{from: number, to: number, cursor?: number, now?: number}} Times  seconds; `now`: position in a log
 */

/** Margins around a plot and the tick strip for axis labels, pixels at text size 1. */
export const MARGIN = { left: 46, right: 8, top: 6, bottom: 17 };
/** Text size of the axes, at text size 1. */
const TEXT_PX = 11;
/** Reference text size; a large screen has a larger one (`layout.css`). */
const BODY_PX = 13;
/** Ratio of the page's text size to the reference. */
export const textScale = () => parseFloat(getComputedStyle(document.body).fontSize) / BODY_PX;
/** Live messages farther apart than this, in seconds, are not joined: some are missing. */
const LIVE_GAP_S = 0.25;

/** Steps of 1, 2 or 5 times a power of ten, about `count` of them. */
function niceStep(span, count) {
  const rough = span / count;
  const power = 10 ** Math.floor(Math.log10(rough));
  const part = rough / power;
  return power * (part < 1.5 ? 1 : part < 3.5 ? 2 : part < 7.5 ? 5 : 10);
}

/** Number of digits for a step. */
const digits = (step) => Math.max(0, Math.min(9, -Math.floor(Math.log10(step) + 1e-9)));

/** Formats a tick label; uses powers of ten if it would not fit into the margin. */
function tickText(value, step) {
  const text = (Math.abs(value) < step / 1e6 ? 0 : value).toFixed(digits(step));
  return text.length > 7 ? value.toExponential(1) : text;
}

/** Sets a canvas to screen resolution; returns its context and size in CSS pixels. @param {HTMLCanvasElement} canvas */
export function prepare(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  const [columns, rows] = [Math.round(width * ratio), Math.round(height * ratio)];
  if (canvas.width !== columns || canvas.height !== rows) Object.assign(canvas, { width: columns, height: rows });
  const context = context2d(canvas);
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  return { context, width, height };
}

/** Returns the axis font for a text size. @param {number} size */
export const axisFont = (size) => `${TEXT_PX * size}px system-ui, sans-serif`;

/**
 * Draws the time axis below a box: a line, number and unit at each step. Adds the lines to the current path.
 * @param {any} context @param {{x: number, y: number, width: number, height: number, size: number}} box
 * @param {{from: number, to: number, toX: (time: number) => number}} times
 */
export function addTimes(context, box, { from, to, toX }) {
  const step = niceStep(to - from, Math.max(2, box.width / (76 * box.size)));
  context.textAlign = "center";
  context.textBaseline = "top";
  for (let k = Math.ceil(from / step - 1e-9); k * step <= to; k++) {
    const x = Math.round(toX(k * step)) + 0.5;
    context.moveTo(x, box.y);
    context.lineTo(x, box.y + box.height);
    if (x > box.x + 8 && x <= box.x + box.width - 10) context.fillText(`${tickText(k * step, step)} s`, x, box.y + box.height + 3);
  }
}

export class Plot {
  /** @param {Line[]} lines @param {string} unit @param {number} least minimum span of the vertical axis */
  constructor(lines, unit, least) {
    this.lines = lines;
    this.unit = unit;
    this.least = least;
  }

  /** Value range of a window, with margins; includes zero if it is near, as for forces. */
  #range(from, to, columns) {
    let [low, high] = [Infinity, -Infinity];
    for (const { samples, scale } of this.lines) {
      samples.each(from, to, columns, (_, least, greatest) => {
        low = Math.min(low, least * scale, greatest * scale);
        high = Math.max(high, least * scale, greatest * scale);
      });
    }
    if (low > high) [low, high] = [0, 0];
    const span = high - low;
    // A field that stays far from zero, such as a position, would otherwise be a flat line.
    if (low > 0 && low < 3 * span + this.least) low = 0;
    if (high < 0 && -high < 3 * span + this.least) high = 0;
    const least = Math.max(this.least, Math.abs(high) * 1e-6, 1e-12);
    if (high - low < least) high = low + least;
    const room = (high - low) * 0.08;
    return [low === 0 ? 0 : low - room, high + room];
  }

  /**
   * Draws into the context of a canvas or figure (`figure.js`).
   * @param {any} context @param {number} width @param {number} height pixels
   * @param {Times} times @param {Record<string, string>} colours by custom property @param {number} [size] text size, 1: that of the page
   */
  draw(context, width, height, { from, to, cursor, now }, colours, size = 1) {
    const { left, right, top, bottom } = MARGIN;
    const box = { x: left * size, y: top, width: width - (left + right) * size, height: height - top - bottom * size, size };
    if (box.width < 20 || box.height < 10 || !(to > from)) return;
    const columns = Math.max(1, Math.floor(box.width));
    const [low, high] = this.#range(from, to, columns);
    const toX = (time) => box.x + ((time - from) / (to - from)) * box.width;
    const toY = (value) => box.y + box.height - ((value - low) / (high - low)) * box.height;
    this.#axes(context, box, { from, to, low, high, toX, toY }, colours);
    context.save();
    context.beginPath();
    context.rect(box.x, box.y - 1, box.width, box.height + 2);
    context.clip();
    for (const line of this.lines) this.#line(context, line, { from, to, columns, toX, toY, box }, colours);
    context.restore();
    const mark = (time, colour) => {
      if (time === undefined || time < from || time > to) return;
      context.fillStyle = colours[colour];
      context.fillRect(toX(time) - 0.5, box.y, 1, box.height);
    };
    mark(now, "--accent");
    mark(cursor, "--text");
  }

  #axes(context, box, { from, to, low, high, toX, toY }, colours) {
    context.font = axisFont(box.size);
    context.lineWidth = 1;
    context.strokeStyle = colours["--grid"];
    context.fillStyle = colours["--muted"];
    context.beginPath();
    const stepY = niceStep(high - low, Math.max(2, box.height / (28 * box.size)));
    context.textAlign = "right";
    context.textBaseline = "middle";
    for (let k = Math.ceil(low / stepY - 1e-9); k * stepY <= high; k++) {
      const y = Math.round(toY(k * stepY)) + 0.5;
      context.moveTo(box.x, y);
      context.lineTo(box.x + box.width, y);
      context.fillText(tickText(k * stepY, stepY), box.x - 5, Math.min(y, box.y + box.height - 4));
    }
    context.textBaseline = "top";
    context.fillText(this.unit, box.x - 5, box.y + box.height + 3);
    addTimes(context, box, { from, to, toX });
    context.stroke();
  }

  #line(context, line, { from, to, columns, toX, toY, box }, colours) {
    const { samples, scale } = line;
    const pixel = (to - from) / columns;
    const gap = Math.max(3 * pixel, samples.spacing > 0 ? 1.5 * samples.spacing : LIVE_GAP_S);
    const points = [];
    // A log's columns may be finer than the screen's.
    samples.each(from, to, columns, (time, low, high, mean) => {
      const last = points.at(-1);
      if (last && Math.floor((time - from) / pixel) === Math.floor((last.time - from) / pixel)) {
        last.low = Math.min(last.low, low);
        last.high = Math.max(last.high, high);
        last.mean = (last.mean * last.count + mean) / (last.count + 1);
        last.count += 1;
      } else points.push({ time, low, high, mean, count: 1 });
    });
    context.strokeStyle = colours[line.colour];
    this.#spread(context, points, { scale, toX, toY });
    context.lineWidth = 1.5;
    context.setLineDash(line.dashed ? [5, 4] : []);
    context.beginPath();
    let before = -Infinity;
    points.forEach(({ time, mean }, i) => {
      const [x, y] = [toX(time), toY(mean * scale)];
      const alone = time - before > gap && !(points[i + 1]?.time - time <= gap);
      if (time - before > gap) context.moveTo(x, y);
      // A sample without neighbours is a dot.
      context.lineTo(alone ? Math.min(x + 1.5, box.x + box.width) : x, y);
      before = time;
    });
    context.stroke();
    context.setLineDash([]);
  }

  /** Draws the band from minimum to maximum, pale, so that the mean stays visible. */
  #spread(context, points, { scale, toX, toY }) {
    context.globalAlpha = 0.4;
    context.lineWidth = 1;
    context.beginPath();
    for (const { time, low, high } of points) {
      const [top, bottom] = [toY(high * scale), toY(low * scale)];
      if (Math.abs(bottom - top) < 1) continue;
      context.moveTo(toX(time), bottom);
      context.lineTo(toX(time), top);
    }
    context.stroke();
    context.globalAlpha = 1;
  }
}

/** Returns the time under a pointer in a plot; undefined outside it. */
export function timeAt(canvas, clientX, from, to) {
  const bounds = canvas.getBoundingClientRect();
  const size = textScale();
  const share = (clientX - bounds.left - MARGIN.left * size) / (bounds.width - (MARGIN.left + MARGIN.right) * size);
  return share >= 0 && share <= 1 ? from + share * (to - from) : undefined;
}
