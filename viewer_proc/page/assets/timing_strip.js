// Ticks on a strip: how long the step took of its period, and the misses with their cause as colour and letter.

import { prepare } from "/assets/plot.js";

/**
 * Causes of a miss by the letter that the server gives (`recorder_proc::misses`); the series keeps the place in this list, from 1.
 * @type {{letter: string, name: string, colour: string}[]}
 */
const LIST = [
  { letter: "O", name: "own computation", colour: "--cause-step" },
  { letter: "Q", name: "run queue: others had the core", colour: "--cause-core" },
  { letter: "S", name: "stolen by the hypervisor", colour: "--cause-host" },
  { letter: "T", name: "throttled: quota used up", colour: "--cause-core" },
  { letter: "P", name: "stopped or frozen", colour: "--cause-host" },
  { letter: "F", name: "page fault", colour: "--cause-fault" },
  { letter: "B", name: "blocked", colour: "--series-3" },
  { letter: "C", name: "late controller", colour: "--series-4" },
  { letter: "R", name: "waited for the recorder", colour: "--series-4" },
  { letter: "U", name: "unknown", colour: "--muted" },
];

/** @type {Record<number, {letter: string, name: string, colour: string}>} */
export const CAUSES = Object.fromEntries(LIST.map((cause, index) => [index + 1, cause]));

/** @param {string} letter @returns {number} a key of `CAUSES`; unknown for any other letter */
export function causeOf(letter) {
  const index = LIST.findIndex((cause) => cause.letter === letter);
  return index < 0 ? LIST.length : index + 1;
}

const LETTER_PX = 13;

/** @param {HTMLCanvasElement} canvas @param {import("/assets/series.js").Series} series step µs, cause @param {number} periodUs */
export function drawTimingStrip(canvas, series, from, to, periodUs, colours) {
  const { context, width, height } = prepare(canvas);
  const top = LETTER_PX + 2;
  const tall = height - top;
  const columns = Math.floor(width);
  context.fillStyle = colours["--series-1"];
  series.decimate(0, from, to, columns, (column, _low, high) => {
    const bar = Math.max(1, Math.min(1, high / periodUs) * tall);
    context.fillRect(column, height - bar, 1, bar);
  });
  context.strokeStyle = colours["--muted"];
  context.setLineDash([3, 3]);
  context.strokeRect(-1, top + 0.5, width + 2, height);
  context.setLineDash([]);
  context.font = `bold ${LETTER_PX - 1}px system-ui, sans-serif`;
  context.textAlign = "center";
  context.textBaseline = "top";
  let lastLetter = -Infinity;
  series.decimate(1, from, to, columns, (column, _low, cause) => {
    const { letter, colour } = CAUSES[cause] ?? {};
    if (!letter) return;
    context.fillStyle = colours[colour];
    context.fillRect(column - 1, top, 3, tall);
    if (column - lastLetter < LETTER_PX) return;
    context.fillText(letter, Math.max(6, Math.min(width - 6, column)), 0);
    lastLetter = column;
  });
}

/** Misses of each cause in a window. @param {import("/assets/series.js").Series} series */
export function countCauses(series, from, to) {
  const counts = new Map();
  const end = series.lowerBound(to);
  for (let index = series.lowerBound(from); index < end; index++) {
    const cause = series.values[1][index % series.times.length];
    if (cause > 0) counts.set(cause, (counts.get(cause) ?? 0) + 1);
  }
  return counts;
}
