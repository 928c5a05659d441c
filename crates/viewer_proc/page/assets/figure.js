// Export: the plots as CSV, PNG and SVG, the 3D view as PNG and video.

const TITLE_PX = 22;
const WIDTH = 900;
const HEIGHT = 220;

/** Downloads a file. @param {Blob} blob @param {string} name */
export function save(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  // By then the browser has started to read it.
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

const escaped = (text) => String(text).replace(/[&<>"]/g, (c) => ({ "&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;" })[c]);
const two = (x) => (Math.round(x * 100) / 100).toString();

/** The subset of a canvas context that plots use, writing SVG. */
export class SvgContext {
  constructor() {
    this.parts = [];
    this.path = "";
    this.fillStyle = "";
    this.strokeStyle = "";
    this.lineWidth = 1;
    this.globalAlpha = 1;
    this.font = "11px sans-serif";
    this.textAlign = "left";
    this.textBaseline = "alphabetic";
    this.dash = [];
    this.offset = [0, 0];
    this.clips = 0;
  }

  move(x, y) {
    this.offset = [x, y];
  }

  #at(x, y) {
    return `${two(x + this.offset[0])} ${two(y + this.offset[1])}`;
  }

  beginPath() {
    this.path = "";
  }

  moveTo(x, y) {
    this.path += `M${this.#at(x, y)}`;
  }

  lineTo(x, y) {
    this.path += `${this.path ? "L" : "M"}${this.#at(x, y)}`;
  }

  rect(x, y, width, height) {
    this.path += `M${this.#at(x, y)}h${two(width)}v${two(height)}h${two(-width)}z`;
  }

  clip() {
    this.clips += 1;
    this.parts.push(`<clipPath id="clip${this.clips}"><path d="${this.path}"/></clipPath><g clip-path="url(#clip${this.clips})">`);
  }

  save() {}

  restore() {
    this.parts.push("</g>");
  }

  setLineDash(dash) {
    this.dash = dash;
  }

  stroke() {
    if (!this.path) return;
    const dash = this.dash.length > 0 ? ` stroke-dasharray="${this.dash.join(" ")}"` : "";
    this.parts.push(`<path d="${this.path}" fill="none" stroke="${escaped(this.strokeStyle)}" stroke-width="${this.lineWidth}" stroke-opacity="${this.globalAlpha}"${dash}/>`);
  }

  fillRect(x, y, width, height) {
    const [left, top] = this.#at(x, y).split(" ");
    this.parts.push(`<rect x="${left}" y="${top}" width="${two(width)}" height="${two(height)}" fill="${escaped(this.fillStyle)}"/>`);
  }

  fillText(text, x, y) {
    const anchor = { right: "end", center: "middle" }[this.textAlign] ?? "start";
    const size = parseFloat(this.font.replace(/^bold /, ""));
    const down = { top: 0.8, middle: 0.35 }[this.textBaseline] ?? 0;
    const [left, top] = this.#at(x, y + down * size).split(" ");
    const weight = this.font.startsWith("bold") ? ' font-weight="bold"' : "";
    this.parts.push(`<text x="${left}" y="${top}" font-size="${size}"${weight} text-anchor="${anchor}" fill="${escaped(this.fillStyle)}">${escaped(text)}</text>`);
  }
}

/** Draws all plots in a column, each with its title and the names of its lines. */
function drawAll(panel, colours, context, move) {
  panel.plots.forEach(({ plot, title, unit }, i) => {
    move(0, i * (HEIGHT + TITLE_PX));
    context.font = "bold 13px system-ui, sans-serif";
    context.textAlign = "left";
    context.textBaseline = "top";
    context.fillStyle = colours["--text"];
    context.fillText(`${title}${unit ? `, ${unit}` : ""}`, 8, 4);
    let x = WIDTH - 8;
    context.font = "13px system-ui, sans-serif";
    context.textAlign = "right";
    for (const line of [...plot.lines].reverse()) {
      const text = `${line.dashed ? "- - " : "— "}${line.label}`;
      context.fillStyle = colours[line.colour];
      context.fillText(text, x, 4);
      x -= text.length * 7 + 12;
    }
    move(0, i * (HEIGHT + TITLE_PX) + TITLE_PX);
    plot.draw(context, WIDTH, HEIGHT, panel.times(), colours);
  });
  return panel.plots.length * (HEIGHT + TITLE_PX);
}

/** @param {import("/assets/plots_panel.js").PlotsPanel} panel @param {Record<string, string>} colours @returns {string} */
export function plotsSvg(panel, colours) {
  const context = new SvgContext();
  const height = drawAll(panel, colours, context, (x, y) => context.move(x, y));
  const size = `width="${WIDTH}" height="${height}" viewBox="0 0 ${WIDTH} ${height}"`;
  const page = `<rect width="100%" height="100%" fill="${escaped(colours["--panel"])}"/>`;
  return `<svg xmlns="http://www.w3.org/2000/svg" ${size} font-family="sans-serif">${page}${context.parts.join("")}</svg>`;
}

/** @param {import("/assets/plots_panel.js").PlotsPanel} panel @param {Record<string, string>} colours @returns {Promise<Blob>} */
export function plotsPng(panel, colours) {
  const canvas = document.createElement("canvas");
  const scale = 2;
  Object.assign(canvas, { width: WIDTH * scale, height: Math.max(1, panel.plots.length) * (HEIGHT + TITLE_PX) * scale });
  const context = canvas.getContext("2d");
  context.fillStyle = colours["--panel"];
  context.fillRect(0, 0, canvas.width, canvas.height);
  drawAll(panel, colours, context, (x, y) => context.setTransform(scale, 0, 0, scale, x * scale, y * scale));
  return new Promise((resolve) => canvas.toBlob(resolve));
}

/**
 * Returns the samples of the shown span as CSV, one row per time: for each line the mean, and the minimum and
 * maximum that the row covers. Numbers are in the messages' units, which are suffixes of the field names.
 * @param {import("/assets/plots_panel.js").PlotsPanel} panel @returns {string}
 */
export function plotsCsv(panel) {
  const [from, to] = panel.range();
  const lines = panel.plots.flatMap(({ plot }) => plot.lines);
  const rows = new Map();
  const columns = 4096;
  lines.forEach((line, i) => line.samples.each(from, to, columns, (time, low, high, mean) => {
    const key = time.toFixed(6);
    if (!rows.has(key)) rows.set(key, []);
    rows.get(key)[i] = [mean, low, high];
  }));
  const name = (line) => `${line.dashed ? "/second" : ""}${line.name.topic} ${line.name.field}`;
  const quoted = (text) => `"${text.replace(/"/g, '""')}"`;
  const head = ["time_s", ...lines.flatMap((line) => ["", " least", " greatest"].map((what) => quoted(name(line) + what)))];
  const sorted = [...rows].sort(([a], [b]) => Number(a) - Number(b));
  const body = sorted.map(([time, values]) => [time, ...lines.flatMap((_, i) => values[i] ?? ["", "", ""])].join(","));
  return `${[head.join(","), ...body].join("\n")}\n`;
}

/** A video of a canvas, encoded by the browser. */
export class Film {
  /** Starts recording, or stops and saves. @param {HTMLCanvasElement} canvas @param {string} name @returns {boolean} whether it is now recording */
  toggle(canvas, name) {
    if (this.recorder) {
      this.recorder.stop();
      this.recorder = undefined;
      return false;
    }
    const parts = [];
    const recorder = new MediaRecorder(canvas.captureStream(30), { mimeType: "video/webm" });
    recorder.addEventListener("dataavailable", ({ data }) => data.size > 0 && parts.push(data));
    recorder.addEventListener("stop", () => save(new Blob(parts, { type: "video/webm" }), name));
    recorder.start(1000);
    this.recorder = recorder;
    return true;
  }
}

/** Returns a descriptive file name. @param {string} scene @param {string} what @param {string} end */
export const fileName = (scene, what, end) => `${scene.replace(/[^\w.-]+/g, "_") || "trabecula"}_${what}.${end}`;
