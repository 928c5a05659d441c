// Hounsfield units along the planned path, with the bone threshold.

import { prepare, textScale } from "/assets/plot.js";

const MARGIN = { left: 44, right: 8, top: 16, bottom: 30 };

/** Steps of 1, 2 or 5 times a power of ten, about `count` of them. @param {number} span @param {number} count */
function steps(span, count) {
  const power = 10 ** Math.floor(Math.log10(span / count));
  const part = span / count / power;
  return power * (part < 1.5 ? 1 : part < 3.5 ? 2 : part < 7.5 ? 5 : 10);
}

/**
 * @param {HTMLCanvasElement} canvas @param {{profile: [number, number | null][], bone_threshold_hu: number, facts: any}} plan of `/view/info`
 * @param {Record<string, string>} colours
 */
export function drawProfile(canvas, plan, colours) {
  const { context, width, height } = prepare(canvas);
  const samples = plan.profile.filter(([, hu]) => hu !== null);
  if (width < 40 || samples.length < 2) return;
  const size = textScale();
  const [left, top] = [MARGIN.left * size, MARGIN.top * size];
  const [wide, high] = [width - left - MARGIN.right * size, height - top - MARGIN.bottom * size];
  const [from, to] = [samples[0][0], samples.at(-1)[0]];
  const least = Math.min(plan.bone_threshold_hu, ...samples.map(([, hu]) => hu));
  const most = Math.max(plan.bone_threshold_hu, ...samples.map(([, hu]) => hu));
  const room = (most - least || 1) * 0.06;
  const x = (mm) => left + ((mm - from) / (to - from || 1)) * wide;
  const y = (hu) => top + high - ((hu - least + room) / (most - least + 2 * room)) * high;
  context.font = `${11 * size}px system-ui, sans-serif`;
  context.fillStyle = colours["--muted"];
  context.strokeStyle = colours["--grid"];
  context.lineWidth = 1;
  context.textAlign = "right";
  context.textBaseline = "middle";
  const hu = steps(most - least || 1, 4);
  for (let value = Math.ceil(least / hu) * hu; value <= most; value += hu) {
    context.fillText(value.toFixed(0), left - 5 * size, y(value));
    line(context, left, y(value), left + wide, y(value));
  }
  context.textAlign = "center";
  context.textBaseline = "top";
  const mm = steps(to - from || 1, 5);
  for (let value = Math.ceil(from / mm) * mm; value <= to; value += mm) {
    context.fillText(value.toFixed(0), x(value), top + high + 3 * size);
    line(context, x(value), top, x(value), top + high);
  }
  context.fillText("mm along the path", left + wide / 2, top + high + 16 * size);
  context.textAlign = "left";
  context.fillText("HU", 2 * size, 0);
  context.setLineDash([4, 4]);
  context.strokeStyle = colours["--series-2"];
  line(context, left, y(plan.bone_threshold_hu), left + wide, y(plan.bone_threshold_hu));
  context.setLineDash([]);
  context.strokeStyle = colours["--series-1"];
  context.lineWidth = 1.6 * size;
  context.beginPath();
  for (const [along, value] of samples) context.lineTo(x(along), y(value));
  context.stroke();
  marks(context, plan.facts, (along) => [x(along), top, top + high], colours, size);
}

function line(context, x0, y0, x1, y1) {
  context.beginPath();
  context.moveTo(x0, y0);
  context.lineTo(x1, y1);
  context.stroke();
}

/** Marks entry, burr start and target. */
function marks(context, facts, at, colours, size) {
  context.fillStyle = colours["--text"];
  context.strokeStyle = colours["--text"];
  context.textBaseline = "top";
  context.lineWidth = 1;
  const named = [[facts?.entry, "entry"], [facts?.burr_start, "start"], [facts?.target, "target"]].filter(([sample]) => sample);
  // From right to left, so that no label leaves the plot or covers the next one.
  let next = context.canvas.clientWidth;
  for (const [sample, name] of named.sort(([a], [b]) => b.along_mm - a.along_mm)) {
    const [x, top, foot] = at(sample.along_mm);
    line(context, x, top, x, foot);
    const wide = context.measureText(name).width;
    next = Math.min(x - wide / 2, next - wide - 4 * size);
    context.textAlign = "left";
    context.fillText(name, next, 2 * size);
  }
}
