// Legends: the meaning of letters, dashed lines and crosses, panel by panel.

import { CAUSES } from "/assets/timing_strip.js";
import { COLOURS } from "/assets/tool_model.js";

/** @param {import("/assets/parts_list.js").Colour} colour */
const css = ([r, g, b]) => `rgb(${[r, g, b].map((part) => Math.round(part * 255)).join(" ")})`;
/** A legend symbol for a line as drawn. */
const line = (colour, shape) => ({ colour, shape });
const PLANNED = css(COLOURS.planned);
const TARGET = css(COLOURS.target);
const CROSS_HAIR = css(COLOURS.cursor);

/** Legend entries per panel: a letter in a colour, or a shape, and its meaning. @type {Record<string,
 * [string | {colour: string, shape: string}, string, string?][]>} */
const SIGNS = {
  "slice-signs": [
    [line(PLANNED, "solid"), "planned path in the slice"], [line(PLANNED, "dashed"), "planned path in front of or behind the slice"],
    [{ colour: TARGET, shape: "cross" }, "target; faint: outside the slice"], [{ colour: CROSS_HAIR, shape: "cross" }, "cross-hair, the same point in all views"],
    [line(css(COLOURS.linkOdd), "solid"), "outline of the tool"], [line(css(COLOURS.burr), "solid"), "outline of the burr"],
    ["○", "outline of a critical structure, in its colour in the 3D view"], [{ colour: "rgb(178 128 20)", shape: "box" }, "drilled away"], [{ colour: "rgb(92 98 106)", shape: "box" }, "outside the CT"],
    ["L R", "patient's left, right"], ["A P", "front (anterior), back (posterior)"], ["H F", "head, feet"],
  ],
  "x-ray-signs": [
    [line(PLANNED, "dashed"), "planned path"], [{ colour: TARGET, shape: "cross" }, "target"], [{ colour: CROSS_HAIR, shape: "cross" }, "cross-hair"],
    [line(css(COLOURS.linkOdd), "solid"), "tool axis at the time of the frame"], [{ colour: css(COLOURS.burr), shape: "ring" }, "burr at the time of the frame"],
    ["○", "outline of a critical structure, in its colour in the 3D view"],
  ],
  "plot-signs": [
    [line("currentColor", "solid"), "mean; pale band: minimum to maximum"], [line("currentColor", "dashed"), "the same for the second log"],
  ],
  "tick-signs": [
    [line("currentColor", "dashed"), "one period: a longer step makes the next tick late"],
    ...CAUSES.map(({ letter, name, colour }) => /** @type {[string, string, string]} */ ([letter, name, `var(${colour})`])),
  ],
};

/** Fills the legends of all panels. */
export function fillSigns() {
  for (const [id, signs] of Object.entries(SIGNS)) {
    const list = document.getElementById(id);
    list.classList.add("signs");
    list.replaceChildren(...signs.flatMap(([sign, text, colour]) => {
      const term = document.createElement("dt");
      if (typeof sign === "string") Object.assign(term, { textContent: sign }).style.color = colour ?? "inherit";
      else Object.assign(term.appendChild(document.createElement("span")), { className: `sign ${sign.shape}` }).style.color = sign.colour;
      return [term, Object.assign(document.createElement("dd"), { textContent: text })];
    }));
  }
}
