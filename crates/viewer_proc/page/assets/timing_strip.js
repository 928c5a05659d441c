// Ticks on a strip: step time relative to the period, and misses with their cause as colour and letter.

import { MARGIN, addTimes, axisFont, prepare, textScale } from "/assets/plot.js";

/**
 * Causes of a miss by the server's letter (`recorder_proc::misses`).
 * @type {{letter: string, name: string, colour: string}[]}
 */
const LIST = [
  { letter: "O", name: "own computation", colour: "--cause-step" },
  { letter: "Q", name: "run queue: core in use by others", colour: "--cause-core" },
  { letter: "S", name: "stolen by the hypervisor", colour: "--cause-host" },
  { letter: "T", name: "throttled: CPU quota used up", colour: "--cause-core" },
  { letter: "P", name: "stopped or frozen", colour: "--cause-host" },
  { letter: "F", name: "page fault", colour: "--cause-fault" },
  { letter: "B", name: "blocked", colour: "--series-3" },
  { letter: "C", name: "late controller", colour: "--series-4" },
  { letter: "R", name: "waiting for the recorder", colour: "--series-4" },
  { letter: "U", name: "unknown", colour: "--muted" },
];
const UNKNOWN = LIST[LIST.length - 1];

/** All causes, for the legend. */
export const CAUSES = LIST;

/** @param {string} letter @returns {{letter: string, name: string, colour: string}} "unknown" for any other letter */
export const causeOf = (letter) => LIST.find((cause) => cause.letter === letter) ?? UNKNOWN;

/** At the text size of a small screen. */
const SMALL_LETTER_PX = 13;

/**
 * @typedef {{time: number, letter: string, count: number}} Miss  seconds; `count`: number of late ticks
 * @param {HTMLCanvasElement} canvas @param {import("/assets/plot.js").Samples} steps ns @param {Miss[]} misses
 * @param {import("/assets/plot.js").Times} times @param {number} periodNs @param {Record<string, string>} colours
 */
export function drawTimingStrip(canvas, steps, misses, { from, to, now }, periodNs, colours) {
  const { context, width, height } = prepare(canvas);
  const size = textScale();
  const letterPx = SMALL_LETTER_PX * size;
  const box = { x: MARGIN.left * size, y: letterPx + 2, width: width - (MARGIN.left + MARGIN.right) * size, height: 0, size };
  box.height = height - box.y - MARGIN.bottom * size;
  if (box.width < 20 || box.height < 4 || !(to > from)) return;
  const [right, bottom] = [box.x + box.width, box.y + box.height];
  const toX = (time) => box.x + ((time - from) / (to - from)) * box.width;
  drawAxes(context, box, { from, to, toX }, periodNs, colours);
  context.fillStyle = colours["--series-1"];
  // A bar is as wide as the ticks it covers, so that no false gaps appear.
  const wide = Math.max(1, Math.ceil((steps.spacing / (to - from)) * box.width));
  steps.each(from, to, Math.max(1, Math.floor(box.width)), (time, _low, high) => {
    const bar = Math.max(1, Math.min(1, high / periodNs) * box.height);
    const x = Math.floor(toX(time));
    context.fillRect(x, bottom - bar, Math.min(wide, Math.max(1, right - x)), bar);
  });
  context.font = `bold ${letterPx - 1}px system-ui, sans-serif`;
  context.textAlign = "center";
  context.textBaseline = "top";
  let lastLetter = -Infinity;
  for (const { time, letter } of misses) {
    if (time < from || time > to) continue;
    const x = toX(time);
    context.fillStyle = colours[causeOf(letter).colour];
    context.fillRect(x - 1, box.y, 3, box.height);
    if (x - lastLetter < letterPx) continue;
    context.fillText(letter, x, 0);
    lastLetter = x;
  }
  if (now !== undefined && now >= from && now <= to) {
    context.fillStyle = colours["--accent"];
    context.fillRect(toX(now) - 0.5, 0, 1, bottom);
  }
}

/** Draws the axes: time below; step time at the left, from 0 to the period, which is a dashed line. */
function drawAxes(context, box, times, periodNs, colours) {
  context.font = axisFont(box.size);
  context.fillStyle = colours["--muted"];
  context.strokeStyle = colours["--grid"];
  context.lineWidth = 1;
  context.beginPath();
  addTimes(context, box, times);
  context.stroke();
  context.textAlign = "right";
  context.textBaseline = "middle";
  context.fillText(`${periodNs / 1e6} ms`, box.x - 5, box.y);
  context.textBaseline = "bottom";
  context.fillText("0", box.x - 5, box.y + box.height + 2);
  context.strokeStyle = colours["--muted"];
  context.setLineDash([3, 3]);
  context.strokeRect(box.x - 1, box.y + 0.5, box.width + 2, box.height);
  context.setLineDash([]);
}

/** Counts the misses of each cause in a window, by letter. @param {Miss[]} misses @returns {Map<string, number>} */
export function countCauses(misses, from, to) {
  const counts = new Map();
  for (const { time, letter, count } of misses) {
    if (time >= from && time <= to) counts.set(letter, (counts.get(letter) ?? 0) + count);
  }
  return counts;
}
