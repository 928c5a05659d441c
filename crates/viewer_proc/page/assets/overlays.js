// Overlays on the 3D view: the patient's axes, a scale bar, the legend.

import { prepare } from "/assets/plot.js";
import { ARROW_M_PER_N, COLOURS } from "/assets/tool_model.js";

/** Directions of the patient frame: letter, colour property, axis. @type {[string, string, import("/assets/vector.js").Vector][]} */
const AXES = [["L", "--cause-host", [1, 0, 0]], ["P", "--series-3", [0, 1, 0]], ["H", "--series-1", [0, 0, 1]]];

/** Draws small axes that rotate with the camera; L left, P posterior, H head. @param {HTMLCanvasElement} canvas @param {number[]} view matrix */
export function drawGizmo(canvas, view, colours) {
  const { context, width } = prepare(canvas);
  const middle = 48;
  // Designed for 96 pixels.
  context.scale(width / (2 * middle), width / (2 * middle));
  context.font = "bold 12px system-ui, sans-serif";
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.lineWidth = 2;
  for (const [letter, colour, [x, y, z]] of AXES) {
    const right = view[0] * x + view[4] * y + view[8] * z;
    const up = view[1] * x + view[5] * y + view[9] * z;
    context.strokeStyle = context.fillStyle = colours[colour];
    context.beginPath();
    context.moveTo(middle, middle);
    context.lineTo(middle + right * 26, middle - up * 26);
    context.stroke();
    context.fillText(letter, middle + right * 37, middle - up * 37);
  }
}

/** Shows a bar of a round length. @param {HTMLElement} bar @param {number} metresPerPixel */
export function showScaleBar(bar, metresPerPixel) {
  const most = metresPerPixel * 1000 * 110;
  const power = 10 ** Math.floor(Math.log10(most));
  const millimetres = power * (most / power >= 5 ? 5 : most / power >= 2 ? 2 : 1);
  bar.style.width = `${millimetres / (metresPerPixel * 1000)}px`;
  bar.firstElementChild.textContent = `${millimetres} mm`;
}

/** @param {number[]} colour red, green, blue: 0 to 1 */
const css = ([r, g, b]) => `rgb(${[r, g, b].map((part) => Math.round(part * 255)).join(" ")})`;

/** Legend shapes, so that colour is not the only distinction. */
const SHAPES = {
  ball: (c) => (c.arc(11, 6, 5, 0, 7), c.fill()),
  bars: (c) => (c.rect(2, 3, 5, 7), c.rect(9, 3, 5, 7), c.rect(16, 3, 5, 7), c.fill()),
  line: (c) => (c.rect(1, 5, 20, 3), c.fill()),
  dashes: (c) => (c.rect(1, 5, 5, 3), c.rect(9, 5, 5, 3), c.rect(17, 5, 5, 3), c.fill()),
  cross: (c) => (c.rect(10, 0, 2, 12), c.rect(5, 5, 12, 2), c.arc(11, 6, 3, 0, 7), c.fill()),
  arrow: (c) => (c.rect(1, 5, 13, 2), c.moveTo(13, 1), c.lineTo(21, 6), c.lineTo(13, 11), c.fill()),
};

/**
 * @param {HTMLElement} list
 * @param {{planned: boolean, target: boolean, margins: boolean, second: boolean, structures: {name: string, colour: number[]}[]}} has
 */
export function fillLegend(list, has) {
  /** Colour or its key, label, shape, and whether it is shown. @type {[string | number[], string, string, boolean][]} */
  const entries = [
    ["burr", "burr", "ball", true], ["linkEven", "links", "bars", true], ["drilled", "burr path", "line", true],
    ["planned", "planned path", "dashes", has.planned], ["target", "target", "cross", has.target],
    ["margin", "tool within a margin", "ball", has.margins], ["breach", "tool in a structure", "ball", has.margins],
    ["force", `contact force, 10 N = ${ARROW_M_PER_N * 1e4} mm`, "arrow", true], ["second", "tool of the second log", "bars", has.second],
    ...has.structures.map(({ name, colour }) => /** @type {[number[], string, string, boolean]} */ ([colour, name, "ball", true])),
  ];
  list.replaceChildren(...entries.filter((entry) => entry[3]).map(([colour, text, shape]) => {
    const item = document.createElement("li");
    const mark = item.appendChild(Object.assign(document.createElement("canvas"), { width: 22, height: 12 }));
    const context = mark.getContext("2d");
    context.fillStyle = css(typeof colour === "string" ? COLOURS[colour] : colour);
    context.beginPath();
    SHAPES[shape](context);
    item.append(text);
    return item;
  }));
}
