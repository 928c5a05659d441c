// A plot on a canvas: every sample counts, drawn as one vertical stroke for each pixel column.

/**
 * @typedef {{label: string, series: import("/assets/series.js").Series, which: number, scale: number, colour: string,
 *   dashed?: boolean, shown?: () => boolean}} Line  `colour` names a custom property of the style sheet.
 */

const MARGIN = { left: 44, right: 8, top: 6, bottom: 16 };

/** Steps of 1, 2 or 5 times a power of ten, about `count` of them. */
function niceStep(span, count) {
  const rough = span / count;
  const power = 10 ** Math.floor(Math.log10(rough));
  const part = rough / power;
  return power * (part < 1.5 ? 1 : part < 3.5 ? 2 : part < 7.5 ? 5 : 10);
}

/** The digits that a step needs. */
const digits = (step) => Math.max(0, Math.min(6, -Math.floor(Math.log10(step) + 1e-9)));

/** Makes a canvas as fine as the screen; returns its context and size in CSS pixels. @param {HTMLCanvasElement} canvas */
export function prepare(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  const [columns, rows] = [Math.round(width * ratio), Math.round(height * ratio)];
  if (canvas.width !== columns || canvas.height !== rows) Object.assign(canvas, { width: columns, height: rows });
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  return { context, width, height };
}

export class Plot {
  /** @param {HTMLCanvasElement} canvas @param {Line[]} lines @param {number} least smallest span of the vertical axis */
  constructor(canvas, lines, least) {
    this.canvas = canvas;
    this.lines = lines;
    this.least = least;
  }

  #shown() {
    return this.lines.filter((line) => line.shown?.() ?? true);
  }

  /** Least and greatest value in a window, zero included, or the smallest span. */
  #range(from, to) {
    let [low, high] = [0, 0];
    for (const line of this.#shown()) {
      line.series.decimate(line.which, from, to, 1, (_, least, greatest) => {
        low = Math.min(low, least * line.scale);
        high = Math.max(high, greatest * line.scale);
      });
    }
    if (high - low < this.least) high = low + this.least;
    const room = (high - low) * 0.08;
    return [low < 0 ? low - room : 0, high + room];
  }

  /**
   * @param {number} from seconds @param {number} to seconds @param {Record<string, string>} colours by custom property
   * @param {number | undefined} cursor seconds
   */
  draw(from, to, colours, cursor) {
    const { context, width, height } = prepare(this.canvas);
    const box = { x: MARGIN.left, y: MARGIN.top, width: width - MARGIN.left - MARGIN.right, height: height - MARGIN.top - MARGIN.bottom };
    if (box.width < 20 || box.height < 10) return;
    const [low, high] = this.#range(from, to);
    const toX = (time) => box.x + ((time - from) / (to - from)) * box.width;
    const toY = (value) => box.y + box.height - ((value - low) / (high - low)) * box.height;
    this.#axes(context, box, { from, to, low, high, toX, toY }, colours);
    context.save();
    context.beginPath();
    context.rect(box.x, box.y - 1, box.width, box.height + 2);
    context.clip();
    for (const line of this.#shown()) this.#line(context, line, box, from, to, toY, colours);
    context.restore();
    if (cursor !== undefined && cursor >= from && cursor <= to) {
      context.fillStyle = colours["--text"];
      context.fillRect(toX(cursor), box.y, 1, box.height);
    }
  }

  #axes(context, box, { from, to, low, high, toX, toY }, colours) {
    context.font = "11px system-ui, sans-serif";
    context.lineWidth = 1;
    context.strokeStyle = colours["--grid"];
    context.fillStyle = colours["--muted"];
    context.beginPath();
    const stepY = niceStep(high - low, Math.max(2, box.height / 28));
    context.textAlign = "right";
    context.textBaseline = "middle";
    for (let value = Math.ceil(low / stepY) * stepY; value <= high; value += stepY) {
      const y = Math.round(toY(value)) + 0.5;
      context.moveTo(box.x, y);
      context.lineTo(box.x + box.width, y);
      context.fillText((Math.abs(value) < stepY / 1e6 ? 0 : value).toFixed(digits(stepY)), box.x - 5, y);
    }
    const stepX = niceStep(to - from, Math.max(2, box.width / 70));
    context.textAlign = "center";
    context.textBaseline = "top";
    for (let time = Math.ceil(from / stepX) * stepX; time <= to; time += stepX) {
      const x = Math.round(toX(time)) + 0.5;
      context.moveTo(x, box.y);
      context.lineTo(x, box.y + box.height);
      context.fillText(`${time.toFixed(digits(stepX))} s`, Math.min(x, box.x + box.width - 12), box.y + box.height + 3);
    }
    context.stroke();
  }

  #line(context, line, box, from, to, toY, colours) {
    const columns = Math.max(1, Math.floor(box.width));
    // Samples farther apart than this are not joined: messages are missing, or time was skipped.
    const gap = Math.max(3, (0.25 / (to - from)) * columns);
    let before = -Infinity;
    context.strokeStyle = colours[line.colour];
    context.lineWidth = 1.5;
    context.setLineDash(line.dashed ? [5, 4] : []);
    context.beginPath();
    line.series.decimate(line.which, from, to, columns, (column, low, high, first, last) => {
      const x = box.x + column + 0.5;
      if (column - before > gap) context.moveTo(x, toY(first * line.scale));
      else context.lineTo(x, toY(first * line.scale));
      context.lineTo(x, toY(low * line.scale));
      if (high !== low) context.lineTo(x, toY(high * line.scale));
      context.lineTo(x, toY(last * line.scale));
      before = column;
    });
    context.stroke();
    context.setLineDash([]);
  }
}

/** The time under a pointer in a plot, or undefined beside it. */
export function timeAt(canvas, clientX, from, to) {
  const bounds = canvas.getBoundingClientRect();
  const share = (clientX - bounds.left - MARGIN.left) / (bounds.width - MARGIN.left - MARGIN.right);
  return share >= 0 && share <= 1 ? from + share * (to - from) : undefined;
}
